"""What differs from one trial of a study to the next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.studies.blimp_courses import blimp_course
from vcbf_drake.studies.car_courses import car_course

Range = tuple[float, float]


class Draw(Protocol):
    """What a study draws anew for every trial."""

    @property
    def name(self) -> str:
        """What results call it."""

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns one draw, as overrides of the scenario.

        Args:
            scenario: The scenario around which to draw.
            seed: The study's seed.
            index: Which draw of the study.
        """


@dataclass(frozen=True)
class Variation:
    """Uniform ranges around a scenario.

    Attributes:
        name: What results call it.
        start: Ranges added to the coordinates of the starting position [m].
        observer: Fields of the scenario's observer, each with its range.
    """

    name: str = "none"
    start: tuple[Range, ...] = ()
    observer: tuple[tuple[str, Range], ...] = ()

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns one draw, as overrides of the scenario.

        The draw depends on the seed and the index alone: every method of a pair sees
        the same one, whatever runs before it or beside it.

        Args:
            scenario: The scenario around which to draw.
            seed: The study's seed.
            index: Which draw of the study.
        """
        generator = np.random.default_rng([seed, index])
        offsets = [float(generator.uniform(*bounds)) for bounds in self.start]
        gains = {
            name: float(generator.uniform(*bounds)) for name, bounds in self.observer
        }
        overrides: dict[str, Any] = {}
        if offsets:
            start = list(scenario.initial_state)
            # A car's position has two coordinates; the third offset is not for it.
            for axis, offset in enumerate(offsets[: len(scenario.target)]):
                start[axis] += offset
            overrides["initial_state"] = start
        if gains:
            overrides["observer"] = gains
        return overrides


@dataclass(frozen=True)
class Courses:
    """Random courses in place of the scenario's own.

    Attributes:
        name: What results call them.
        course: Returns the course of a seed, as overrides of the scenario.
    """

    name: str
    course: Callable[[int], dict[str, Any]]

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns a course; the index alone is its seed.

        Args:
            scenario: The scenario whose course is replaced.
            seed: The study's seed; a course is the same in all studies.
            index: Which course.
        """
        return self.course(index)


BLIMP_COURSES = Courses("blimp-courses", blimp_course)
CAR_COURSES = Courses("car-courses", car_course)

# The two cases of the paper's Table I; its distribution is not given, uniform is ours.
TABLE_I = {
    1: Variation("case-1", start=((-0.1, 0.1), (-0.1, 0.1), (0.0, 0.2))),
    2: Variation(
        "case-2",
        observer=(("alpha", (4.6, 6.0)), ("beta", (5.0, 7.0)), ("gamma", (3.6, 4.4))),
    ),
}
