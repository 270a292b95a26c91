"""ControllerProcess: a hardware loop driven by states; InProcess: with its vehicle."""

from __future__ import annotations

from collections.abc import Callable
import math
import time
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.errors import ModelError, naming_user_code
from vcbf_drake.hil.bus import Bus, LinkFaults, Neighbours, SimulatedClock, Tap
from vcbf_drake.hil.command_sender import (
    CommandSender,
    ControllerRecord,
    trouble_of_filter,
)
from vcbf_drake.hil.controller_side import make_hardware_loop
from vcbf_drake.hil.decoding import CommandMode, VehicleMode
from vcbf_drake.hil.messages import vcbf_status
from vcbf_drake.hil.processes import (
    HardwareProcess,
    PlantProcess,
    arrivals,
    say_farewell,
)
from vcbf_drake.hil.state_receiver import StateReceiver
from vcbf_drake.hil.timing import median_and_p99
from vcbf_drake.safety import (
    FilterStatus,
    chebyshev_ball,
    emptiness_certificate,
    inscribed_ellipsoid,
)
from vcbf_drake.safety.projection import nearest_point
from vcbf_drake.simulation.scenario import Scenario


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


# What a hardware loop consists of, and what adds it.
_NEEDED = {
    "state_receiver": "a VehicleLink adds it",
    "command_sender": "VehicleLink.answer adds it, before the diagram is built",
}


# How long every row must be satisfied before that is told [us].
_TO_RECOVER = 1_000_000


class ControllerProcess(HardwareProcess):
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

    Raises:
        ModelError: The diagram is no hardware loop.
    """

    def __init__(self, diagram: Diagram, bus: Bus, duration: float = math.inf) -> None:
        super().__init__(bus)
        self.diagram, self.duration = diagram, duration
        named = self.diagram.GetSubsystemByName
        for name, remedy in _NEEDED.items():
            if not diagram.HasSubsystemNamed(name):
                raise ModelError(f"the diagram has no {name}: {remedy}")
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
        self._sent_at = self._troubled_at = 0
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

    def run(self, patience: float = math.inf) -> None:
        """Runs until its vehicle ends, the duration is over, or `stop`.

        Args:
            patience: How long to wait for a first state [s].
        """
        if self._session == 0:
            self._forget_the_start(self._receiver.inbox)
            self.bus.begin_session()  # Later than that of whom it takes over from.
        self._sender.takes_over = self.takes_over
        if not self._wait_for_state(patience):
            return
        while not (self._stopping or self._is_over()):
            self._go_on()
        if self._stopping:
            self.ending = "stopped"
        elif self._is_infeasible():
            self.ending = "infeasible"
        self._sender.ending = True
        say_farewell(self._send)

    def _wait_for_state(self, patience: float) -> bool:
        """Sends a status until a state comes; returns whether not in vain."""
        began = self.bus.clock.utime()
        neighbours = Neighbours(self.bus, "VCBF_STATE")
        while self._session == 0 and not self._stopping:
            self._go_on()
            self._tell_neighbours(neighbours, began)
            waited = self.bus.clock.utime() - began
            if self._session == 0 and waited > 1e6 * patience:
                self.ending = "no peer"
                self.tell(f"no vehicle was heard for {patience:g} s")
                return False
        return True

    def _go_on(self) -> None:
        self.bus.wait(self.bus.clock.utime() + self._period)
        self.step()
        self._say()

    def step(self) -> None:
        """Acts on the newest state; in a long silence, sends what the watchdog says."""
        self.bus.poll()
        if self._is_due():
            with naming_user_code(lambda: self.time):
                self._tick()
        elif self._sender.states_are_old() and self._has_been_silent():
            self._send()

    def report(self) -> dict[str, Any]:
        """Returns what the filter did, and how the states arrived."""
        return {
            **self._record.report(),
            "deadlines_missed": self._sender.deadlines_missed,
            "round_trip_ms": median_and_p99(self._receiver.round_trip.milliseconds),
            "arrived": arrivals(self._receiver.inbox),
        }

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
        # With APPLY, what there is to say has lines of its own.
        is_said = status.reason and status.mode != CommandMode.APPLY
        words = f"{when}{mode}, {status.reason}" if is_said else f"{when}{mode}"
        kind = mode if is_ticking else f"before: {inbox.last_rejection}"
        self._tell_change("mode", kind, words)
        notice = self._receiver.notice() if is_ticking else ""
        self._tell_change("notice", notice, f"{when}{notice or 'followed again'}")
        if status.mode == CommandMode.APPLY:
            self._say_trouble(status, when)
        for finding in status.findings:
            self._tell_change(finding, finding, f"{when}refuted: {finding}")
        if status.refused_intervals:
            line = f"{when}the state jumped, by more than any declared disturbance does"
            self._tell_change("jump", "jump", line)
        clock = inbox.peer_clock
        if clock is not None and clock.steps:
            step = 1e-6 * clock.last_step
            line = f"{when}the vehicle's clock was set by {step:.2f} s"
            self._tell_change("clock", str(clock.steps), line)
        self._tell_progress(
            lambda: (
                f"{status.time:8.1f} s  {mode}  {inbox.accepted} states,"
                f" {inbox.lost} lost, V_v {status.volume:.3f}"
            ),
            self._sender.deadlines_missed,
            self._sender.period,
        )

    def _say_trouble(self, status: vcbf_status, when: str) -> None:
        """Tells what the filter could not do, if it could for a second before."""
        now = self.bus.clock.utime()
        trouble = trouble_of_filter(status.filter_status, status.conflicts)
        if trouble:
            self._troubled_at = now
            self._tell_change("filter", "in trouble", f"{when}{trouble}")
        elif now - self._troubled_at > _TO_RECOVER:
            self._tell_change("filter", "", f"{when}every row is satisfied again")

    def _receiver_context(self) -> Any:
        return self._receiver.GetMyContextFromRoot(self.context)


def controller_of(scenario: Scenario, bus: Bus) -> ControllerProcess:
    """Returns the process that controls a scenario's vehicle.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.
    """
    diagram = make_hardware_loop(scenario, bus)
    return ControllerProcess(diagram, bus, scenario.duration)


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
