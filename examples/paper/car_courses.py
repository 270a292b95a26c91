"""Courses that nobody chose for the car: a gate of two discs, and more of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import math
from typing import Any

import numpy as np

from vcbf_drake.plants import CarParameters
from vcbf_drake.studies import Record

from .archive import Archive, in_drawing_order
from .blimp_courses import bars, generator_table, population, rates_table
from .experiment import (
    WITH,
    WITHOUT,
    Courses,
    Experiment,
    Numbers,
    Plan,
    Records,
    Settings,
    failed,
    failure_rates,
    paired_trials,
    pairs,
    share,
    text,
)
from .figures import outcome_figure
from .report import Block, Figure
from .words import label, trials_table

SCENARIO = "car-sensitivity"

# The courses -------------------------------------------------------------------------

# The approach gains k_p of the paper's second car experiment [1/s].
APPROACH_GAINS = (0.2, 0.4, 0.6, 0.8, 1.0)

# What a course draws uniformly, and from where. All ours: the paper prints no layout.
CAR_COURSE_RANGES: dict[str, tuple[float, float]] = {
    "force limit [N]": (0.4, 1.2),
    "turn rate limit [rad/s]": (0.3, 1.2),
    "push over force limit": (0.1, 0.4),
    "disc radius [m]": (0.3, 0.5),
    "gate width [m]": (0.2, 0.8),
    "gate along the way [m]": (1.3, 3.7),
    "gate beside the way [m]": (-0.6, 0.6),
    "gate turned by [rad]": (-0.5, 0.5),
    "other disc along the way [m]": (1.0, 4.0),
    "other disc beside the way [m]": (-1.2, 1.2),
}
# Of these a course takes one, each as likely as the others.
OTHER_DISCS = (0, 1, 2)
BARRIER_GAINS = ((4.0, 3.0), (6.0, 8.0), (10.0, 3.55))  # K of (E4)

Disc = tuple[float, float, float]  # x, y, radius [m]

_WAY = ((0.0, 0.0), (5.0, 0.0))  # where the scenario starts and where it ends [m]
_CLEARANCE = 0.6  # from both to the surface of a disc, at least [m]
_NARROWEST = 0.2  # between the surfaces of two discs, at least [m]


def car_course(seed: int) -> dict[str, Any]:
    """Returns a random course, as overrides of the scenario `car-sensitivity`.

    A course sets the input limits, the push, the discs and the gains of their barriers.
    Start, target and approach gain stay the scenario's; a study drives every course
    with each of `APPROACH_GAINS`.

    Args:
        seed: Which course; the same seed gives the same course.
    """
    draw = _Draw(seed)
    force, turn_rate = draw("force limit [N]"), draw("turn rate limit [rad/s]")
    push = round(draw("push over force limit") * force / CarParameters().mass, 3)
    gains = BARRIER_GAINS[draw.index(len(BARRIER_GAINS))]
    discs = _gate(draw)
    for _ in range(OTHER_DISCS[draw.index(len(OTHER_DISCS))]):
        discs.append(_other_disc(draw, discs))
    return {
        "name": f"car-course-{seed}",
        "input_set": {"lower": [-force, -turn_rate], "upper": [force, turn_rate]},
        "disturbance": [
            {"_tag": "!Sinusoid", "amplitude": [push], "frequency": 0.7, "phase": 0.0}
        ],
        "obstacles": [{"center": [x, y], "radius": radius} for x, y, radius in discs],
        "barrier": {"gains": list(gains)},
    }


class _Draw:
    """Draws from the ranges, to the millimetre, mrad and mN."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.default_rng([2503, seed])

    def __call__(self, name: str) -> float:
        return round(float(self._generator.uniform(*CAR_COURSE_RANGES[name])), 3)

    def index(self, count: int) -> int:
        return int(self._generator.integers(count))


def _gate(draw: _Draw) -> list[Disc]:
    """Two discs, one on each side of a gap, clear of both ends of the way."""
    while True:
        x, y = draw("gate along the way [m]"), draw("gate beside the way [m]")
        angle, width = draw("gate turned by [rad]"), draw("gate width [m]")
        discs = []
        for side in (1.0, -1.0):
            radius = draw("disc radius [m]")
            reach = side * (0.5 * width + radius)
            across = (-math.sin(angle) * reach, math.cos(angle) * reach)
            discs.append((round(x + across[0], 3), round(y + across[1], 3), radius))
        if all(map(_is_clear, discs)):
            return discs


def _other_disc(draw: _Draw, discs: list[Disc]) -> Disc:
    """A disc anywhere about the way, clear of its ends and of the discs so far."""
    while True:
        disc = (
            draw("other disc along the way [m]"),
            draw("other disc beside the way [m]"),
            draw("disc radius [m]"),
        )
        if _is_clear(disc) and all(_gap(disc, other) >= _NARROWEST for other in discs):
            return disc


def _is_clear(disc: Disc) -> bool:
    return all(_gap(disc, (x, y, 0.0)) >= _CLEARANCE for x, y in _WAY)


def _gap(disc: Disc, other: Disc) -> float:
    return math.dist(disc[:2], other[:2]) - disc[2] - other[2]


CAR_COURSES = Courses("car-courses", car_course)


# Run ---------------------------------------------------------------------------------


def plan(settings: Settings) -> Plan:
    """Returns random courses of the car, each at every approach gain."""
    studies = {
        f"population_car_{gain}": paired_trials(
            SCENARIO,
            settings.car_courses,
            CAR_COURSES,
            text({"vehicle": {"controller": {"approach_gain": gain}}}),
        )
        for gain in APPROACH_GAINS
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        rates = failure_rates(
            [pair for name in studies for pair in pairs(records[name])]
        )
        for rate in rates.values():
            rate["interval"] = None  # The gains of a course are not independent.
        return {
            "generator": {
                "function": "examples.paper.car_courses.car_course(seed)",
                "scenario": SCENARIO,
                "ranges": dict(CAR_COURSE_RANGES),
                "barrier gains": BARRIER_GAINS,
                "other discs": OTHER_DISCS,
            },
            "layouts": settings.car_courses,
            "rates": rates,
            "layouts_with_a_failure": {
                method: _layouts_with_a_failure(records, method)
                for method in (WITHOUT, WITH)
            },
            "by_gain": {
                str(gain): population(name, studies[name], records[name])
                for gain, name in zip(APPROACH_GAINS, studies, strict=True)
            },
        }

    return Plan(evaluate, studies=studies)


def _layouts_with_a_failure(
    records: Mapping[str, Sequence[Record]], method: str
) -> Record:
    """In how many layouts a method fails at some approach gain."""
    fails: dict[int, bool] = {}
    for study in records.values():
        for record in study:
            if record["method"] == method and record["error"] is None:
                index = record["index"]
                fails[index] = fails.get(index, False) or failed(record)
    return share(sum(fails.values()), len(fails))


# Show --------------------------------------------------------------------------------


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields outcomes for every approach gain, rates, and how courses are drawn."""
    command, by_gain = numbers["command"], numbers["by_gain"]
    yield (
        "Every course is driven at each approach gain with and without the volume"
        " barrier; none is left out. Outcomes within 20 s; rates are over pairs of a"
        " course and a gain unless they say layouts."
    )
    yield Figure(
        "population_car",
        f"How {numbers['layouts']} random courses end at each gain of the reference,"
        " with and without the volume barrier, and how those end with it that fail"
        " without.",
        lambda: outcome_figure(
            [
                row
                for gain, study in by_gain.items()
                for row in bars(f"$k_p$ = {gain}: ", study, archive)
            ]
        ),
        command,
    )
    yield trials_table(
        "The same in numbers, running times to the first failure.",
        ["*k_p*", "method"],
        [
            ([gain, label(method)], trials)
            for gain, study in by_gain.items()
            for method, trials in in_drawing_order(study["methods"]).items()
        ],
        command,
    )
    yield rates_table(
        "The rates over all gains, with Wilson's 95 % intervals.", numbers
    )
    yield generator_table(numbers["generator"])


EXPERIMENT = Experiment("population_car", "Unselected layouts of the car", plan, show)
