"""The paper's two experiments with a car, in simulation: avoidance, and five gains."""

from __future__ import annotations

from collections.abc import Iterator

from vcbf_drake.studies import Record, Trial
from vcbf_drake.viz.figures import path_figure
from vcbf_drake.viz.series_figures import barrier_figure, draw_volume

from .archive import Archive, in_drawing_order
from .car_courses import APPROACH_GAINS
from .experiment import (
    NOMINAL,
    ROBUST,
    WITH,
    WITHOUT,
    Claim,
    Experiment,
    Finding,
    Numbers,
    Plan,
    Records,
    Settings,
    entries,
    failed,
    runs_under,
    text,
)
from .figures import cases_figure
from .report import Block, Figure, Replay
from .words import (
    arrives,
    collides,
    ending,
    endings,
    label,
    least_barriers,
    least_square,
    proportion,
    readable,
    runs_table,
)

AVOIDANCE, SENSITIVITY = "car-avoidance", "car-sensitivity"
AVOIDERS = (WITH, ROBUST, NOMINAL)
# The paper's car is a point; the shipped scenario's has a body, and a margin for it.
POINT = {"obstacles": [{"center": [3.4, 0.15], "radius": 0.4}]}


# Run ---------------------------------------------------------------------------------


def plan_avoidance(settings: Settings) -> Plan:
    """Returns the runs of the paper's three methods past a disc."""
    runs = runs_under(AVOIDERS, AVOIDANCE, "car_1", POINT)

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            "command": f"vcbf-drake compare {AVOIDANCE} --methods {','.join(AVOIDERS)}"
            f" --override '{text(POINT)}'",
            "runs": entries(archive, runs, "car_1"),
        }

    return Plan(evaluate, runs)


def plan_gains(settings: Settings) -> Plan:
    """Returns every approach gain with and without the volume barrier."""
    runs: dict[str, Trial] = {}
    for gain in APPROACH_GAINS:
        overrides = {"vehicle": {"controller": {"approach_gain": gain}}}
        runs |= runs_under((WITH, WITHOUT), SENSITIVITY, f"car_2/k_p={gain}", overrides)

    def evaluate(archive: Archive, records: Records) -> Record:
        keys = [f"k_p={gain}" for gain in APPROACH_GAINS]
        return {"runs": {key: entries(archive, runs, f"car_2/{key}") for key in keys}}

    return Plan(evaluate, runs)


# Judge -------------------------------------------------------------------------------


def car_avoids(data: Numbers) -> Finding:
    """Figure 3: the proposed filter avoids the obstacle and arrives."""
    own = data["car_1"]["runs"][WITH]["summary"]
    return Finding(arrives(own), True, f"{ending(own)}, {least_square(own)}")


def robust_goes_wide(data: Numbers) -> Finding:
    """Figure 3: the robust filter avoids it with a much larger distance."""
    own, robust = (data["car_1"]["runs"][m]["summary"] for m in (WITH, ROBUST))
    return Finding(
        not failed(robust) and robust["min_barrier"] > own["min_barrier"],
        True,
        f"{ROBUST}: {least_square(robust)}, {ending(robust)};"
        f" {WITH}: {least_square(own)}",
    )


def car_collides(data: Numbers) -> Finding:
    """Figure 3: the nominal filter collides."""
    nominal = data["car_1"]["runs"][NOMINAL]["summary"]
    return Finding(
        collides(nominal), True, f"{ending(nominal)}, {least_square(nominal)}"
    )


def all_gains_stay_feasible(data: Numbers) -> Finding:
    """Figure 4: with the volume barrier the QP is feasible at all five gains."""
    safe = [not failed(summary) for summary in _gains(data, WITH).values()]
    number = f"{sum(safe)} of {len(safe)} gains"
    if "population_car" not in data:
        return Finding(all(safe), True, number)
    rate = data["population_car"]["rates"]["dob-vcbf-qp fails"]
    return Finding(
        all(safe),
        rate["count"] == 0,
        f"{number}; fails in {proportion(rate)} of random courses and gains",
    )


def all_gains_arrive(data: Numbers) -> Finding:
    """Figure 4: with the volume barrier the target is reached at all five gains."""
    summaries = _gains(data, WITH)
    late = {gain: s for gain, s in summaries.items() if not arrives(s)}
    number = f"{len(summaries) - len(late)} of {len(summaries)} gains"
    for gain, summary in late.items():
        number += f"; {gain}: {ending(summary)}, {summary['final_distance']:.1f} m off"
    return Finding(not late, True, number)


def slow_car_stops(data: Numbers) -> Finding:
    """Figure 4: without the volume barrier k_p = 0.2 soon makes the QP infeasible."""
    summaries = _gains(data, WITHOUT)
    slow = summaries.pop("k_p=0.2")
    holds = slow["outcome"] == "infeasible"
    number = (
        f"{ending(slow)}; the other gains: {sum(map(failed, summaries.values()))} of"
        f" {len(summaries)} fail"
    )
    if "population_car" not in data:
        return Finding(holds, True, number)
    rate = data["population_car"]["by_gain"]["0.2"]["rates"]["dob-cbf-qp fails"]
    return Finding(
        holds,
        rate["rate"] == 1.0,
        f"{number}; at k_p = 0.2 it fails in {proportion(rate)} of random courses",
    )


def _gains(data: Numbers, method: str) -> dict[str, Numbers]:
    runs = data["car_2"]["runs"]
    return {gain: methods[method]["summary"] for gain, methods in runs.items()}


# Show --------------------------------------------------------------------------------


def show_avoidance(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields paths and barriers of three methods."""
    runs, command = numbers["runs"], numbers["command"]
    yield (
        "The paper drives a real car and shows paths only: the vehicle model and the"
        " form of the barrier are the paper's, every number is ours."
    )
    yield Replay("car_1", "all methods at once.", lambda: archive.results(runs))
    yield Figure(
        "car_1_paths",
        "Paths of the car's centre from the start (dot) to the target (star), seen from"
        f" above. A cross marks where a run failed. {endings(runs)}",
        lambda: path_figure(archive.labelled(runs)),
        command,
    )
    yield Figure(
        "car_1_barriers",
        "The barrier *h*, the squared distance to the disc's centre less its squared"
        " radius, over time; below 0 is a collision. The least values:"
        f" {least_barriers(runs, 'm²')}.",
        lambda: barrier_figure(archive.labelled(runs)),
        command,
    )
    caption = "Car experiment 1 under the paper's three methods."
    yield runs_table(caption, [("", runs)], "m²", command)


def show_gains(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields paths and volume for every gain, with and without the volume barrier."""
    cases, command = numbers["runs"], numbers["command"]
    slowest = next(iter(cases.values()))
    yield (
        "The paper's approach gains k_p; discs, limits and push are ours. The gain"
        " scales the reference speed, and a slow car has little steering authority: its"
        " column in a barrier's row is proportional to the speed."
    )
    yield Replay("car_2", "the slowest reference.", lambda: archive.results(slowest))
    yield Figure(
        "car_2",
        "A row for each gain of the reference: paths from above at the left, the volume"
        " barrier *Vᵥ* over time at the right, with and without the volume barrier. A"
        f" cross marks the tick that has no feasible input. {_not_arrived(cases)}",
        lambda: cases_figure(
            [
                (words.replace("k_p=", "$k_p$ = "), archive.labelled(runs))
                for words, runs in cases.items()
            ],
            (0, 1),
            draw_volume,
            share=0.56,
        ),
        command,
    )
    yield runs_table(
        "Car experiment 2: every gain of the reference, with and without the volume"
        " barrier.",
        list(cases.items()),
        "m²",
        command,
    )


def _not_arrived(cases: Numbers) -> str:
    """Who does not reach the target, at which gain, and why."""
    parts = [
        f"{readable(words)}, {label(method)} {ending(run['summary'])}"
        for words, runs in cases.items()
        for method, run in in_drawing_order(runs).items()
        if run["summary"]["outcome"] != "reached"
    ]
    if not parts:
        return "All runs reach the target."
    return f"All runs reach the target but these: at {'; at '.join(parts)}."


AVOIDANCE_EXPERIMENT = Experiment(
    "car_1",
    "Car experiment 1: avoidance",
    plan_avoidance,
    show_avoidance,
    claims=(
        Claim(
            "The proposed method avoids the obstacle and arrives", "Fig. 3", car_avoids
        ),
        Claim(
            "Robust CBF avoids it with a larger distance", "Fig. 3", robust_goes_wide
        ),
        Claim("Nominal CBF collides", "Fig. 3", car_collides),
    ),
)
GAINS_EXPERIMENT = Experiment(
    "car_2",
    "Car experiment 2: slow references",
    plan_gains,
    show_gains,
    claims=(
        Claim(
            "With the volume barrier the QP is feasible at all five gains",
            "Fig. 4",
            all_gains_stay_feasible,
        ),
        Claim(
            "With the volume barrier the car arrives at all five gains",
            "Fig. 4",
            all_gains_arrive,
        ),
        Claim(
            "Without it, k_p = 0.2 soon makes the QP infeasible",
            "Fig. 4",
            slow_car_stops,
        ),
    ),
)
