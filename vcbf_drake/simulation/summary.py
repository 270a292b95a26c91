"""What a run came to, in the numbers people compare."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.add_safety_filter import LOOP_MONITOR
from vcbf_drake.checks import Array
from vcbf_drake.safety import FilterStatus, SafetyFilter
from vcbf_drake.simulation.audit import LEAST_AUTHORITY, authority
from vcbf_drake.simulation.loop import COLLISION_MONITOR
from vcbf_drake.simulation.scenario import Scenario


@dataclass(frozen=True)
class Ending:
    """How a simulation ended.

    Attributes:
        time: When [s].
        monitor: The name of the monitor that ended it; empty at the planned end.
    """

    time: float
    monitor: str


def summarise(
    scenario: Scenario,
    safety_filter: SafetyFilter,
    log: dict[str, Array],
    path_time: Array,
    path: Array,
    heights: Array,
    ending: Ending,
) -> dict[str, Any]:
    """Returns the summary of a run, without assumptions, audit and timings.

    Args:
        scenario: What was run.
        safety_filter: The filter that ran.
        log: The arrays of the log, one row a control tick.
        path_time: Times of the integrator's steps, (S,) [s].
        path: The true state there, (S, n).
        heights: The least h there, (S,), or every one, (S, N).
        ending: How it ended.
    """
    infeasible = log["status"] == FilterStatus.INFEASIBLE
    infeasible_at = _first(log["time"], infeasible)
    collided_at = None
    if ending.monitor == COLLISION_MONITOR:
        collided_at = _crossing(path_time, heights)
    reached_at, final_distance = arrival(scenario, path_time, path)
    stopped = ending.monitor.endswith(LOOP_MONITOR)
    backup = log.get("backup", np.zeros((1, 2)))
    slack, fidelity = np.abs(log["slack"]), scenario.fidelity
    return {
        "scenario": scenario.name,
        "method": scenario.method,
        "fidelity": fidelity if isinstance(fidelity, str) else "custom",
        "outcome": _outcome(collided_at, stopped, int(log["status"][-1]), reached_at),
        "running_time": min(
            t for t in (infeasible_at, collided_at, ending.time) if t is not None
        ),
        "reached_at": reached_at,
        "infeasible_at": infeasible_at,
        "collided_at": collided_at,
        "conflict": _conflict(safety_filter, log, infeasible),
        "min_barrier": _least(heights),
        "volume_measure": scenario.volume.label,
        "min_volume": _least(log["volume"]),
        "max_abs_slack": float(slack.max()),
        "slack_active_fraction": float(np.mean(slack > 0.0)),
        "ticks": len(log["status"]),
        "final_status": int(log["status"][-1]),
        "relaxed_ticks": int(np.sum(log["status"] == FilterStatus.RELAXED)),
        "infeasible_ticks": int(np.sum(infeasible)),
        "decayed_ticks": int(np.sum(log["decay"] > 1.0)),
        "backup_ticks": int(np.sum(backup[:, 0] > 0.0)),
        "failed_ticks": int(np.sum(log["status"] == FilterStatus.FAILED)),
        "rows_without_authority": _without_authority(safety_filter, log),
        "final_distance": final_distance,
    }


def arrival(
    scenario: Scenario, times: Array, path: Array
) -> tuple[float | None, float]:
    """Returns when the vehicle arrived, None if never, and its last distance [s, m].

    Args:
        scenario: What was run.
        times: Times of the integrator's steps, (S,) [s].
        path: The true state there, (S, n).
    """
    away = scenario.vehicle.positions(path) - np.array(scenario.target)
    distance = np.linalg.norm(away, axis=1)
    return _first(times, distance <= scenario.arrival_distance), float(distance[-1])


def _without_authority(safety_filter: SafetyFilter, log: dict[str, Array]) -> list[str]:
    """The barriers whose rows no input could move at some tick (R33), by name."""
    lost = np.min(authority(log), axis=0) <= LEAST_AUTHORITY
    return [
        name
        for name, is_lost in zip(
            safety_filter.barrier_set.names, np.atleast_1d(lost), strict=True
        )
        if is_lost
    ]


def _outcome(
    collided_at: float | None, stopped: bool, status: int, reached_at: float | None
) -> str:
    if collided_at is not None:
        return "collision"
    if stopped:
        return "failed" if status == FilterStatus.FAILED else "infeasible"
    return "timeout" if reached_at is None else "reached"


def _first(times: Array, condition: NDArray[np.bool_]) -> float | None:
    hits = np.flatnonzero(condition)
    return float(times[hits[0]]) if len(hits) else None


def _crossing(times: Array, heights: Array) -> float:
    """When h became 0 or less for the last time: a little before it was found to be."""
    is_safe = np.fmin.reduce(heights.reshape(len(times), -1), axis=1) > 0.0
    last = np.flatnonzero(is_safe)[-1] if is_safe.any() else -1
    return float(times[min(last + 1, len(times) - 1)])


def _least(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.min()) if len(finite) else None


def _conflict(
    safety_filter: SafetyFilter, log: dict[str, Array], infeasible: NDArray[np.bool_]
) -> list[str] | None:
    """The rows that exclude each other at the first infeasible tick, by name."""
    if not infeasible.any():
        return None
    tick = int(np.argmax(infeasible))
    rows = safety_filter.row_names.in_conflict(
        log["polytope_A"][tick], log["polytope_b"][tick]
    )
    return list(rows) or None
