"""Table I's random starts and gains, and courses that nobody selected."""

from __future__ import annotations

from vcbf_drake.studies.reproduction.judgements.finding import Data, Finding
from vcbf_drake.studies.reproduction.judgements.numbers import both, is_above
from vcbf_drake.studies.reproduction.judgements.words import mean_time, proportion
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT


def runs_longer(data: Data, case: str) -> Finding:
    """Table I: T1 > T2."""
    numbers = data["table_1"][case]
    own, other, paper = numbers["T1"], numbers["T2"], numbers["paper"]
    number = (
        f"T1 {mean_time(own)}, T2 {mean_time(other)};"
        f" paper {paper['T1']} and {paper['T2']} s"
    )
    holds = is_above(own["interval"], other["interval"])
    if "population_blimp" not in data:
        return Finding(holds, True, number)
    methods = data["population_blimp"]["methods"]
    own, other = (
        {"mean": methods[m]["mean_running_time"], "interval": methods[m]["interval"]}
        for m in (WITH, WITHOUT)
    )
    return Finding(
        holds,
        is_above(own["interval"], other["interval"]) is True,
        f"{number}; over random courses {mean_time(own)} and {mean_time(other)}",
    )


def gains_matter(data: Data) -> Finding:
    """Table I: random gains shorten both running times by two seconds."""
    (own_1, other_1), (own_2, other_2) = (
        (data["table_1"][case]["T1"], data["table_1"][case]["T2"])
        for case in ("case_1", "case_2")
    )
    return Finding(
        both(
            is_above(own_1["interval"], own_2["interval"]),
            is_above(other_1["interval"], other_2["interval"]),
        ),
        True,
        f"T1 {mean_time(own_1)} and {mean_time(own_2)}, T2 {mean_time(other_1)} and"
        f" {mean_time(other_2)} in cases 1 and 2",
    )


def infeasibility_is_rarer(data: Data) -> Finding:
    """The purpose: with the volume barrier the QP runs out of inputs more rarely."""
    rates = data["population_blimp"]["rates"]
    own, other = rates["dob-vcbf-qp fails"], rates["dob-cbf-qp fails"]
    number = f"blimp: {proportion(own)} with, {proportion(other)} without"
    holds = is_above(other["interval"], own["interval"])
    if "population_car" not in data:
        return Finding(holds, True, number)
    layouts = data["population_car"]["layouts_with_a_failure"]
    car, other_car = layouts[WITH], layouts[WITHOUT]
    return Finding(
        holds,
        is_above(other_car["interval"], car["interval"]) is True,
        f"{number}; car, at some approach gain: {proportion(car)} with,"
        f" {proportion(other_car)} without",
    )
