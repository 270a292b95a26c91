"""What each half of a run on hardware came to, in numbers."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any, TypedDict

import numpy as np
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.checks import Array
from vcbf_drake.hil.decoding import CommandMode, VehicleMode
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.hil.messages import vcbf_status
from vcbf_drake.hil.state_receiver import StateReceiver
from vcbf_drake.hil.timing import median_and_p99
from vcbf_drake.hil.vehicle_side import CommandReceiver
from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation.collision_monitor import CollisionMonitor
from vcbf_drake.simulation.loop import COLLISION_MONITOR, LOG_PREFIX
from vcbf_drake.simulation.scenario import Scenario

_REMEMBERED = 65_536


class ModeChange(TypedDict):
    """When something else began, and why.

    Attributes:
        time: Since the motion began [s].
        mode: What began: the name of a `CommandMode` or `VehicleMode`.
        reason: Why; empty where the mode says it all.
    """

    time: float
    mode: str
    reason: str


class ControllerRecord:
    """Collects what the filter did, tick by tick, in bounded memory.

    Attributes:
        ticks: How many, by what the filter did.
        least_volume: The least V_v.
        greatest_slack: The greatest abs(slack).
        durations: How long the last ticks took, from state to command [s].
        method: The filter's.
        findings: What the measurements refuted, and at how many ticks.
        refused_intervals: Those that the observer passed over.
        changes: What was asked of the vehicle, in time; the last 1000 changes.
        real_time_rate: How fast the vehicle's time goes, by the clock.
    """

    def __init__(self) -> None:
        self.ticks: Counter[FilterStatus] = Counter()
        self.method = ""
        self.findings: Counter[str] = Counter()
        self.refused_intervals = 0
        self.least_volume = np.inf
        self.greatest_slack = 0.0
        self.durations: deque[float] = deque(maxlen=_REMEMBERED)
        self.changes: deque[ModeChange] = deque(maxlen=1000)
        self.real_time_rate: float | None = None
        self._start: tuple[float, int] | None = None

    def add_tick(self, status: vcbf_status | None, duration: float) -> None:
        """Adds a tick that took so long [s], and what it sent."""
        if status is None:
            return
        self._add_time(status.time, status.utime)
        self.ticks[FilterStatus(status.filter_status)] += 1
        self.least_volume = float(np.fmin(self.least_volume, status.volume))
        self.greatest_slack = float(np.fmax(self.greatest_slack, abs(status.slack)))
        self.durations.append(duration)
        self.method = status.method
        self.findings.update(status.findings)
        self.refused_intervals = max(self.refused_intervals, status.refused_intervals)

    def _add_time(self, time: float, utime: int) -> None:
        # The vehicle's time stands at 0 while it waits, and begins anew with it.
        if self._start is None or time <= self._start[0]:
            self._start, self.real_time_rate = (time, utime), None
        elif utime > self._start[1]:
            elapsed = 1e-6 * (utime - self._start[1])
            self.real_time_rate = (time - self._start[0]) / elapsed

    def add_mode(self, status: vcbf_status) -> None:
        """Adds what was asked of the vehicle, if that is new."""
        mode = CommandMode(status.mode).name.lower()
        if not self.changes or self.changes[-1]["mode"] != mode:
            self.changes.append(
                ModeChange(time=status.time, mode=mode, reason=status.reason)
            )


def controller_report(
    receiver: StateReceiver, record: ControllerRecord
) -> dict[str, Any]:
    """Returns what the filter did, and how the states arrived.

    Args:
        receiver: Took the states.
        record: Of the ticks.
    """
    ticks = sum(record.ticks.values())
    return {
        "method": record.method,
        "ticks": ticks,
        "infeasible_ticks": record.ticks[FilterStatus.INFEASIBLE],
        "failed_ticks": record.ticks[FilterStatus.FAILED],
        "min_volume": record.least_volume if ticks else None,
        "max_abs_slack": record.greatest_slack,
        "real_time_rate": record.real_time_rate,
        "tick_ms": median_and_p99(1e3 * np.array(record.durations)),
        "round_trip_ms": median_and_p99(receiver.round_trip.milliseconds),
        "arrived": _arrived(receiver.inbox),
        "refused_intervals": record.refused_intervals,
        "findings": dict(record.findings),
        "changes": list(record.changes),
    }


def plant_report(
    scenario: Scenario, diagram: Diagram, context: Context, collided: bool
) -> dict[str, Any]:
    """Returns what the motion came to, and how the commands arrived.

    Args:
        scenario: What was run.
        diagram: The vehicle.
        context: Its context, at the end.
        collided: Whether a barrier became negative.
    """
    receiver: CommandReceiver = diagram.GetSubsystemByName("command_receiver")
    monitor: CollisionMonitor = diagram.GetSubsystemByName(COLLISION_MONITOR)
    times, path = _log(diagram, context, "path")
    target = np.array(scenario.target)
    distance = np.linalg.norm(scenario.vehicle.positions(path) - target, axis=1)
    arrived = distance <= scenario.arrival_tolerance
    reached_at = float(times[np.argmax(arrived)]) if arrived.any() else None
    heights = monitor.barrier_set.values_along(path, times)
    outcome = "timeout" if reached_at is None else "reached"
    changes = _vehicle_changes(*_log(diagram, context, "mode"))
    has_moved = any(change["mode"] != "waiting" for change in changes)
    return {
        "scenario": scenario.name,
        "outcome": "collision" if collided else outcome if has_moved else None,
        "time": float(context.get_time()),
        "reached_at": reached_at,
        "final_distance": float(distance[-1]),
        "min_barrier": float(np.nanmin(heights, initial=np.inf)),
        "round_trip_ms": median_and_p99(receiver.round_trip.milliseconds),
        "arrived": _arrived(receiver.inbox),
        "changes": changes,
    }


def _arrived(inbox: Inbox) -> dict[str, Any]:
    clock = inbox.peer_clock
    return {
        "clock_offset_ms": None if clock is None else 1e-3 * clock.offset,
        "clock_steps": 0 if clock is None else clock.steps,
        "accepted": inbox.accepted,
        "lost": inbox.lost,
        "late": inbox.late,
        "rejected": {reason.value: count for reason, count in inbox.rejections.items()},
    }


def _vehicle_changes(times: Array, modes: Array) -> list[ModeChange]:
    found: list[ModeChange] = []
    for time, code in zip(times.tolist(), modes[:, 0].tolist(), strict=True):
        mode = VehicleMode(int(code)).name.lower()
        if not found or found[-1]["mode"] != mode:
            found.append(ModeChange(time=time, mode=mode, reason=""))
    return found


def _log(diagram: Diagram, context: Context, name: str) -> tuple[Array, Array]:
    log = diagram.GetSubsystemByName(LOG_PREFIX + name).FindLog(context)
    return log.sample_times().copy(), log.data().T.copy()
