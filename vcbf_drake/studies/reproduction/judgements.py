"""One function for each claim of the paper: does it hold, and by which number?

Every function reads the results alone and computes its sentence from them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT, failed

Data = Mapping[str, Any]

WANG_XU, ROBUST, NOMINAL = "wang-xu-dob-cbf-qp", "robust-cbf-qp", "cbf-qp"

# An estimate is called accurate when its error is below this share of the disturbance.
_ACCURATE = 0.02


class Finding(NamedTuple):
    """What the results say of a claim.

    Attributes:
        holds: Whether the claim holds in the main setting; None when there are too few
            trials to tell.
        everywhere: Whether it also holds in the settings that stand beside it.
        number: The numbers that say so.
    """

    holds: bool | None
    everywhere: bool
    number: str


# Test 1 ----------------------------------------------------------------------------


def nominal_collides(data: Data) -> Finding:
    """Figure 1(a): the nominal filter does not stay safe."""
    main = _summary(data["test_1"]["runs"], NOMINAL)
    steady = _steady(data, NOMINAL)
    return Finding(
        _collides(main),
        all(map(_collides, steady)),
        f"{_safety(main)}; in steady winds {_list(map(_safety, steady))}",
    )


def others_arrive(data: Data) -> Finding:
    """Figure 1(a): the three others go round the sphere and arrive."""
    methods = (WITH, WANG_XU, ROBUST)
    main = [_summary(data["test_1"]["runs"], method) for method in methods]
    steady = [summary for method in methods for summary in _steady(data, method)]
    arrivals = _list(
        f"{method} {_time(s)}" for method, s in zip(methods, main, strict=True)
    )
    safe = sum(not failed(summary) for summary in steady)
    return Finding(
        all(map(_arrives, main)),
        all(map(_arrives, steady)),
        f"{arrivals}; in steady winds {sum(map(_arrives, steady))} of {len(steady)}"
        f" runs arrive within the time and {safe} stay safe",
    )


def proposed_is_closest(data: Data) -> Finding:
    """Figure 1(b): the proposed filter has the least h of the safe ones, above 0."""

    def is_closest(runs: Data) -> bool:
        others = (_height(runs, WANG_XU), _height(runs, ROBUST))
        return 0.0 < _height(runs, WITH) < min(others)

    def heights(runs: Data, *methods: str) -> str:
        return _list(f"{m} {_height(runs, m):.3f} m" for m in methods)

    main, winds = data["test_1"]["runs"], data["test_1"]["steady_winds"]
    beside = [heights(wind["runs"], WITH, WANG_XU, ROBUST) for wind in winds]
    return Finding(
        is_closest(main),
        all(is_closest(wind["runs"]) for wind in winds),
        f"least h: {heights(main, WITH, WANG_XU, ROBUST, WITHOUT)}; in steady winds"
        f" {'; '.join(beside)}",
    )


def estimate_is_accurate(data: Data) -> Finding:
    """Figure 1(c): the RISE observer's estimate is accurate."""
    main = _relative_error(data["test_1"]["estimation"])
    number = f"error after 1 s at most {main:.2%} of the greatest disturbance"
    explicit = data.get("test_2_explicit")
    if explicit is None:
        return Finding(main < _ACCURATE, True, number)
    beside = _relative_error(explicit["explicit"]["estimation"])
    rate = explicit["observer_rate"]
    return Finding(
        main < _ACCURATE,
        beside < _ACCURATE,
        f"{number}; with the explicit step at {rate:.0f} Hz, in another wind,"
        f" {beside:.0%}",
    )


def error_bound_holds(data: Data) -> Finding:
    """Lemma 2: the error is below delta1 exp(-lambda_V t / 2) for all time."""
    estimations = [data["test_1"]["estimation"], data["test_2"]["estimation"]]
    printed = [each["above_printed_bound"] for each in estimations]
    certified = [each["above_certified_bound"] for each in estimations]
    return Finding(
        max(printed) == 0.0,
        True,
        f"exceeded at {printed[0]:.0%} and {printed[1]:.0%} of the ticks of Tests 1 and"
        f" 2; the bound certified for sampled time at {certified[0]:.0%} and"
        f" {certified[1]:.0%}",
    )


# Test 2 ----------------------------------------------------------------------------


def only_proposed_arrives(data: Data) -> Finding:
    """Figure 2(a): the proposed filter arrives, the one without volume row stops."""
    runs = data["test_2"]["runs"]
    own, other = _summary(runs, WITH), _summary(runs, WITHOUT)
    number = (
        f"{WITHOUT} {_ending(other)}, {other['final_distance']:.1f} m from the target;"
        f" {WITH} {_ending(own)}"
    )
    holds = own["outcome"] == "reached" and other["outcome"] == "infeasible"
    if "population_blimp" not in data:
        return Finding(holds, True, number)
    rates = data["population_blimp"]["rates"]
    stops, arrives = (
        rates["dob-cbf-qp fails"],
        rates["of its failures, dob-vcbf-qp reaches"],
    )
    return Finding(
        holds,
        stops["rate"] == arrives["rate"] == 1.0,
        f"{number}. Over random courses {WITHOUT} fails in {_share(stops)}; of these"
        f" {WITH} arrives in {_share(arrives)}",
    )


def slack_is_zero(data: Data) -> Finding:
    """Figure 2(b): the slack is zero all along."""
    own = _summary(data["test_2"]["runs"], WITH)["max_abs_slack"]
    printed = _summary(data["test_2"]["as_printed"], WITH)["max_abs_slack"]
    return Finding(
        own == 0.0,
        printed == 0.0,
        f"at most {own:.2g} with the exact slack,"
        f" {printed:.2g} with the printed penalty",
    )


def volume_is_higher(data: Data) -> Finding:
    """Figure 2(c): V_v of the proposed filter is always the higher."""
    volumes = data["test_2"]["volumes"]
    return Finding(
        volumes["greatest_deficit"] == 0.0,
        True,
        f"not lower at {_share(volumes['not_lower'])} of the common ticks, higher by"
        f" {volumes['mean_difference']:.3f} on average, lower by up to"
        f" {volumes['greatest_deficit']:.3f}",
    )


def only_the_other_set_vanishes(data: Data) -> Finding:
    """Figure 2(f), (g): without the volume row the feasible set vanishes."""
    own, other = (data["test_2"]["at_snapshots"][m][-1] for m in (WITH, WITHOUT))
    stopped = _summary(data["test_2"]["runs"], WITHOUT)["outcome"] == "infeasible"
    return Finding(
        stopped and own["volume"] > 0.0,
        True,
        f"one tick before {WITHOUT} ends, at {other['time']:.2f} s, V_v is"
        f" {own['volume']:.3f} with and {other['volume']:.3f} without the volume row",
    )


def proposed_maps_to_the_interior(data: Data) -> Finding:
    """Figure 2(d)-(g): the proposed filter maps to the interior, the other does not."""
    own, other = (data["test_2"]["at_snapshots"][m][0] for m in (WITH, WITHOUT))
    inside, boundary = (data["test_2"]["interior"][m] for m in (WITH, WITHOUT))
    distances = own["input_to_nearest_face"], other["input_to_nearest_face"]
    return Finding(
        distances[0] > 1e-6 >= distances[1],
        inside["rate"] == 1.0 and boundary["rate"] == 0.0,
        f"at {own['time']:.0f} s {distances[0]:.2f} and {distances[1]:.2f} from the"
        f" nearest face; inside at {_share(inside)} of all ticks with a reference"
        f" outside, against {_share(boundary)}",
    )


def volume_stays_positive(data: Data) -> Finding:
    """Theorem 2: V_v >= 0 along the run."""
    main = _summary(data["test_2"]["runs"], WITH)["min_volume"]
    number = f"least V_v {main:.3f} in Test 2"
    beside = []
    for name, numbers in _studies(data):
        least = numbers["methods"][WITH]["least_volume"]
        beside.append(least is None or least >= 0.0)
        number += f", {least:.3f} over {name}"
    return Finding(main >= 0.0, all(beside), number)


# Table I ---------------------------------------------------------------------------


def runs_longer(data: Data, case: str) -> Finding:
    """Table I: T1 > T2."""
    numbers = data["table_1"][case]
    own, other, paper = numbers["T1"], numbers["T2"], numbers["paper"]
    number = (
        f"T1 {_mean(own)}, T2 {_mean(other)}; paper {paper['T1']} and {paper['T2']} s"
    )
    holds = _is_above(own["interval"], other["interval"])
    if "population_blimp" not in data:
        return Finding(holds, True, number)
    methods = data["population_blimp"]["methods"]
    own, other = (
        {"mean": methods[m]["mean_running_time"], "interval": methods[m]["interval"]}
        for m in (WITH, WITHOUT)
    )
    return Finding(
        holds,
        _is_above(own["interval"], other["interval"]) is True,
        f"{number}; over random courses {_mean(own)} and {_mean(other)}",
    )


def gains_matter(data: Data) -> Finding:
    """Table I: random gains shorten both running times by two seconds."""
    (own_1, other_1), (own_2, other_2) = (
        (data["table_1"][case]["T1"], data["table_1"][case]["T2"])
        for case in ("case_1", "case_2")
    )
    return Finding(
        _both(
            _is_above(own_1["interval"], own_2["interval"]),
            _is_above(other_1["interval"], other_2["interval"]),
        ),
        True,
        f"T1 {_mean(own_1)} and {_mean(own_2)}, T2 {_mean(other_1)} and"
        f" {_mean(other_2)} in cases 1 and 2",
    )


# Unselected courses ----------------------------------------------------------------


def infeasibility_is_rarer(data: Data) -> Finding:
    """The purpose: with the volume barrier the QP runs out of inputs more rarely."""
    rates = data["population_blimp"]["rates"]
    own, other = rates["dob-vcbf-qp fails"], rates["dob-cbf-qp fails"]
    number = f"blimp: {_share(own)} with, {_share(other)} without"
    holds = _is_above(other["interval"], own["interval"])
    if "population_car" not in data:
        return Finding(holds, True, number)
    layouts = data["population_car"]["layouts_with_a_failure"]
    car, other_car = layouts[WITH], layouts[WITHOUT]
    return Finding(
        holds,
        _is_above(other_car["interval"], car["interval"]) is True,
        f"{number}; car, at some approach gain: {_share(car)} with,"
        f" {_share(other_car)} without",
    )


# Car -------------------------------------------------------------------------------


def car_avoids(data: Data) -> Finding:
    """Figure 3: the proposed filter avoids the obstacle and arrives."""
    own = _summary(data["car_1"]["runs"], WITH)
    return Finding(_arrives(own), True, f"{_ending(own)}, {_square(own)}")


def robust_goes_wide(data: Data) -> Finding:
    """Figure 3: the robust filter avoids it with a much larger distance."""
    own, robust = (_summary(data["car_1"]["runs"], m) for m in (WITH, ROBUST))
    return Finding(
        not failed(robust) and robust["min_barrier"] > own["min_barrier"],
        True,
        f"{ROBUST}: {_square(robust)}, {_ending(robust)}; {WITH}: {_square(own)}",
    )


def car_collides(data: Data) -> Finding:
    """Figure 3: the nominal filter collides."""
    nominal = _summary(data["car_1"]["runs"], NOMINAL)
    return Finding(_collides(nominal), True, f"{_ending(nominal)}, {_square(nominal)}")


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
        f"{number}; fails in {_share(rate)} of random courses and gains",
    )


def all_gains_arrive(data: Data) -> Finding:
    """Figure 4: with the volume barrier the target is reached at all five gains."""
    summaries = _gains(data, WITH)
    late = [gain for gain, summary in summaries.items() if not _arrives(summary)]
    number = f"{len(summaries) - len(late)} of {len(summaries)} gains"
    for gain in late:
        summary = summaries[gain]
        number += f"; {gain}: {_ending(summary)}, {summary['final_distance']:.1f} m off"
    return Finding(not late, True, number)


def slow_car_stops(data: Data) -> Finding:
    """Figure 4: without the volume barrier k_p = 0.2 soon makes the QP infeasible."""
    summaries = _gains(data, WITHOUT)
    slow = summaries["k_p=0.2"]
    others = [s for gain, s in summaries.items() if gain != "k_p=0.2"]
    number = (
        f"{_ending(slow)}; the other gains: {sum(map(failed, others))} of"
        f" {len(others)} fail"
    )
    holds = slow["outcome"] == "infeasible"
    if "population_car" not in data:
        return Finding(holds, True, number)
    rate = data["population_car"]["by_gain"]["0.2"]["rates"]["dob-cbf-qp fails"]
    return Finding(
        holds,
        rate["rate"] == 1.0,
        f"{number}; at k_p = 0.2 it fails in {_share(rate)} of random courses",
    )


# What the numbers are made of ------------------------------------------------------


def _summary(runs: Data, method: str) -> Data:
    summary: Data = runs[method]["summary"]
    return summary


def _steady(data: Data, method: str) -> list[Data]:
    winds = data["test_1"]["steady_winds"]
    return [_summary(wind["runs"], method) for wind in winds]


def _gains(data: Data, method: str) -> dict[str, Data]:
    runs = data["car_2"]["runs"]
    return {gain: _summary(methods, method) for gain, methods in runs.items()}


def _studies(data: Data) -> list[tuple[str, Data]]:
    found = []
    if "table_1" in data:
        found += [
            ("Table I's starts", data["table_1"]["case_1"]),
            ("its gains", data["table_1"]["case_2"]),
        ]
    if "population_blimp" in data:
        found.append(("random courses", data["population_blimp"]))
    return found


def _height(runs: Data, method: str) -> float:
    return float(_summary(runs, method)["min_barrier"])


def _relative_error(estimation: Data) -> float:
    return float(estimation["greatest_error"] / estimation["greatest_disturbance"])


def _collides(summary: Data) -> bool:
    return bool(summary["outcome"] == "collision")


def _arrives(summary: Data) -> bool:
    return bool(summary["outcome"] == "reached" and summary["min_barrier"] > 0.0)


def _is_above(interval: Any, other: Any) -> bool | None:
    """Whether the first interval is the higher; None when they overlap."""
    if interval is None or other is None:
        return None
    if interval[0] > other[1]:
        return True
    # Below, or two equal values without any spread: more trials change nothing.
    if interval[1] < other[0] or (*interval, *other) == 4 * (interval[0],):
        return False
    return None


def _both(first: bool | None, second: bool | None) -> bool | None:
    """Kleene's "and": one that is false decides."""
    if first is False or second is False:
        return False
    return None if first is None or second is None else True


def _ending(summary: Data) -> str:
    return {
        "reached": "arrives at {reached_at:.1f} s",
        "infeasible": "has no feasible input at {infeasible_at:.2f} s",
        "collision": "collides at {collided_at:.1f} s",
        "timeout": "is still on its way after {running_time:.0f} s",
    }[summary["outcome"]].format(**summary)


def _time(summary: Data) -> str:
    reached_at = summary["reached_at"]
    return "never" if reached_at is None else f"{reached_at:.1f} s"


def _safety(summary: Data) -> str:
    if _collides(summary):
        return f"collides at {summary['collided_at']:.1f} s"
    return f"least h {summary['min_barrier']:.3f} m"


def _square(summary: Data) -> str:
    least = round(summary["min_barrier"], 2) + 0.0  # No minus before a zero.
    return f"least h {least:.2f} m²"


def _mean(running_time: Data) -> str:
    mean, interval = running_time["mean"], running_time["interval"]
    if interval is None:
        return f"{mean:.2f} s"
    return f"{mean:.2f} s ({interval[0]:.2f} to {interval[1]:.2f})"


def _share(share: Data) -> str:
    if share["rate"] is None:
        return "none of none"
    interval = ""
    if share.get("interval") is not None:
        low, high = share["interval"]
        interval = f", {100 * low:.0f} to {high:.0%}"
    return f"{share['count']} of {share['of']} ({share['rate']:.0%}{interval})"


def _list(words: Iterable[str]) -> str:
    return ", ".join(words)
