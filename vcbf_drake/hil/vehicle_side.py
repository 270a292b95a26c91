"""The vehicle's side of the bus: commands in, states and obstacles out."""

from __future__ import annotations

from collections import deque
from typing import Any

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
from pydrake.systems.primitives import LogVectorOutput

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.checks import Array, require
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.formats import (
    SHORTEST_PERIOD,
    CommandMode,
    Reason,
    VehicleMode,
    command_format,
    obstacles_format,
    state_format,
)
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.messages import vcbf_obstacles, vcbf_state
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.interface import state_port_of
from vcbf_drake.safety import InputSet
from vcbf_drake.simulation.collision_monitor import add_collision_monitor
from vcbf_drake.simulation.loop import (
    LOG_PREFIX,
    add_simulated_plant,
)
from vcbf_drake.simulation.obstacles import barriers
from vcbf_drake.simulation.scenario import Scenario

# The number of waiting commands kept for a step; older ones are obsolete.
_MOST_WAITING = 1000
_OBSTACLE_PERIOD = 0.5  # [s]


def fallback_input(
    kind: str,
    model: ControlAffineModel,
    input_set: InputSet,
    x: Array,
    brake_rate: float,
) -> Array:
    """Returns the fallback input of a vehicle without commands, inside its limits.

    ``zero`` is the input 0. ``brake`` reduces the speed v = S x by S (f + g u) =
    -brake_rate v, or its least-squares solution. For a vehicle without a speed
    (`ControlAffineModel.speed_matrix`) it is 0. Source: ours.
    """
    speed_of = model.speed_matrix
    if kind == "zero" or not len(speed_of):
        return input_set.project(np.zeros(model.num_inputs))
    f, g = model.drift_and_input_matrix(x)
    u, *_ = np.linalg.lstsq(speed_of @ g, -speed_of @ (brake_rate * x + f), rcond=None)
    return input_set.project(u)


class VehicleEnd(LeafSystem):
    """A vehicle's end of the bus: receives commands, and sends states and obstacles.

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``input`` | m | the input that the actuators apply: always inside their limits |

    At the beginning of every simulator step the newest command that has come by then is
    taken, and the watchdog looks at its age; between steps the input is held. A process
    that wakes late handles commands that are younger than the step it makes up for:
    that step ignores them, and they act from the next step on.

    States are sent periodically, obstacles twice a second, and both at forced events.
    The context's time is tied to the bus's clock: its time 0 is when this was made, or
    `restart` called.

    Args:
        bus: The bus, for states and commands.
        scenario: The scenario, with the period, the response to missing commands, and
            the obstacles.
        model: The vehicle's f, g, E.

    Attributes:
        inbox: The commands.
        ending: Whether the vehicle is about to end.
    """

    def __init__(self, bus: Bus, scenario: Scenario, model: ControlAffineModel) -> None:
        super().__init__()
        self.ending = False
        self._bus, self._settings, self._model = bus, scenario.hardware, model
        self._input_set = scenario.input_set.input_set()
        self._obstacles = scenario.spheres
        n, m = model.num_states, model.num_inputs
        self._channel = state_format(n, m).channel
        self.inbox = Inbox(
            bus,
            command_format(m),
            self._settings.command_timeout,
            lambda command, now: self._waiting.append((command, now)),
            max_clock_offset=self._settings.max_clock_offset,
            echo=lambda command: (command.state_utime, command.state_age),
            # An answer to another vehicle was not made for this one.
            refusal=lambda command: (
                None if command.state_session == bus.session else Reason.ADDRESS
            ),
        )
        # Commands and their times of arrival [us]: the one that acts, those to come.
        self._applied: tuple[Any, int] | None = None
        self._waiting: deque[tuple[Any, int]] = deque(maxlen=_MOST_WAITING)
        self._passed_over = 0
        self.restart()
        self._state = self.DeclareVectorInputPort("state", n)
        self._input = self.DeclareDiscreteState(m)
        self._mode = self.DeclareDiscreteState([VehicleMode.WAITING])
        # The input's integral, and at which time it is that.
        self._integral = self.DeclareDiscreteState(m + 1)
        self.DeclareStateOutputPort("input", self._input)
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        self.DeclarePeriodicPublishEvent(scenario.period, 0.0, self._send_state)
        self.DeclarePeriodicPublishEvent(_OBSTACLE_PERIOD, 0.0, self._send_obstacles)
        for send in (self._send_state, self._send_obstacles):
            self.DeclareForcedPublishEvent(send)

    def restart(self) -> None:
        """Makes now the context's time 0."""
        self._start = self._bus.clock.utime()

    def utime(self, time: float) -> int:
        """Returns the clock's time at a time of the context [us]."""
        return self._start + round(1e6 * time)

    def time(self) -> float:
        """Returns the current time, by the clock [s]."""
        return 1e-6 * (self._bus.clock.utime() - self._start)

    def mode(self, context: Context) -> VehicleMode:
        """Returns the mode of the vehicle."""
        return VehicleMode(int(context.get_discrete_state(self._mode)[0]))

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        now, waiting = self.utime(context.get_time()), self._waiting
        while waiting and (waiting[0][1] <= now or self._passed_over > 0):
            self._applied = waiting.popleft()
            self._passed_over -= 1
        self._passed_over = len(waiting)
        if self._applied is None:
            return EventStatus.DidNothing()
        command, received_at = self._applied
        is_fresh = 1e-6 * (now - received_at) <= self._settings.command_timeout
        if is_fresh and command.mode in (CommandMode.APPLY, CommandMode.HOLD):
            mode, u = VehicleMode.FOLLOWING, self._input_set.project(command.input)
        else:
            mode, u = VehicleMode.FALLBACK, self._fallback(self._state.Eval(context))
        integral = [*self._integral_now(context), context.get_time()]
        held = state.get_mutable_discrete_state()
        held.set_value(self._integral, integral)
        held.set_value(self._input, u)
        held.set_value(self._mode, [mode])
        return EventStatus.Succeeded()

    def _integral_now(self, context: Context) -> Array:
        """The integral over time of the applied input, (m,)."""
        *integral, since = context.get_discrete_state(self._integral).CopyToVector()
        applied = context.get_discrete_state(self._input).CopyToVector()
        return np.asarray(integral + applied * (context.get_time() - since))

    def _fallback(self, x: Array) -> Array:
        kind, rate = self._settings.fallback, self._settings.brake_rate
        return fallback_input(kind, self._model, self._input_set, x, rate)

    def _send_state(self, context: Context) -> None:
        message, command, clock = vcbf_state(), self.inbox.newest, self._bus.clock
        message.mode = VehicleMode.ENDED if self.ending else self.mode(context)
        message.time = context.get_time()
        message.utime_measured = self.utime(message.time)
        if message.mode in (VehicleMode.WAITING, VehicleMode.ENDED):
            # Its time stands still, as it does: what is true now is measured now.
            message.utime_measured = clock.utime()
        message.command_session = message.command_sequence = -1
        if command is not None:
            message.command_session = command.session
            message.command_sequence = command.sequence
            message.command_utime = command.utime
            message.command_age = clock.utime() - self.inbox.received_at
        message.state = self._state.Eval(context).tolist()
        message.num_states = len(message.state)
        message.input_integral = self._integral_now(context).tolist()
        message.num_inputs = len(message.input_integral)
        self._bus.send(self._channel, message)

    def _send_obstacles(self, context: Context) -> None:
        message = vcbf_obstacles()
        message.time = context.get_time()
        for obstacle in self._obstacles:
            message.radius.append(obstacle.safety_distance)
            message.valid.append(True)
            message.position.extend(obstacle.center_at(message.time))
            message.velocity.extend(obstacle.motion[1])
        message.num_obstacles = len(message.radius)
        message.num_coordinates = len(message.position)
        self._bus.send(obstacles_format().channel, message)


def check_timing(scenario: Scenario) -> None:
    """Checks that a scenario's period, time limits and sight suit a bus."""
    sight, period = scenario.faults.sight, scenario.period
    rule = (
        "0 on a bus, where a vehicle says what it sees (hardware.obstacles: perceived)"
    )
    require(sight <= 0.0, ("faults", "sight"), sight, rule)
    rule = f"at least {SHORTEST_PERIOD:g} s on a bus"
    require(period >= SHORTEST_PERIOD, "period", period, rule)
    scenario.check_hardware_times()


def make_vehicle(scenario: Scenario, bus: Bus) -> Diagram:
    """Returns a scenario's plant and disturbance behind an LCM bus.

    The systems are those of `make_loop`, with vehicle_end where controller and filter
    were; ``log_path`` records the true state at every integrator step. It ends a
    simulation at a collision.

    Args:
        scenario: A validated scenario.
        bus: The bus, for states, obstacles and commands.

    Raises:
        InvalidValueError: A time limit is shorter than the control period.
    """
    check_timing(scenario)
    builder = DiagramBuilder()
    simulated = add_simulated_plant(builder, scenario)
    model = scenario.make_model()
    end = builder.AddNamedSystem("vehicle_end", VehicleEnd(bus, scenario, model))
    builder.Connect(simulated.state, end.GetInputPort("state"))
    builder.Connect(end.GetOutputPort("input"), simulated.input)
    hit = BarrierSet(model, barriers(scenario))
    add_collision_monitor(builder, simulated.plant, hit)
    path = state_port_of(simulated.plant)
    log = LogVectorOutput(path, builder, {TriggerType.kPerStep})
    log.set_name(LOG_PREFIX + "path")
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_vehicle")
    return diagram
