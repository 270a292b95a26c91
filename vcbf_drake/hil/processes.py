"""The processes of a vehicle and of its controller, on a bus or in lockstep."""

from __future__ import annotations

from collections.abc import Callable
import math
import time
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus, LinkFaults, SimulatedClock, Tap
from vcbf_drake.hil.controller_side import CommandSender, make_hardware_loop
from vcbf_drake.hil.decoding import CommandMode, VehicleMode
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.hil.prediction import PredictionRecord
from vcbf_drake.hil.report import ControllerRecord, controller_report, plant_report
from vcbf_drake.hil.state_receiver import StateReceiver
from vcbf_drake.hil.timing import Timeline
from vcbf_drake.hil.vehicle_side import CommandReceiver, StateSender, make_vehicle
from vcbf_drake.safety import (
    FilterStatus,
    chebyshev_ball,
    emptiness_certificate,
    inscribed_ellipsoid,
)
from vcbf_drake.safety.projection import nearest_point
from vcbf_drake.simulation.run import make_simulator
from vcbf_drake.simulation.scenario import Scenario

_TIMES, _PAUSE = 10, 0.05  # [s]

# Why a process ended, and its exit status.
EXIT_STATUSES = {
    "duration": 0,
    "vehicle ended": 0,
    "collision": 3,
    "infeasible": 4,
    "no peer": 5,
    "stopped": 128,  # And the signal's number.
}


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


class _Process:
    """What both processes share: how they end, and what they say on the way.

    Attributes:
        bus: The bus.
        ending: Why `run` ended, one of the keys of `EXIT_STATUSES`; empty before.
        tell: Called with a line whenever something changes.
        progress: Called with a line once a second.
    """

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.ending = ""
        self.tell: Callable[[str], None] = lambda line: None
        self.progress: Callable[[str], None] = lambda line: None
        self._stopping = False
        self._told: dict[str, str] = {}
        self._progress_at = 0

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def _begin_session(self, inbox: Inbox) -> None:
        """What came before is no loss: nobody listened."""
        self.bus.drain()
        self.bus.begin_session()
        inbox.begin_anew()

    def _tell_change(self, subject: str, text: str, line: str) -> None:
        """Tells a line if the subject's text is another one than before."""
        if self._told.get(subject, "") != text:
            self._told[subject] = text
            self.tell(line)

    def _tell_progress(self, line: Callable[[], str]) -> None:
        now = self.bus.clock.utime()
        if now - self._progress_at >= 1_000_000:
            self._progress_at = now
            self.progress(line())


class PlantProcess(_Process):
    """Simulates a scenario's plant behind a bus: states out, commands in.

    The plant stands at its initial state until a first command comes.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: What is run.
        diagram: The vehicle.
        collided: Whether a barrier became negative, which ends the motion.
        deadlines_missed: How often it woke later than a control period.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        super().__init__(bus)
        self.collided = False
        self.deadlines_missed = 0
        self.scenario = scenario
        self._timeline = Timeline(bus.clock)
        self.diagram = make_vehicle(scenario, bus, self._timeline)
        self._receiver: CommandReceiver = self.diagram.GetSubsystemByName(
            "command_receiver"
        )
        self._sender: StateSender = self.diagram.GetSubsystemByName("state_sender")
        self._simulator = make_simulator(self.diagram, scenario)
        self._simulator.Initialize()
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

    def run(self, patience: float = math.inf) -> None:
        """Runs in real time to the scenario's duration, a collision or `stop`.

        Args:
            patience: How long to wait for a first command [s].
        """
        self._begin_session(self._receiver.inbox)
        if self._wait_for_command(patience):
            self._move()
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
        self._receiver.catch_up()
        self.collided = (
            status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )

    def report(self) -> dict[str, Any]:
        """Returns what the motion came to, and how the bus did."""
        report = plant_report(self.scenario, self.diagram, self.context, self.collided)
        report["deadlines_missed"] = self.deadlines_missed
        if self._elapsed > 0.0:
            report["real_time_rate"] = self.time / self._elapsed
        return report

    def _wait_for_command(self, patience: float) -> bool:
        """Stands until a command comes; returns whether one came."""
        began = self.bus.clock.utime()
        while self._receiver.inbox.newest is None:
            self._timeline.restart()
            if self._stopping:
                self.ending = "stopped"
                return False
            if self.bus.clock.utime() - began > 1e6 * patience:
                self.ending = "no peer"
                return False
            self.diagram.ForcedPublish(self.context)
            self.bus.wait(self._timeline.utime(self.scenario.period))
            self._say()
        self._timeline.restart()
        return True

    def _move(self) -> None:
        period, duration = self.scenario.period, self.scenario.duration
        tick = 1
        while not (self._stopping or self.collided or self.time >= duration):
            goal = min(tick * period, duration)
            self.bus.wait(self._timeline.utime(goal))
            self.deadlines_missed += self._timeline.time() - goal > period
            self.advance_to(min(self._timeline.time(), goal))
            tick += self.time >= goal
            self._say()
        self.ending = "stopped" if self._stopping else "duration"
        if self.collided:
            self.ending = "collision"

    def _say(self) -> None:
        mode = self.mode.name.lower()
        self._tell_change("mode", mode, f"{self.time:.2f} s: {mode}")
        inbox = self._receiver.inbox
        complaint = inbox.complaint(self.bus.clock.utime())
        if complaint:
            line = f"{self.time:.2f} s: commands: {complaint}"
            self._tell_change("commands", inbox.last_rejection, line)
        self._tell_progress(
            lambda: f"{self.time:8.1f} s  {mode}  {inbox.accepted} commands"
        )


class ControllerProcess(_Process):
    """Drives a hardware loop: one tick for every state that comes.

    The loop's time is the time of the state, so the observer's intervals are the
    vehicle's, whatever the bus does. A vehicle that sends faster than the control
    period is sampled. When no state comes, a status, and after the first state commands
    too, go on once a control period, as the watchdogs say.

    Args:
        diagram: A hardware loop: a `VehicleLink` and what it is connected to.
        bus: Carries the messages.
        duration: How long it controls, by the vehicle's time [s].

    Attributes:
        diagram: The hardware loop.
        duration: See the argument.
        context: Its context.
        tick_taps: Called with the context at every tick, before its discrete state
            changes.
        takes_over: Whether the vehicle is asked to leave another controller.
    """

    def __init__(self, diagram: Diagram, bus: Bus, duration: float = math.inf) -> None:
        super().__init__(bus)
        self.diagram, self.duration = diagram, duration
        named = self.diagram.GetSubsystemByName
        self._receiver: StateReceiver = named("state_receiver")
        self._sender: CommandSender = named("command_sender")
        self._period = round(1e6 * self._sender.period)  # [us]
        warm_up(named("filter").model.num_inputs)
        # And one tick that nobody sees: the first one of a diagram is slow.
        self.diagram.EvalUniquePeriodicDiscreteUpdate(
            self.diagram.CreateDefaultContext()
        )
        self.context = self.diagram.CreateDefaultContext()
        self.tick_taps: list[Callable[[Context], None]] = []
        self.takes_over = False
        self._record = ControllerRecord()
        self._prediction: PredictionRecord | None = None
        self._sent_at = 0
        self._session, self._began = 0, 0.0

    @property
    def time(self) -> float:
        """The time of the last state that was acted on [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> CommandMode | None:
        """What it asked of the vehicle last, None before the first tick."""
        status = self._sender.last_status
        if status is None or status.state_sequence < 0:
            return None
        return CommandMode(status.mode)

    def measure_prediction(self, positions: Callable[[Array], Array]) -> None:
        """Compares predicted positions with measured ones from now on.

        Args:
            positions: Returns where the vehicle is, (T, k), from its states (T, n).
        """
        self._prediction = PredictionRecord(self.diagram, positions)
        self.tick_taps.append(self._prediction)

    def run(self, patience: float = math.inf) -> None:
        """Runs until its vehicle ends, the duration is over, or `stop`.

        Args:
            patience: How long to wait for a first state [s].
        """
        if self._session == 0:
            self._begin_session(self._receiver.inbox)
        self._sender.takes_over = self.takes_over
        began = self.bus.clock.utime()
        while not (self._stopping or self._is_over()):
            self.bus.wait(self.bus.clock.utime() + self._period)
            self.step()
            self._say()
            waited = self.bus.clock.utime() - began
            if self._session == 0 and waited > 1e6 * patience:
                self.ending = "no peer"
                return
        if self._stopping:
            self.ending = "stopped"
        elif self._is_infeasible():
            self.ending = "infeasible"
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
        report = controller_report(self._receiver, self._record)
        report["deadlines_missed"] = self._sender.deadlines_missed
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
        return bool(newest.time - last.time > 0.9e-6 * self._period)

    def _tick(self) -> None:
        """Takes the state over, updates filter, hold and observer, and sends."""
        started, last = time.perf_counter(), self.time
        self.diagram.ExecuteForcedEvents(self.context, publish=False)
        newest = self._receiver.message(self._receiver_context())
        self.context.SetTime(newest.time)
        if newest.session == self._session:
            periods = round(1e6 * (newest.time - last) / self._period)
            self._sender.deadlines_missed += max(0, periods - 1)
        else:
            self._session, self._began = newest.session, newest.time
            self._receiver.inbox.forget_the_start()
        for tap in self.tick_taps:
            tap(self.context)
        self.context.SetDiscreteState(
            self.diagram.EvalUniquePeriodicDiscreteUpdate(self.context)
        )
        self._send()
        self._record.add_tick(self._sender.last_status, time.perf_counter() - started)

    def _send(self) -> None:
        """Sends a status, and a command if there was a tick already."""
        self.diagram.ForcedPublish(self.context)
        self._sent_at = self.bus.clock.utime()
        if self.mode is not None and self._sender.last_status is not None:
            self._record.add_mode(self._sender.last_status)

    def _has_been_silent(self) -> bool:
        return self.bus.clock.utime() - self._sent_at >= self._period

    def _is_over(self) -> bool:
        newest = self._receiver.inbox.newest
        if newest is None or newest.session != self._session:
            return False  # Not the vehicle that is controlled.
        if newest.mode == VehicleMode.ENDED:
            self.ending = "vehicle ended"
        elif newest.time - self._began >= self.duration:
            self.ending = "duration"
        return bool(self.ending)

    def _is_infeasible(self) -> bool:
        """Whether the last tick had no feasible input."""
        status = self._sender.last_status
        return status is not None and status.filter_status == FilterStatus.INFEASIBLE

    def _say(self) -> None:
        status, inbox = self._sender.last_status, self._receiver.inbox
        if status is None:
            return
        is_ticking = status.state_sequence >= 0
        when = f"{status.time:.2f} s: " if is_ticking else ""
        mode = CommandMode(status.mode).name.lower()
        words = f"{when}{mode}, {status.reason}" if status.reason else f"{when}{mode}"
        kind = mode if is_ticking else f"before: {inbox.last_rejection}"
        self._tell_change("mode", kind, words)
        notice = self._receiver.notice() if is_ticking else ""
        self._tell_change("notice", notice, f"{when}{notice or 'followed again'}")
        for finding in status.findings:
            self._tell_change(finding, finding, f"{when}refuted: {finding}")
        clock = inbox.peer_clock
        if clock is not None and clock.steps:
            step = 1e-6 * clock.last_step
            line = f"{when}the vehicle's clock was set by {step:.2f} s"
            self._tell_change("clock", str(clock.steps), line)
        self._tell_progress(
            lambda: (
                f"{status.time:8.1f} s  {mode}  {inbox.accepted} states,"
                f" {inbox.lost} lost, V_v {status.volume:.3f}"
            )
        )

    def _receiver_context(self) -> Any:
        return self._receiver.GetMyContextFromRoot(self.context)


def controller_of(scenario: Scenario, bus: Bus) -> ControllerProcess:
    """Returns the process that controls a scenario's vehicle.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.
    """
    diagram = make_hardware_loop(scenario, bus)
    process = ControllerProcess(diagram, bus, scenario.duration)
    if scenario.hardware.predict:
        process.measure_prediction(scenario.vehicle.positions)
    return process


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
        name: The vehicle's, where several share a bus.
        lcm: That bus; one of its own by default.
        key: What messages are signed with; nothing by default.

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
        *,
        name: str = "",
        lcm: DrakeLcm | None = None,
        key: bytes = b"",
    ) -> None:
        self.clock = SimulatedClock()
        self.lcm = lcm or DrakeLcm("memq://")
        self._name, self._key = name, key
        self.controller: ControllerProcess | None = None
        self._scenario, self._faults = scenario, controller_faults
        self._grid, self._instant, self._tap = grid, 0, tap
        self._epoch = self.clock.now
        self.start_controller()
        self.plant = PlantProcess(scenario, self._bus(vehicle_faults))
        self._exchange()

    def start_controller(self) -> None:
        """Starts a controller, or another one, which knows nothing of the first."""
        bus = self._bus(self._faults)
        if self._tap is not None:
            bus.taps.append(self._tap)
        self.controller = controller_of(self._scenario, bus)

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

    def _bus(self, faults: LinkFaults | None) -> Bus:
        return Bus(self.lcm, self.clock, faults, name=self._name, key=self._key)

    def _exchange(self) -> None:
        if self.controller is not None:
            self.controller.step()
        self.plant.bus.poll()
