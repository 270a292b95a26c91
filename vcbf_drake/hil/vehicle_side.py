"""The vehicle's side of the bus as Drake systems: commands in, states out."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    State,
    TriggerType,
)
from pydrake.systems.primitives import Integrator, LogVectorOutput

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus, Clock
from vcbf_drake.hil.inbox import (
    CommandMode,
    Inbox,
    VehicleMode,
    command_format,
    obstacles_format,
    state_format,
)
from vcbf_drake.hil.messages import vcbf_obstacles, vcbf_state
from vcbf_drake.hil.senders import Reason, check_timing
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.interface import state_port_of
from vcbf_drake.safety import InputSet
from vcbf_drake.simulation.loop import (
    LOG_PREFIX,
    add_collision_monitor,
    add_simulated_plant,
)
from vcbf_drake.simulation.obstacles import barriers
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.sections import Hardware


class Timeline:
    """Ties a simulation's time to a clock; its time 0 is now, until `restart`."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.restart()

    def restart(self) -> None:
        """Makes now the simulation's time 0."""
        self._start = self._clock.utime()

    def utime(self, time: float) -> int:
        """Returns the clock's time at a simulation's time [us]."""
        return self._start + round(1e6 * time)

    def time(self) -> float:
        """Returns the simulation's time now, by the clock [s]."""
        return 1e-6 * (self._clock.utime() - self._start)


def fallback_input(
    kind: str,
    model: ControlAffineModel,
    input_set: InputSet,
    x: Array,
    brake_rate: float,
) -> Array:
    """Returns the input of a vehicle that is left alone, inside its limits.

    ``zero`` is no input. ``brake`` takes off the speed v = S x by S (f + g u) =
    -brake_rate v, or comes nearest to it in the sense of least squares. A vehicle
    without a speed (`ControlAffineModel.speed_matrix`) has no input. Source: ours.

    Args:
        kind: "zero" or "brake".
        model: The vehicle's f, g, E.
        input_set: What its actuators can do.
        x: Its state, shape (n,).
        brake_rate: How fast the speed decays [1/s].
    """
    speed_of = model.speed_matrix
    if kind == "zero" or not len(speed_of):
        return input_set.project(np.zeros(model.num_inputs))
    f, g = model.drift_and_input_matrix(x)
    u, *_ = np.linalg.lstsq(speed_of @ g, -speed_of @ (brake_rate * x + f), rcond=None)
    return input_set.project(u)


# Commands that a step may find waiting; the oldest of more are obsolete anyway.
_MOST_WAITING = 1000


class _Received(NamedTuple):
    """A command, and when it came [us]."""

    command: Any
    at: int


class CommandReceiver(LeafSystem):
    """Applies the newest command, or falls back when none came for too long.

    .. pydrake_system::

        name: CommandReceiver
        input_ports:
        - state
        output_ports:
        - input
        - mode

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the vehicle's state, for the brake |
    | ``input`` | m | what the actuators apply: always inside their limits |
    | ``mode`` | 1 | a `VehicleMode` |

    At the beginning of every simulator step the newest command that has come by then is
    taken, and the watchdog looks at its age; between steps the input is held. A process
    that wakes late handles commands that are younger than the step it has to make up
    for: that one passes them over, for they were not there yet, and they wait, whatever
    comes after them. When it is made up for (`catch_up`), they act from the next step
    on.

    Args:
        bus: Where commands come from.
        model: The vehicle's f, g, E.
        input_set: What its actuators can do.
        settings: When to fall back, and how.
        timeline: Tells the time of the context.

    Attributes:
        inbox: What arrived. Its round trips are from sending a state to the command
            that answers it.
    """

    def __init__(
        self,
        bus: Bus,
        model: ControlAffineModel,
        input_set: InputSet,
        settings: Hardware,
        timeline: Timeline,
    ) -> None:
        super().__init__()
        self._bus, self._settings, self._timeline = bus, settings, timeline
        self._model, self._input_set = model, input_set
        m = model.num_inputs
        self.inbox = Inbox(
            bus,
            command_format(m),
            settings.command_timeout,
            self._receive,
            max_clock_offset=settings.max_clock_offset,
            echo=lambda command: (command.state_utime, command.state_age),
            # What answers another vehicle was not made for this one.
            refusal=lambda command: (
                None if command.state_session == bus.session else Reason.ADDRESS
            ),
        )
        self._applied: _Received | None = None
        self._waiting: deque[_Received] = deque(maxlen=_MOST_WAITING)
        self._overdue = 0
        self._state = self.DeclareVectorInputPort("state", model.num_states)
        self._input = self.DeclareDiscreteState(m)
        self._mode = self.DeclareDiscreteState([VehicleMode.WAITING])
        self.DeclareStateOutputPort("input", self._input)
        self.DeclareStateOutputPort("mode", self._mode)
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)

    def mode(self, context: Context) -> VehicleMode:
        """Returns what the vehicle does."""
        return VehicleMode(int(context.get_discrete_state(self._mode)[0]))

    def catch_up(self) -> None:
        """Has what was passed over act from the next step on."""
        self._overdue = len(self._waiting)

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        now = self._timeline.utime(context.get_time())
        self._take_commands(now)
        if self._applied is None:
            return EventStatus.DidNothing()
        mode, u = self._choose(self._applied, now, context)
        held = state.get_mutable_discrete_state()
        held.set_value(self._input, u)
        held.set_value(self._mode, [mode])
        return EventStatus.Succeeded()

    def _take_commands(self, now: int) -> None:
        """Takes what has come by `now` [us], and what is overdue."""
        waiting = self._waiting
        while waiting and (self._overdue > 0 or waiting[0].at <= now):
            self._applied = waiting.popleft()
            self._overdue -= 1
        self._overdue = 0

    def _choose(
        self, received: _Received, now: int, context: Context
    ) -> tuple[VehicleMode, Array]:
        """What to do at the time `now` [us], and the input."""
        command, received_at = received
        age = 1e-6 * (now - received_at)
        applies = command.mode in (CommandMode.APPLY, CommandMode.HOLD)
        if applies and age <= self._settings.command_timeout:
            return VehicleMode.FOLLOWING, self._input_set.project(command.input)
        return VehicleMode.FALLBACK, fallback_input(
            self._settings.fallback,
            self._model,
            self._input_set,
            self._state.Eval(context),
            self._settings.brake_rate,
        )

    def _receive(self, command: Any, now: int) -> None:
        self._waiting.append(_Received(command, now))
        is_answer = command.state_session == self._bus.session
        if is_answer and command.mode == CommandMode.APPLY:
            self.inbox.add_round_trip(now - command.state_utime)


class StateSender(LeafSystem):
    """Publishes the measured state, periodically and at forced events.

    .. pydrake_system::

        name: StateSender
        input_ports:
        - state
        - input_integral
        - mode

    Args:
        bus: Where to.
        num_states: n.
        num_inputs: m.
        period: Time between messages [s].
        commands: The commands that arrived.
        timeline: Tells the time of the context.

    Attributes:
        ending: Whether the vehicle is about to end.
    """

    def __init__(
        self,
        bus: Bus,
        num_states: int,
        num_inputs: int,
        period: float,
        commands: Inbox,
        timeline: Timeline,
    ) -> None:
        super().__init__()
        self.ending = False
        self._bus, self._commands, self._timeline = bus, commands, timeline
        self._channel = state_format(num_states, num_inputs).channel
        self._state = self.DeclareVectorInputPort("state", num_states)
        self._integral = self.DeclareVectorInputPort("input_integral", num_inputs)
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def _send(self, context: Context) -> None:
        message, command = vcbf_state(), self._commands.newest
        mode = VehicleMode(int(self._mode.Eval(context)[0]))
        message.mode = VehicleMode.ENDED if self.ending else mode
        message.time = context.get_time()
        message.utime_measured = self._timeline.utime(message.time)
        if message.mode in (VehicleMode.WAITING, VehicleMode.ENDED):
            # Its time stands still, as it does: what is true now is measured now.
            message.utime_measured = self._bus.clock.utime()
        message.command_session = message.command_sequence = -1
        if command is not None:
            message.command_session = command.session
            message.command_sequence = command.sequence
            message.command_utime = command.utime
            message.command_age = self._bus.clock.utime() - self._commands.received_at
        message.state = self._state.Eval(context).tolist()
        message.num_states = len(message.state)
        message.input_integral = self._integral.Eval(context).tolist()
        message.num_inputs = len(message.input_integral)
        self._bus.send(self._channel, message)


_PERIOD = 0.5  # [s]


class ObstacleSender(LeafSystem):
    """Publishes the scenario's obstacles twice a second and at forced events.

    .. pydrake_system::

        name: ObstacleSender

    Args:
        bus: Where to.
        scenario: Has the obstacles.
    """

    def __init__(self, bus: Bus, scenario: Scenario) -> None:
        super().__init__()
        self._bus, self._obstacles = bus, scenario.spheres
        self.DeclarePeriodicPublishEvent(_PERIOD, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def _send(self, context: Context) -> None:
        message = vcbf_obstacles()
        message.time = context.get_time()
        for obstacle in self._obstacles:
            message.radius.append(obstacle.safety_distance)
            message.valid.append(True)
            message.position.extend(obstacle.center_at(message.time))
            message.velocity.extend(obstacle.moving_center.velocity)
        message.num_obstacles = len(message.radius)
        message.num_coordinates = len(message.position)
        self._bus.send(obstacles_format().channel, message)


def make_vehicle(scenario: Scenario, bus: Bus, timeline: Timeline) -> Diagram:
    """Returns a scenario's plant and disturbance behind an LCM bus.

    The systems are named plant, disturbance, command_receiver, input_integral and
    state_sender; ``log_path`` and ``log_mode`` record the true state and the vehicle's
    mode at every integrator step. It ends a simulation at a collision.

    Args:
        scenario: A validated scenario.
        bus: Carries states out and commands in.
        timeline: Ties the diagram's time to the bus's clock.

    Raises:
        ScenarioError: A time limit is shorter than the control period.
    """
    check_timing(scenario)
    builder = DiagramBuilder()
    simulated = add_simulated_plant(builder, scenario)
    plant, measured = simulated.plant, simulated.state
    model = scenario.make_model()
    receiver = builder.AddNamedSystem(
        "command_receiver",
        CommandReceiver(
            bus, model, scenario.input_set.input_set(), scenario.hardware, timeline
        ),
    )
    integral = builder.AddNamedSystem("input_integral", Integrator(model.num_inputs))
    sender = builder.AddNamedSystem(
        "state_sender",
        StateSender(
            bus,
            model.num_states,
            model.num_inputs,
            scenario.period,
            receiver.inbox,
            timeline,
        ),
    )
    builder.AddNamedSystem("obstacle_sender", ObstacleSender(bus, scenario))
    applied, mode = receiver.GetOutputPort("input"), receiver.GetOutputPort("mode")
    builder.Connect(measured, receiver.GetInputPort("state"))
    builder.Connect(applied, simulated.input)
    builder.Connect(applied, integral.get_input_port())
    builder.Connect(measured, sender.GetInputPort("state"))
    builder.Connect(integral.get_output_port(), sender.GetInputPort("input_integral"))
    builder.Connect(mode, sender.GetInputPort("mode"))
    add_collision_monitor(builder, plant, BarrierSet(model, barriers(scenario)))
    logged = {"path": state_port_of(plant), "mode": mode}
    for name, port in logged.items():
        log = LogVectorOutput(port, builder, {TriggerType.kPerStep})
        log.set_name(LOG_PREFIX + name)
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_vehicle")
    return diagram
