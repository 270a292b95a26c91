"""The processes of a vehicle and of its controller, on a bus or in lockstep."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import Context

from vcbf_drake.hil.bus import Bus, LinkFaults, SimulatedClock, Tap
from vcbf_drake.hil.controller_side import (
    CommandSender,
    StateReceiver,
    make_hardware_loop,
)
from vcbf_drake.hil.decoding import CommandMode, VehicleMode
from vcbf_drake.hil.prediction import PredictionRecord
from vcbf_drake.hil.report import ControllerRecord, controller_report, plant_report
from vcbf_drake.hil.timing import Timeline
from vcbf_drake.hil.vehicle_side import CommandReceiver, StateSender, make_vehicle
from vcbf_drake.safety import (
    chebyshev_ball,
    emptiness_certificate,
    inscribed_ellipsoid,
)
from vcbf_drake.safety.nearest_point import nearest_point
from vcbf_drake.simulation.run import make_simulator
from vcbf_drake.simulation.scenario import Scenario

_TIMES, _PAUSE = 10, 0.05  # [s]


def say_farewell(send: Callable[[], None]) -> None:
    """Sends a last message again and again for half a second.

    A bus may lose a message, and a DrakeLcm that is busy keeps the first of several
    that come at once: the one before the last.

    Args:
        send: Sends it.
    """
    for _ in range(_TIMES):
        send()
        time.sleep(_PAUSE)


def warm_up(num_inputs: int) -> None:
    """Solves one problem of every kind that a filter solves.

    The first one of a kind loads its solver, which takes up to half a second: a vehicle
    would have fallen back by then.

    Args:
        num_inputs: m.
    """
    m = num_inputs
    A = np.concatenate([np.eye(m), -np.eye(m), np.full((1, m), m**-0.5)])
    b = np.append(np.ones(2 * m), 0.1)
    nearest_point(A, b, np.full(m, 2.0))
    inscribed_ellipsoid(A, b)
    chebyshev_ball(A, b)
    emptiness_certificate(A, -b)


class PlantProcess:
    """Simulates a scenario's plant behind a bus: states out, commands in.

    The plant stands at its initial state until a first command comes.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: What is run.
        bus: The bus.
        diagram: The vehicle.
        collided: Whether a barrier became negative, which ends the motion.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        self.bus = bus
        self.collided = False
        self.scenario = scenario
        self._timeline = Timeline(bus.clock)
        self.diagram = make_vehicle(scenario, bus, self._timeline)
        self._receiver: CommandReceiver = self.diagram.GetSubsystemByName(
            "command_receiver"
        )
        self._sender: StateSender = self.diagram.GetSubsystemByName("state_sender")
        self._simulator = make_simulator(self.diagram, scenario)
        self._simulator.Initialize()
        self._stopping = False
        self._elapsed = 0.0

    @property
    def context(self) -> Context:
        """The diagram's context."""
        return self._simulator.get_context()

    @property
    def time(self) -> float:
        """The time since the motion began [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> VehicleMode:
        """What the vehicle does."""
        return self._receiver.mode(self._receiver.GetMyContextFromRoot(self.context))

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def run(self) -> None:
        """Runs in real time to the scenario's duration, a collision or `stop`."""
        self.bus.begin_session()
        self._wait_for_command()
        period, duration = self.scenario.period, self.scenario.duration
        tick = 1
        while not (self._stopping or self.collided or self.time >= duration):
            goal = min(tick * period, duration)
            self.bus.wait(self._timeline.utime(goal))
            self.advance_to(min(self._timeline.time(), goal))
            tick += self.time >= goal
        self._elapsed = self._timeline.time()
        self._sender.ending = True
        say_farewell(lambda: self.diagram.ForcedPublish(self.context))

    def advance_to(self, time: float) -> None:
        """Simulates up to a time [s]; earlier ones and those after a collision do not.

        A command is applied from the first step on that begins after it has come.
        """
        if self.collided or time <= self.time:
            return
        status = self._simulator.AdvanceTo(time)
        self.collided = (
            status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )

    def report(self) -> dict[str, Any]:
        """Returns what the motion came to, and how the bus did."""
        report = plant_report(self.scenario, self.diagram, self.context, self.collided)
        if self._elapsed > 0.0:
            report["real_time_rate"] = self.time / self._elapsed
        return report

    def _wait_for_command(self) -> None:
        while self._receiver.inbox.newest is None and not self._stopping:
            self._timeline.restart()
            self.diagram.ForcedPublish(self.context)
            self.bus.wait(self._timeline.utime(self.scenario.period))
        self._timeline.restart()


class ControllerProcess:
    """Drives the hardware loop of a scenario: one tick for every state that comes.

    The loop's time is the time of the state, so the observer's intervals are the
    vehicle's, whatever the bus does. A vehicle that sends faster than the control
    period is sampled. When no state comes, commands go on once a control period, as
    the watchdog says.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: What is run.
        bus: The bus.
        diagram: The hardware loop.
        context: Its context.
        tick_taps: Called with the context at every tick, before its discrete state
            changes.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        self.bus = bus
        self.scenario = scenario
        self._period = round(1e6 * scenario.period)  # [us]
        self.diagram = make_hardware_loop(scenario, bus)
        named = self.diagram.GetSubsystemByName
        self._receiver: StateReceiver = named("state_receiver")
        self._sender: CommandSender = named("command_sender")
        warm_up(named("filter").model.num_inputs)
        self.context = self.diagram.CreateDefaultContext()
        self.tick_taps: list[Callable[[Context], None]] = []
        self._record = ControllerRecord()
        self._prediction: PredictionRecord | None = None
        if scenario.hardware.predict:
            self._prediction = PredictionRecord(self.diagram, len(scenario.target))
            self.tick_taps.append(self._prediction)
        self._sent_at = 0
        self._stopping = False

    @property
    def time(self) -> float:
        """The time of the last state that was acted on [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> CommandMode | None:
        """What it asked of the vehicle last, None before the first time."""
        status = self._sender.last_status
        return None if status is None else CommandMode(status.mode)

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def run(self) -> None:
        """Runs until the vehicle ends, the scenario's duration is over, or `stop`.

        It takes over from any controller that speaks already.
        """
        self.bus.begin_session()
        while not (self._stopping or self._is_over()):
            self.bus.wait(self.bus.clock.utime() + self._period)
            self.step()
        self._sender.ending = True
        say_farewell(self._send)

    def step(self) -> None:
        """Acts on the newest state; in a long silence, sends what the watchdog says."""
        self.bus.poll()
        if self._is_due():
            self._tick()
        elif self._sender.states_are_old() and self._has_been_silent():
            self._send()

    def report(self) -> dict[str, Any]:
        """Returns what the filter did, and how the states arrived."""
        report = controller_report(self.scenario, self._receiver, self._record)
        if self._prediction is not None:
            report["prediction"] = self._prediction.report()
        return report

    def _is_due(self) -> bool:
        context = self._receiver_context()
        if not self._receiver.has_news(context):
            return False
        newest, last = self._receiver.inbox.newest, self._receiver.message(context)
        if last is None or newest.session != last.session or newest.time == last.time:
            return True
        return bool(newest.time - last.time > 0.9 * self.scenario.period)

    def _tick(self) -> None:
        """Takes the state over, updates filter, hold and observer, and sends."""
        started = time.perf_counter()
        self.diagram.ExecuteForcedEvents(self.context, publish=False)
        self.context.SetTime(self._receiver.time(self._receiver_context()))
        for tap in self.tick_taps:
            tap(self.context)
        self.context.SetDiscreteState(
            self.diagram.EvalUniquePeriodicDiscreteUpdate(self.context)
        )
        self._send()
        self._record.add_tick(self._sender.last_status, time.perf_counter() - started)

    def _send(self) -> None:
        """Sends command and status, if there was a tick already."""
        self.diagram.ForcedPublish(self.context)
        self._sent_at = self.bus.clock.utime()
        if self._sender.last_status is not None:
            self._record.add_mode(self._sender.last_status)

    def _has_been_silent(self) -> bool:
        return self.bus.clock.utime() - self._sent_at >= self._period

    def _is_over(self) -> bool:
        newest = self._receiver.inbox.newest
        return newest is not None and bool(
            newest.mode == VehicleMode.ENDED or newest.time >= self.scenario.duration
        )

    def _receiver_context(self) -> Any:
        return self._receiver.GetMyContextFromRoot(self.context)


class InProcess:
    """Drives a vehicle and its controller in lockstep over ``memq://``.

    The clock stands still while either side computes, so without faults a command
    reaches the vehicle at the instant its state was measured: the run is that of
    `simulate`. With faults, messages arrive on a grid of time.

    Args:
        scenario: A validated scenario.
        vehicle_faults: Injected into the commands.
        controller_faults: Injected into the states.
        grid: How many times in a control period messages are handled.
        tap: Told of everything that the controller's side sends and receives.

    Attributes:
        clock: What both sides take for the time.
        lcm: The bus both are on.
        plant: The vehicle's side.
        controller: The controller's side; None while it is dead.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle_faults: LinkFaults | None = None,
        controller_faults: LinkFaults | None = None,
        grid: int = 1,
        tap: Tap | None = None,
    ) -> None:
        self.clock = SimulatedClock()
        self.lcm = DrakeLcm("memq://")
        self.controller: ControllerProcess | None = None
        self._scenario, self._faults = scenario, controller_faults
        self._grid, self._instant, self._tap = grid, 0, tap
        self._epoch = self.clock.now
        self.start_controller()
        self.plant = PlantProcess(scenario, Bus(self.lcm, self.clock, vehicle_faults))
        self._exchange()

    def start_controller(self) -> None:
        """Starts a controller, or another one, which knows nothing of the first."""
        bus = Bus(self.lcm, self.clock, self._faults)
        if self._tap is not None:
            bus.taps.append(self._tap)
        self.controller = ControllerProcess(self._scenario, bus)

    def kill_controller(self) -> None:
        """Ends the controller without a farewell."""
        self.controller = None

    def advance_to(self, time: float) -> None:
        """Runs both sides up to a time [s], or to a collision."""
        while not self.plant.collided:
            step, part = divmod(self._instant + 1, self._grid)
            instant = (step + part / self._grid) * self._scenario.period
            if instant > time + 1e-9:
                return
            self._instant += 1
            self.clock.now = self._epoch + round(1e6 * instant)
            self.plant.advance_to(instant)
            self._exchange()

    def _exchange(self) -> None:
        if self.controller is not None:
            self.controller.step()
        self.plant.bus.poll()
