"""The summary of a run: the numbers that runs are compared by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram

from vcbf_drake.add_safety_filter import LOOP_MONITOR
from vcbf_drake.between_ticks import certified_least_barrier, is_certifiable
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.safety import Assumption, FilterStatus, SafetyFilter
from vcbf_drake.simulation.audit import (
    BETWEEN_TICKS,
    FEASIBILITY,
    FEASIBILITY_HYPOTHESES,
    KNOWLEDGE,
    LEAST_AUTHORITY,
    ROUNDING,
    audit_findings,
    authority,
    reasons_against,
)
from vcbf_drake.simulation.collision_monitor import COLLISION_MONITOR
from vcbf_drake.simulation.faults import fault_assumptions
from vcbf_drake.simulation.fleet import OTHERS, others_finding
from vcbf_drake.simulation.scenario import Scenario


@dataclass(frozen=True)
class Ending:
    """The ending of a simulation.

    Attributes:
        time: When [s].
        monitor: The name of the monitor that ended it; empty at the planned end.
    """

    time: float
    monitor: str


def summarise(
    scenario: Scenario,
    safety_filter: SafetyFilter,
    log: Mapping[str, Array],
    path: Mapping[str, Array],
    ending: Ending,
) -> dict[str, Any]:
    """Returns the summary of a run, without assumptions, audit and timings.

    Args:
        scenario: The scenario of the run.
        safety_filter: The filter that ran.
        log: The arrays of the log, one row a control tick.
        path: The motion at the integrator's steps, as in `RunLog.path`.
        ending: The ending of the run.
    """
    infeasible = log["status"] == FilterStatus.INFEASIBLE
    infeasible_at = _first(log["time"], infeasible)
    collided_at = None
    if ending.monitor == COLLISION_MONITOR:
        collided_at = _crossing(path)
    reached_at, final_distance = arrival(scenario, path)
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
        "min_barrier": _least(path["least_height"]),
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


def judge(
    scenario: Scenario,
    diagram: Diagram,
    log: Mapping[str, Array],
    path: Mapping[str, Array],
    found: Sequence[Assumption],
    ending: Ending,
) -> dict[str, Any]:
    """Returns the summary of a simulated run, with its assumptions and audit.

    Args:
        scenario: See `summarise`.
        diagram: The vehicle's loop.
        log: See `summarise`.
        path: See `summarise`.
        found: The hypotheses at the start.
        ending: See `summarise`.
    """
    safety_filter: SafetyFilter = diagram.GetSubsystemByName("filter")
    summary = summarise(scenario, safety_filter, log, path, ending)
    is_estimated = safety_filter.method.disturbance == "estimated"
    observer = diagram.GetSubsystemByName("filter_observer") if is_estimated else None
    audit = audit_findings(log, path, scenario.volume.gain, observer)
    has_others = diagram.HasSubsystemNamed("other_vehicles")
    if has_others:
        audit[OTHERS] = others_finding(log, scenario)
    collided, certified = summary["outcome"] == "collision", None
    broken = {name for name, each in audit.items() if each["held"] is False}
    if not (has_others or broken & {*KNOWLEDGE}):
        certified = _certified_least(scenario, diagram, found, log, ending)
    reasons = reasons_against(found, audit, collided)
    # Whether the margin that was asked for gave way, and it mattered.
    if scenario.between_ticks == "certified" and (certified or 0.0) < -ROUNDING:
        reasons.append(f"not certified: {BETWEEN_TICKS}")
    summary |= {
        "assumptions": [vars(each) for each in found],
        "audit": audit,
        "certified_min_barrier": certified,
        "reasons_against": reasons,
        "guaranteed": not reasons,
    }
    if safety_filter.gate is not None:
        faults = fault_assumptions(scenario.faults, scenario.noise.std)
        asked = {*FEASIBILITY_HYPOTHESES, OTHERS, *(each.name for each in faults)}
        reasons = reasons_against(
            [each for each in found if each.name in asked],
            {name: each for name, each in audit.items() if name in FEASIBILITY},
            collided,
        )
        summary["reasons_against_feasible"] = reasons
        summary["guaranteed_feasible"] = not reasons
    return summary


def _certified_least(
    scenario: Scenario,
    diagram: Diagram,
    found: Sequence[Assumption],
    log: Mapping[str, Array],
    ending: Ending,
) -> float | None:
    """The certified lower bound of h (E87); None without a certificate."""
    if not is_certifiable(scenario, found):
        return None
    source = diagram.GetSubsystemByName("disturbance")
    # A hold that the run's end cut short counts: it is bounded for its whole period.
    holds = int(np.sum(log["time"] < ending.time))
    try:
        least = certified_least_barrier(
            diagram.GetSubsystemByName("filter"),
            log,
            holds,
            scenario.period,
            source.bounds.delta1,
        )
    except ModelError:
        return None
    return least if np.isfinite(least) else None


def arrival(
    scenario: Scenario, path: Mapping[str, Array]
) -> tuple[float | None, float]:
    """Returns when the vehicle arrived, None if never, and its last distance [s, m]."""
    away = scenario.vehicle.positions(path["state"]) - np.array(scenario.target)
    distance = np.linalg.norm(away, axis=1)
    has_arrived = distance <= scenario.arrival_distance
    return _first(path["time"], has_arrived), float(distance[-1])


def _without_authority(
    safety_filter: SafetyFilter, log: Mapping[str, Array]
) -> list[str]:
    """The barriers whose rows no input could move at some tick (R33), by name."""
    lost = np.min(authority(log), axis=0) <= LEAST_AUTHORITY
    names = safety_filter.barrier_set.names
    return [names[i] for i in np.flatnonzero(lost)]


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


def _crossing(path: Mapping[str, Array]) -> float:
    """When h became 0 or less for the last time: a little before it was found to be."""
    safe = np.flatnonzero(path["least_height"] > 0.0)
    last = safe[-1] if len(safe) else -1
    return float(path["time"][min(last + 1, len(path["time"]) - 1)])


def _least(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.min()) if len(finite) else None


def _conflict(
    safety_filter: SafetyFilter, log: Mapping[str, Array], infeasible: NDArray[np.bool_]
) -> list[str] | None:
    """The rows that exclude each other at the first infeasible tick, by name."""
    if not infeasible.any():
        return None
    tick = int(np.argmax(infeasible))
    rows = safety_filter.names_in_conflict(
        log["polytope_A"][tick], log["polytope_b"][tick]
    )
    return list(rows) or None
