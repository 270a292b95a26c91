"""ControllerProcess: a hardware loop driven by the arriving states."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
import math
import time
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.errors import ModelError, naming_user_code
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.command_sender import CommandSender, trouble_of_filter
from vcbf_drake.hil.inbox import CommandMode, VehicleMode
from vcbf_drake.hil.messages import vcbf_status
from vcbf_drake.hil.processes import (
    HardwareProcess,
    median_and_p99,
    say_farewell,
)
from vcbf_drake.hil.receivers import StateReceiver
from vcbf_drake.safety import (
    FilterStatus,
    chebyshev_ball,
    emptiness_certificate,
    inscribed_ellipsoid,
)
from vcbf_drake.safety.projection import nearest_point


def warm_up(num_inputs: int) -> None:
    """Solves one problem of every kind that a filter solves.

    The first problem of a kind loads its solver, which takes up to half a second: long
    enough for a vehicle to fall back.

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


class _Record:
    """The record of ticks and sent messages, in bounded memory."""

    def __init__(self) -> None:
        self._ticks: Counter[FilterStatus] = Counter()
        self._findings: Counter[str] = Counter()
        self._durations: deque[float] = deque(maxlen=65_536)
        self._method, self._refused_intervals = "", 0
        self._least_volume, self._greatest_slack = np.inf, 0.0

    def add_tick(self, status: vcbf_status | None, duration: float) -> None:
        """Adds a tick with its computing time [s] and its messages."""
        if status is None:
            return
        self._ticks[FilterStatus(status.filter_status)] += 1
        self._least_volume = float(np.fmin(self._least_volume, status.volume))
        self._greatest_slack = float(np.fmax(self._greatest_slack, abs(status.slack)))
        self._durations.append(duration)
        self._method = status.method
        self._findings.update(status.findings)
        self._refused_intervals = max(self._refused_intervals, status.refused_intervals)

    def report(self) -> dict[str, Any]:
        """Returns the report of the filter."""
        ticks = self._ticks.total()
        return {
            "method": self._method,
            "ticks": ticks,
            "infeasible_ticks": self._ticks[FilterStatus.INFEASIBLE],
            "failed_ticks": self._ticks[FilterStatus.FAILED],
            "min_volume": self._least_volume if ticks else None,
            "max_abs_slack": self._greatest_slack,
            "tick_ms": median_and_p99(1e3 * np.array(self._durations)),
            "refused_intervals": self._refused_intervals,
            "findings": dict(self._findings),
        }


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
        self._period = round(1e6 * self._sender.period)  # [us]
        warm_up(named("filter").model.num_inputs)
        # One tick without effect comes first: the first tick of a diagram is slow.
        self.diagram.EvalUniquePeriodicDiscreteUpdate(
            self.diagram.CreateDefaultContext()
        )
        self.context = self.diagram.CreateDefaultContext()
        self.tick_taps: list[Callable[[Context], None]] = []
        self.takes_over = False
        self._record = _Record()
        self._sent_at = self._starved = 0
        self._session, self._began = 0, 0.0

    @property
    def time(self) -> float:
        """The time of the last answered state [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> CommandMode | None:
        """The mode requested of the vehicle last, None before the first tick."""
        status = self._sender.last_status
        if status is None or status.state_sequence < 0:
            return None
        return CommandMode(status.mode)

    def _run(self, patience: float) -> None:
        if self._session == 0:
            self._forget_the_start(self._receiver.inbox)
            self.bus.begin_session()  # Later than that of whom it takes over from.
        self._sender.takes_over = self.takes_over
        if not self._wait_for_peer(self._go_on, lambda: self._session > 0, patience):
            return
        while not (self._stopping or self._is_over()):
            self._go_on()
        status = self._sender.last_status
        if self._stopping:
            self.ending = "stopped"
        elif status and status.filter_status == FilterStatus.INFEASIBLE:
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
        """Returns the report of the filter and of the states' arrival."""
        return {
            **self._record.report(),
            "changes": list(self.changes),
            "deadlines_missed": self._sender.deadlines_missed,
            "round_trip_ms": median_and_p99(self._receiver.inbox.round_trips),
            "arrived": self._receiver.inbox.report(),
        }

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
            # Of the periods since, those with a state were missed here, and without one
            # by the vehicle.
            periods = max(1, round(1e6 * (newest.time - last.time) / self._period))
            sent = min(periods, int(newest.sequence - last.sequence))
            self._sender.deadlines_missed += sent - 1
            self._starved += periods - sent
        else:
            self._session, self._began = int(newest.session), newest.time
        for tap in self.tick_taps:
            tap(self.context)
        self.context.SetDiscreteState(
            self.diagram.EvalUniquePeriodicDiscreteUpdate(self.context)
        )
        self._send()
        self._record.add_tick(self._sender.last_status, time.perf_counter() - started)

    def _send(self) -> None:
        """Sends a status, and after the first tick also a command."""
        self.diagram.ForcedPublish(self.context)
        self._sent_at = self.bus.clock.utime()
        self._note_sent()

    def _note_sent(self) -> None:
        """Records the request to the vehicle, after the first tick."""
        status = self._sender.last_status
        if status is not None and status.state_sequence >= 0:
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
        if status is None:
            return
        is_ticking = status.state_sequence >= 0
        when = f"{status.time:.2f} s: " if is_ticking else ""
        mode = CommandMode(status.mode).name.lower()
        # With APPLY, other lines report the details.
        is_said = status.reason and status.mode != CommandMode.APPLY
        words = f"{when}{mode}, {status.reason}" if is_said else f"{when}{mode}"
        kind = mode if is_ticking else f"before: {inbox.last_rejection}"
        self._tell_change("mode", kind, words)
        notice = self._receiver.notice() if is_ticking else ""
        self._tell_change("notice", notice, f"{when}{notice or 'followed again'}")
        if status.mode == CommandMode.APPLY:
            trouble = trouble_of_filter(status.filter_status, status.conflicts)
            line = f"{when}{trouble or 'every row is satisfied again'}"
            self._tell_change("filter", "in trouble" if trouble else "", line)
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
            self._sender.period,
            ours=self._sender.deadlines_missed,
            theirs=self._starved,
        )
