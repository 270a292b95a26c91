"""Which widening and gain for a plant that nobody tuned them to?

    python -m examples.feasibility.defaults --workers 2

Runs random courses of five vehicles, with inputs so weak that a filter without a volume
barrier loses many of them, once for each setting of a coarse grid; the threshold is
left out. An interrupted study resumes; ``--page FILE`` writes the page of what there is
and runs nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from examples.adaptive_cruise_control import HEADWAY
from examples.paper.blimp_courses import blimp_course
from examples.paper.car_courses import APPROACH_GAINS, car_course
from examples.quadrotor_slalom import LIMITS
from vcbf_drake.files import atomic_write
from vcbf_drake.safety import VolumeBarrier
from vcbf_drake.simulation.loading import merge_overrides
from vcbf_drake.studies import Record, Trial, run_study
from vcbf_drake.studies.executors import new_pool

from .page import share, whole_lines
from .study import FIRST_JUDGE, Courses, can_stop, is_lost

WIDENINGS, GAINS = (1.0, 4.0, 8.0), (0.1, 0.3, 1.0, 3.0)  # kappa, lambda [1/s]
COUNT = 50  # courses a vehicle


def weak_blimp(index: int) -> dict[str, Any]:
    """Returns a course with half the reverse thrust."""
    course = blimp_course(index)
    course["input_set"]["lower"][0] *= 0.5
    return course


def weak_car(index: int) -> dict[str, Any]:
    """Returns a course with three fifths of the force, at one of the approach gains."""
    course = car_course(index)
    for side in ("lower", "upper"):
        course["input_set"][side][0] *= 0.6
    gain = APPROACH_GAINS[index % len(APPROACH_GAINS)]
    return course | {"vehicle": {"controller": {"approach_gain": gain}}}


def cruise(index: int) -> dict[str, Any]:
    """Returns a start from which full braking keeps the headway, and a barrier gain."""
    draw = np.random.default_rng([31, index]).uniform
    while True:
        speed = draw(16.0, 32.0)
        distance = HEADWAY * speed + draw(1.0, 100.0)
        if can_stop(speed, distance):
            break
    gain = (1.0, 2.0, 5.0)[index % 3]
    return {"initial_state": [speed, distance], "vehicle": {"gain": gain}}


def slalom(index: int) -> dict[str, Any]:
    """Returns three spheres in a quadrotor's way, and weaker moments and thrust."""
    draw = np.random.default_rng([32, index]).uniform
    limits = [draw(0.05, 0.3) * each for each in LIMITS]
    spheres = [
        {
            "center": [x + draw(-0.3, 0.3), draw(-0.5, 0.5), 1.0 + draw(-0.4, 0.4)],
            "radius": draw(0.35, 0.6),
            "margin": 0.25,
        }
        for x in (2.0, 4.0, 6.0)
    ]
    return {
        "input_set": {"lower": [-each for each in limits], "upper": limits},
        "obstacles": spheres,
    }


_EFFORTS = [300.0, 300.0, 170.0, 170.0, 100.0, 40.0, 40.0]  # Of the URDF [N m].


def reach(index: int) -> dict[str, Any]:
    """Returns a ball in an arm's way, a start, weaker joints and a hasty controller."""
    draw = np.random.default_rng([33, index]).uniform
    efforts = [draw(0.08, 0.4) * each for each in _EFFORTS]
    start = np.array([0.5, 0.5, 0.0, -1.0, 0.0, 0.5, 0.0]) + draw(-0.1, 0.1, 7)
    ball = np.array([0.66, 0.0, 0.62]) + draw(-0.08, 0.08, 3)
    stiffness = draw(20.0, 100.0)
    return {
        "input_set": {"lower": [-each for each in efforts], "upper": efforts},
        "vehicle": {
            "controller": {
                "_tag": "!InverseDynamics",
                "stiffness": [stiffness],
                "damping": [2.0 * math.sqrt(stiffness)],
            }
        },
        "obstacles": [
            {"center": ball.tolist(), "radius": 0.12},
            {"_tag": "!HalfSpace", "normal": [0.0, 0.0, 1.0], "offset": 0.1},
        ],
        "initial_state": [*start.tolist(), *[0.0] * 7],
        "period": 0.01,
    }


@dataclass(frozen=True)
class Plant:
    """Random courses of one vehicle, none of them selected.

    Attributes:
        scenario: What they are courses of.
        method: With the volume barrier.
        without: The same method without it.
        draw: Returns a course, by its number.
        duration: Of a run [s].
    """

    scenario: str
    method: str
    without: str
    draw: Callable[[int], dict[str, Any]]
    duration: float

    def trial(self, name: str, index: int, barrier: VolumeBarrier | None) -> Trial:
        """Returns a run of one course; without a volume barrier where that is None."""
        given: dict[str, Any] = {"duration": self.duration, "infeasible": "stop"}
        if barrier is not None:
            volume = {"gain": barrier.gain, "widening": barrier.widening}
            given["volume"] = volume | {"threshold": None}
        return Trial(
            self.scenario,
            self.method if barrier else self.without,
            index,
            variation=Courses(name, self.draw),
            overrides=merge_overrides(given),
        )


ROBUST = "dob-vcbf-qp", "dob-cbf-qp"
CALM = "vcbf-qp", "cbf-qp"
PLANTS = {
    "car": Plant("car-sensitivity", *ROBUST, weak_car, 10.0),
    "blimp": Plant("blimp-multiple-obstacles", *ROBUST, weak_blimp, 15.0),
    "cruise": Plant("examples/adaptive_cruise_control.py", *CALM, cruise, 15.0),
    "quadrotor": Plant("examples/quadrotor_slalom.py", *ROBUST, slalom, 4.0),
    "arm": Plant("examples/arm.yaml", *CALM, reach, 1.5),
}
# In the order of what they tell: none, the paper's form, the default, and others.
SETTINGS: list[VolumeBarrier | None] = [
    None,
    VolumeBarrier(gain=3.0, widening=1.0),
    VolumeBarrier(gain=0.1, widening=8.0),
    VolumeBarrier(gain=1.0, widening=8.0),
    VolumeBarrier(gain=0.3, widening=4.0),
    VolumeBarrier(gain=0.1, widening=1.0),
]
SETTINGS += [
    barrier
    for widening in WIDENINGS
    for gain in GAINS
    if (barrier := VolumeBarrier(gain=gain, widening=widening)) not in SETTINGS
]


def main() -> None:
    """Runs what has not been run, or writes the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/feasibility_defaults"))
    parser.add_argument("--workers", type=int, default=1, help="how many processes")
    parser.add_argument("--courses", type=int, default=COUNT, help="a vehicle")
    parser.add_argument("--page", type=Path, help="write this page, and run nothing")
    options = parser.parse_args()
    if options.page:
        atomic_write(options.page, page(options.out))
        return
    numbers = range(FIRST_JUDGE, FIRST_JUDGE + options.courses)
    for number, barrier in enumerate(SETTINGS):
        # New processes for every setting: pydrake does not free every diagram.
        with new_pool(options.workers) as pool:
            for name, plant in PLANTS.items():
                trials = [plant.trial(name, i, barrier) for i in numbers]
                run_study(trials, options.out / f"{name}-{number:02}.jsonl", pool)
        print(f"{barrier}: {len(numbers)} courses of each vehicle", flush=True)


def page(directory: Path) -> str:
    """Returns the page of the records that there are."""
    return "".join(f"{line}\n" for line in _lines(directory))


def _lines(directory: Path) -> Iterator[str]:
    yield _HEAD
    for name, plant in PLANTS.items():
        records = [
            json.loads(line)
            for path in sorted(directory.glob(f"{name}-*.jsonl"))
            for line in whole_lines(path)
        ]
        yield from _table(name, plant, records)


def _table(name: str, plant: Plant, records: list[Record]) -> Iterator[str]:
    yield f"## {name.capitalize()}, {plant.duration:g} s\n"
    yield "| widening | gain [1/s] | runs | kept | failed | collisions | arrive |"
    yield "| ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for barrier in SETTINGS:
        trial = plant.trial(name, 0, barrier)
        same = (trial.method, trial.overrides)
        runs = [r for r in records if (r["method"], r["overrides"]) == same]
        kept = sum(not is_lost(record) for record in runs)
        counts = (
            sum(bool(record["failed_ticks"]) for record in runs),
            sum(record["collided_at"] is not None for record in runs),
            sum(record["reached_at"] is not None for record in runs),
        )
        setting = f"{barrier.widening:g} | {barrier.gain:g}" if barrier else "- | -"
        cells = " | ".join(map(str, counts))
        yield f"| {setting} | {len(runs)} | {share(kept, len(runs))} | {cells} |"
    yield ""


_HEAD = """\
# Widening and gain for untuned plants

Produced by `python -m examples.feasibility.defaults --page` from the records that
exist: random courses from number 20 000 on, with weakened inputs and without a given
threshold, for the car, the blimp, adaptive cruise control, the quadrotor's slalom and
the arm among its obstacles. A run is *kept* if it has no infeasible tick, no failed
tick and no collision, and does not leave its model (a quadrotor may turn over its
angles). Brackets are Wilson's 95 % intervals. The first row is the same method without
a volume barrier, the second the paper's form, the third the default. The runs are
short, so few arrive.
"""

if __name__ == "__main__":
    main()
