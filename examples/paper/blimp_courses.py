"""Courses that nobody chose for the blimp: how often each filter fails, what helps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import math
from typing import Any

import numpy as np

from vcbf_drake.plants import BlimpParameters
from vcbf_drake.studies import Record, Trial, summarise_study

from .archive import Archive, in_drawing_order
from .experiment import (
    WITH,
    WITHOUT,
    Claim,
    Courses,
    Experiment,
    Finding,
    Numbers,
    Plan,
    Records,
    Settings,
    describe,
    failed,
    failure_rates,
    is_above,
    paired_trials,
    pairs,
)
from .figures import Row, outcome_figure
from .report import Block, Figure
from .words import NOTHING, label, percent, proportion, readable, table, trials_table

SCENARIO = "blimp-multiple-obstacles"

# The courses -------------------------------------------------------------------------

# What a course draws uniformly, and from where. All ours: the paper prints no layout.
BLIMP_COURSE_RANGES: dict[str, tuple[float, float]] = {
    "thrust [m/s^2]": (0.5, 1.5),
    "reverse thrust over thrust": (0.1, 0.5),
    "surge speed cap [m/s]": (0.8, 2.0),
    "height error cap [m]": (0.3, 0.8),
    "sphere along the way": (0.2, 0.85),
    "sphere radius [m]": (0.5, 1.0),
}
# A course has this many spheres, each number as likely as the others.
SPHERE_COUNTS = (4, 5, 6, 7, 8, 9)
# The spread of the centres around the straight way: standard deviations [m].
SPHERE_SPREAD = (0.2, 0.7, 0.5)

_START, _TARGET = (0.0, 0.0, 0.0), (14.0, 3.0, 2.5)
_START_CLEARANCE, _TARGET_CLEARANCE = 1.5, 1.2  # to the surface of a sphere [m]
_YAW_ACCELERATION = 2.5  # the limit of the yaw moment over the inertia [rad/s^2]


def blimp_course(seed: int) -> dict[str, Any]:
    """Returns a random course, as overrides of `blimp-multiple-obstacles`.

    A course sets the input limits, the controller's speed caps, a wind of a tenth of
    the thrust, and the spheres. The scenario itself is course 5.

    Args:
        seed: Which course; the same seed gives the same course.
    """
    generator = np.random.default_rng([2024, seed])

    def draw(name: str) -> float:
        return float(generator.uniform(*BLIMP_COURSE_RANGES[name]))

    thrust, reverse = draw("thrust [m/s^2]"), draw("reverse thrust over thrust")
    plant = BlimpParameters()
    surge_mass, _, heave_mass = plant.effective_masses
    surge, heave = round(thrust * surge_mass, 4), round(thrust * heave_mass, 4)
    yaw = round(_YAW_ACCELERATION * plant.yaw_inertia, 4)
    return {
        "name": f"blimp-course-{seed}",
        "input_set": {
            "lower": [-round(reverse * surge, 4), -heave, -yaw],
            "upper": [surge, heave, yaw],
        },
        "vehicle": {
            "controller": {
                "surge_speed_cap": round(draw("surge speed cap [m/s]"), 2),
                "height_error_cap": round(draw("height error cap [m]"), 2),
            }
        },
        "disturbance": _wind(round(0.1 * thrust, 3)),
        "obstacles": _spheres(generator),
    }


def _wind(strength: float) -> list[dict[str, Any]]:
    """A gusty wind that reverses [m/s^2]."""
    sway, heave = round(0.5 * strength, 4), round(0.8 * strength, 4)
    return [
        _gust([strength, 0.0, 0.0], 0.8, 0.0),
        _gust([0.0, sway, 0.0], 0.8, 1.5708),
        _gust([0.0, 0.0, heave], 1.1, 0.5),
    ]


def _gust(amplitude: list[float], frequency: float, phase: float) -> dict[str, Any]:
    return {
        "_tag": "!Sinusoid",
        "amplitude": amplitude,
        "frequency": frequency,
        "phase": phase,
    }


def _spheres(generator: np.random.Generator) -> list[dict[str, Any]]:
    """Spheres scattered about the straight way, clear of both of its ends."""
    count = int(generator.integers(SPHERE_COUNTS[0], SPHERE_COUNTS[-1] + 1))
    spheres: list[dict[str, Any]] = []
    while len(spheres) < count:
        along = generator.uniform(*BLIMP_COURSE_RANGES["sphere along the way"])
        center = along * np.array(_TARGET) + generator.normal(0.0, SPHERE_SPREAD)
        radius = float(generator.uniform(*BLIMP_COURSE_RANGES["sphere radius [m]"]))
        if (
            math.dist(center, _START) > radius + _START_CLEARANCE
            and math.dist(center, _TARGET) > radius + _TARGET_CLEARANCE
        ):
            rounded = [round(float(x), 2) for x in center]
            spheres.append({"center": rounded, "radius": round(radius, 2)})
    return spheres


BLIMP_COURSES = Courses("blimp-courses", blimp_course)


# Run ---------------------------------------------------------------------------------


def plan(settings: Settings) -> Plan:
    """Returns random courses of the blimp, each under both filters."""
    name = "population_blimp"
    trials = paired_trials(SCENARIO, settings.blimp_courses, BLIMP_COURSES)

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            "generator": {
                "function": "examples.paper.blimp_courses.blimp_course(seed)",
                "scenario": SCENARIO,
                "ranges": dict(BLIMP_COURSE_RANGES),
                "spheres": SPHERE_COUNTS,
                "sphere spread [m]": SPHERE_SPREAD,
            },
            "layouts": settings.blimp_courses,
            **population(name, trials, records[name]),
        }

    return Plan(evaluate, studies={name: trials})


def population(name: str, trials: Sequence[Trial], records: Sequence[Record]) -> Record:
    """Returns what became of the trials of a population, and how often who failed."""
    study = summarise_study(trials, records)
    return {
        "file": f"studies/{name}.jsonl",
        "rates": failure_rates(list(pairs(records))),
        **study,
        "methods": {m: describe(records, m) for m in study["methods"]},
    }


# Judge -------------------------------------------------------------------------------


def infeasibility_is_rarer(data: Numbers) -> Finding:
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


# Show --------------------------------------------------------------------------------


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields outcomes and rates over random courses, and how these are drawn."""
    command = numbers["command"]
    yield (
        "Every course is flown with and without the volume barrier; none is left out."
        " Outcomes within 20 s."
    )
    yield Figure(
        "population_blimp",
        f"How {numbers['layouts']} random courses end with and without the volume"
        " barrier, and, in the last bar, how those end with it that fail without.",
        lambda: outcome_figure(list(bars("", numbers, archive))),
        command,
    )
    yield trials_table(
        "The same in numbers.",
        ["method"],
        [
            ([label(method)], trials)
            for method, trials in in_drawing_order(numbers["methods"]).items()
        ],
        command,
    )
    yield rates_table("The same as rates with Wilson's 95 % intervals.", numbers)
    yield generator_table(numbers["generator"])


def bars(prefix: str, study: Numbers, archive: Archive) -> Iterator[Row]:
    """Yields both methods over all courses, and the second where the first fails."""
    records = archive.records(study["file"])
    for method in (WITHOUT, WITH):
        yield prefix + label(method), method, describe(records, method)
    lost = {r["index"] for r in records if r["method"] == WITHOUT and failed(r)}
    if lost:
        rescued = [record for record in records if record["index"] in lost]
        words = f"{prefix}{label(WITH)}, where that fails"
        yield words, WITH, describe(rescued, WITH)


def rates_table(caption: str, numbers: Numbers) -> str:
    """How often who fails, as a table."""
    rates = dict(numbers["rates"])
    for method, rate in numbers.get("layouts_with_a_failure", {}).items():
        rates[f"courses in which {method} fails at some gain"] = rate
    return table(
        caption,
        ["event", "count", "of", "rate", "95 % interval"],
        [
            [name, str(rate["count"]), str(rate["of"]), *_shares(rate)]
            for name, rate in rates.items()
        ],
        numbers["command"],
    )


def _shares(rate: Numbers) -> list[str]:
    if rate["interval"] is None:
        return [percent(rate["rate"]), NOTHING]
    low, high = map(percent, rate["interval"])
    return [percent(rate["rate"]), f"{low} to {high}"]


def generator_table(generator: Mapping[str, Any]) -> str:
    """How a course is drawn: every entry of the generator as a row."""
    rows = [
        [readable(name), readable(f"{low:g} to {high:g}")]
        for name, (low, high) in generator["ranges"].items()
    ]
    rows += [
        [readable(name), _entry(value)]
        for name, value in generator.items()
        if name != "ranges"
    ]
    return table(
        "How the courses are drawn: uniformly where a range stands.",
        ["quantity", "from"],
        rows,
    )


def _entry(value: Any) -> str:
    if not isinstance(value, list):
        return f"{value:g}" if isinstance(value, float) else str(value)
    return ", ".join(
        f"({_entry(each)})" if isinstance(each, list) else _entry(each)
        for each in value
    )


EXPERIMENT = Experiment(
    "population_blimp",
    "Unselected layouts of the blimp",
    plan,
    show,
    claims=(
        Claim(
            "With the volume barrier the QP runs out of inputs more rarely",
            "the method's purpose",
            infeasibility_is_rarer,
        ),
    ),
)
