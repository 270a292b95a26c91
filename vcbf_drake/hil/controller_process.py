"""ControllerProcess: a hardware loop driven by the arriving states."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
import math
import re
import time
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.errors import ModelError, naming_user_code
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.command_sender import CommandSender
from vcbf_drake.hil.formats import CommandMode, VehicleMode
from vcbf_drake.hil.processes import (
    HardwareProcess,
    median_and_p99,
    say_farewell,
)
from vcbf_drake.hil.receivers import StateReceiver, StateStamp
from vcbf_drake.safety import (
    FilterStatus,
    SafetyFilter,
    chebyshev_ball,
    emptiness_certificate,
    inscribed_ellipsoid,
)
from vcbf_drake.safety.projection import nearest_point

# Of a control period and of the input's range, what rounding is: in a state's time
# stamp, and in the difference of two integrals.
_ROUNDING = 1e-6


def warm_up(num_inputs: int) -> None:
    """Solves one problem of every kind that a filter solves, for m inputs.

    The first problem of a kind loads its solver, which takes up to half a second: long
    enough for a vehicle to fall back.
    """
    m = num_inputs
    A = np.concatenate([np.eye(m), -np.eye(m), np.full((1, m), m**-0.5)])
    b = np.append(np.ones(2 * m), 0.1)
    nearest_point(A, b, np.full(m, 2.0))
    inscribed_ellipsoid(A, b)
    chebyshev_ball(A, b)
    emptiness_certificate(A, -b)


class ControllerProcess(HardwareProcess):
    """Drives a hardware loop: one tick for every arriving state.

    The loop's time is the time of the state, so the observer's intervals are the
    vehicle's, for any delays of the bus. A vehicle that sends faster than the control
    period is sampled. Without states, it sends a status once per control period, and
    after the first state also commands, as the watchdogs decide.

    Args:
        diagram: A hardware loop: a `VehicleLink` and the systems connected to it.
        bus: Carries the messages.
        duration: The duration of control in the vehicle's time [s].

    Attributes:
        diagram: The hardware loop.
        duration: See the argument.
        context: Its context.
        tick_taps: Called with the context at every tick, before its discrete state
            changes.
        takes_over: Whether the vehicle is requested from another controller.

    Raises:
        ModelError: The diagram is not a hardware loop.
    """

    def __init__(self, diagram: Diagram, bus: Bus, duration: float = math.inf) -> None:
        super().__init__(bus, "vehicle", "VCBF_STATE")
        self.diagram, self.duration = diagram, duration
        if not diagram.HasSubsystemNamed("command_sender"):
            remedy = "VehicleLink.answer adds it, before the diagram is built"
            raise ModelError(f"the diagram has no command_sender: {remedy}")
        named = diagram.GetSubsystemByName
        self._receiver: StateReceiver = named("state_receiver")
        self._sender: CommandSender = named("command_sender")
        self._filter: SafetyFilter = named("filter")
        self._period = round(1e6 * self._sender.period)  # [us]
        warm_up(self._filter.model.num_inputs)
        # One tick without effect comes first: the first tick of a diagram is slow.
        self.diagram.EvalUniquePeriodicDiscreteUpdate(
            self.diagram.CreateDefaultContext()
        )
        self.context = self.diagram.CreateDefaultContext()
        self.tick_taps: list[Callable[[Context], None]] = []
        self.takes_over = False
        self._sent_at = self._starved = 0
        self._session, self._began = 0, 0.0
        # For the report.
        self._ticks, self._findings = Counter[FilterStatus](), Counter[str]()
        self._durations: deque[float] = deque(maxlen=65_536)
        self._least_volume, self._greatest_slack = math.inf, 0.0
        self._intervals = self._inexact = self._planless = self._refused_intervals = 0

    @property
    def time(self) -> float:
        """The time of the last answered state [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> CommandMode | None:
        """The mode requested of the vehicle last, None before the first tick."""
        status = self._sender.last_status
        return CommandMode(status.mode) if status.state_sequence >= 0 else None

    def _run(self, patience: float) -> None:
        if self._session == 0:
            self.bus.poll()  # There was no subscriber before: nothing is lost.
            self._receiver.inbox.begin_anew()
            self.bus.begin_session()  # Later than that of whom it takes over from.
        self._sender.takes_over = self.takes_over
        if not self._wait_for_peer(self._go_on, lambda: self._session > 0, patience):
            return
        while not (self._stopping or self._is_over()):
            self._go_on()
        status = self._sender.last_status
        if self._stopping:
            self.ending = "stopped"
        elif status.filter_status == FilterStatus.INFEASIBLE:
            self.ending = "infeasible"

    def _say_farewell(self) -> None:
        """Requests the fallback of a vehicle that was commanded."""
        if self._session > 0:
            self._sender.ending = True
            context = self._sender.GetMyContextFromRoot(self.context)
            say_farewell(lambda: self._sender.ForcedPublish(context))
            self._note_sent()

    def _go_on(self) -> None:
        self.bus.wait(self.bus.clock.utime() + self._period)
        self.step()
        self._say()

    def step(self) -> None:
        """Acts on the newest state; in a long silence, sends the watchdog's request."""
        self.bus.poll()
        if self._is_due():
            with naming_user_code(lambda: self.time):
                self._tick()
        elif self._receiver.verdict().mode is not CommandMode.APPLY:
            if self.bus.clock.utime() - self._sent_at >= self._period:
                self._send()

    def report(self) -> dict[str, Any]:
        """Returns the report of the filter and of the states' arrival.

        With the policy ``backup`` it has `reasons_against_feasible`, and whether the
        run is `guaranteed_feasible`: False, or None, for nobody here knows the truth.
        """
        ticks = self._ticks.total()
        report: dict[str, Any] = {
            "method": self._filter.settings.method,
            "ticks": ticks,
            "infeasible_ticks": self._ticks[FilterStatus.INFEASIBLE],
            "failed_ticks": self._ticks[FilterStatus.FAILED],
            "min_volume": self._least_volume if ticks else None,
            "max_abs_slack": self._greatest_slack,
            "tick_ms": median_and_p99(1e3 * np.array(self._durations)),
            "refused_intervals": self._refused_intervals,
            "findings": dict(self._findings),
            "changes": list(self.changes),
            "deadlines_missed": self._sender.deadlines_missed,
            "round_trip_ms": median_and_p99(self._receiver.inbox.round_trips),
            "arrived": self._receiver.inbox.report(),
        }
        if self._filter.gate is not None:
            reasons = []
            if self._inexact:
                of = f"{self._inexact} of {self._intervals} intervals"
                reasons.append(f"exact periods: {of} were no period of one command")
            if self._planless:
                reasons.append(f"certified plan: {self._planless} ticks had none")
            report["reasons_against_feasible"] = reasons
            report["guaranteed_feasible"] = False if reasons else None
        return report

    def _is_due(self) -> bool:
        context = self._receiver.GetMyContextFromRoot(self.context)
        if not self._receiver.has_news(context):
            return False
        newest, last = self._receiver.inbox.newest, self._receiver.stamp(context)
        if newest.session != last.session or newest.time == last.time:
            return True
        return bool(newest.time - last.time > 0.9e-6 * self._period)

    def _tick(self) -> None:
        """Takes the new state, updates filter, hold and observer, and sends."""
        started, receiver = time.perf_counter(), self._receiver
        context = receiver.GetMyContextFromRoot(self.context)
        last = receiver.stamp(context)
        self.diagram.ExecuteForcedEvents(self.context, publish=False)
        newest = receiver.stamp(context)
        self.context.SetTime(newest.time)
        if newest.session == self._session:
            self._count_periods(last, newest)
        else:
            self._session, self._began = int(newest.session), newest.time
        for tap in self.tick_taps:
            tap(self.context)
        if self._filter.gate is not None:
            backup = self._filter.GetOutputPort("backup")
            at = self._filter.GetMyContextFromRoot(self.context)
            self._planless += backup.Eval(at)[1] == 0.0
        self.context.SetDiscreteState(
            self.diagram.EvalUniquePeriodicDiscreteUpdate(self.context)
        )
        self._send()
        status = self._sender.last_status
        self._ticks[FilterStatus(status.filter_status)] += 1
        self._findings.update(status.findings)
        refused = status.refused_intervals
        self._refused_intervals = max(self._refused_intervals, refused)
        self._least_volume = float(np.fmin(self._least_volume, status.volume))
        self._greatest_slack = float(np.fmax(self._greatest_slack, abs(status.slack)))
        self._durations.append(time.perf_counter() - started)

    def _count_periods(self, last: StateStamp, newest: StateStamp) -> None:
        """Counts missed periods, and intervals that are not one period of a command."""
        elapsed = 1e6 * (newest.time - last.time) / self._period
        # Of the periods since, those with a state were missed here, and without one by
        # the vehicle.
        periods = max(1, round(elapsed))
        sent = min(periods, int(newest.sequence - last.sequence))
        self._sender.deadlines_missed += sent - 1
        self._starved += periods - sent
        if elapsed == 0.0:
            return  # It waits.
        receiver, sender = self._receiver, self._sender
        applied = receiver.GetOutputPort("applied_input").Eval(
            receiver.GetMyContextFromRoot(self.context)
        )
        held = sender.GetInputPort("input").Eval(
            sender.GetMyContextFromRoot(self.context)
        )
        rounding = _ROUNDING * self._filter.input_set.scale
        is_another = bool(np.any(np.abs(applied - held) > rounding))
        self._intervals += 1
        self._inexact += is_another or abs(elapsed - 1.0) > _ROUNDING

    def _send(self) -> None:
        """Sends a status, and after the first tick also a command."""
        self.diagram.ForcedPublish(self.context)
        self._sent_at = self.bus.clock.utime()
        self._note_sent()

    def _note_sent(self) -> None:
        """Records the request to the vehicle, after the first tick."""
        status = self._sender.last_status
        if status.state_sequence >= 0:
            mode = CommandMode(status.mode).name.lower()
            self._note_mode(status.time, mode, status.reason)

    def _is_over(self) -> bool:
        newest = self._receiver.inbox.newest
        if newest is None or newest.session != self._session:
            return False  # Not the vehicle that is controlled.
        if newest.mode == VehicleMode.ENDED:
            self.ending = "vehicle ended"
        elif newest.time - self._began >= self.duration:
            self.ending = "duration"
        return bool(self.ending)

    def _say(self) -> None:
        status, inbox = self._sender.last_status, self._receiver.inbox
        is_ticking, reason = status.state_sequence >= 0, status.reason
        when = f"{status.time:.2f} s: " if is_ticking else ""
        mode = CommandMode(status.mode).name.lower()
        kind = mode if is_ticking else f"before: {inbox.last_rejection}"
        if status.mode == CommandMode.APPLY:
            self._tell_change("mode", kind, f"{when}{mode}")
            # Which rows conflict, and numbers that grow, are no news.
            kind = re.sub(r"satisfies [^;]*|\d+", "", reason)
            self._tell_change("trouble", kind, f"{when}{reason or 'all is well again'}")
        else:
            kind += "".join(status.findings)
            self._tell_change("mode", kind, f"{when}{mode}, {reason}")
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
            self._sender.period,
            ours=self._sender.deadlines_missed,
            theirs=self._starved,
        )
