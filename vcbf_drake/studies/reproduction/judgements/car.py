"""Figures 3 and 4: the car."""

from __future__ import annotations

from vcbf_drake.studies.reproduction.judgements.finding import Data, Finding
from vcbf_drake.studies.reproduction.judgements.numbers import (
    arrives,
    collides,
    summary_of,
)
from vcbf_drake.studies.reproduction.judgements.words import (
    ending,
    least_square,
    proportion,
)
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT, failed

ROBUST, NOMINAL = "robust-cbf-qp", "cbf-qp"


def car_avoids(data: Data) -> Finding:
    """Figure 3: the proposed filter avoids the obstacle and arrives."""
    own = summary_of(data["car_1"]["runs"], WITH)
    return Finding(arrives(own), True, f"{ending(own)}, {least_square(own)}")


def robust_goes_wide(data: Data) -> Finding:
    """Figure 3: the robust filter avoids it with a much larger distance."""
    own, robust = (summary_of(data["car_1"]["runs"], m) for m in (WITH, ROBUST))
    return Finding(
        not failed(robust) and robust["min_barrier"] > own["min_barrier"],
        True,
        f"{ROBUST}: {least_square(robust)}, {ending(robust)};"
        f" {WITH}: {least_square(own)}",
    )


def car_collides(data: Data) -> Finding:
    """Figure 3: the nominal filter collides."""
    nominal = summary_of(data["car_1"]["runs"], NOMINAL)
    return Finding(
        collides(nominal), True, f"{ending(nominal)}, {least_square(nominal)}"
    )


def all_gains_stay_feasible(data: Data) -> Finding:
    """Figure 4: with the volume barrier the QP is feasible at all five gains."""
    safe = {gain: not failed(s) for gain, s in _gains(data, WITH).items()}
    number = f"{sum(safe.values())} of {len(safe)} gains"
    if "population_car" not in data:
        return Finding(all(safe.values()), True, number)
    rate = data["population_car"]["rates"]["dob-vcbf-qp fails"]
    return Finding(
        all(safe.values()),
        rate["count"] == 0,
        f"{number}; fails in {proportion(rate)} of random courses and gains",
    )


def all_gains_arrive(data: Data) -> Finding:
    """Figure 4: with the volume barrier the target is reached at all five gains."""
    summaries = _gains(data, WITH)
    late = [gain for gain, summary in summaries.items() if not arrives(summary)]
    number = f"{len(summaries) - len(late)} of {len(summaries)} gains"
    for gain in late:
        summary = summaries[gain]
        number += f"; {gain}: {ending(summary)}, {summary['final_distance']:.1f} m off"
    return Finding(not late, True, number)


def slow_car_stops(data: Data) -> Finding:
    """Figure 4: without the volume barrier k_p = 0.2 soon makes the QP infeasible."""
    summaries = _gains(data, WITHOUT)
    slow = summaries["k_p=0.2"]
    others = [s for gain, s in summaries.items() if gain != "k_p=0.2"]
    number = (
        f"{ending(slow)}; the other gains: {sum(map(failed, others))} of"
        f" {len(others)} fail"
    )
    holds = slow["outcome"] == "infeasible"
    if "population_car" not in data:
        return Finding(holds, True, number)
    rate = data["population_car"]["by_gain"]["0.2"]["rates"]["dob-cbf-qp fails"]
    return Finding(
        holds,
        rate["rate"] == 1.0,
        f"{number}; at k_p = 0.2 it fails in {proportion(rate)} of random courses",
    )


def _gains(data: Data, method: str) -> dict[str, Data]:
    runs = data["car_2"]["runs"]
    return {gain: summary_of(methods, method) for gain, methods in runs.items()}
