from __future__ import annotations

import json
import math
from typing import Any

import pytest

from vcbf_drake.simulation import Scenario, load_scenario
from vcbf_drake.studies import car_courses
from vcbf_drake.studies.car_courses import CAR_COURSE_RANGES, car_course

SHIPPED = "car-sensitivity"


def load(seed: int) -> Scenario:
    return load_scenario(SHIPPED, car_course(seed))


def gap(disc: Any, other: Any) -> float:
    return math.dist(disc.center, other.center) - disc.radius - other.radius


def test_a_seed_gives_the_same_course_whatever_was_drawn_before() -> None:
    alone = json.dumps(car_course(7))
    for seed in range(5):
        car_course(seed)
    assert json.dumps(car_course(7)) == alone
    assert len({json.dumps(car_course(seed)) for seed in range(50)}) == 50


def test_first_course_is_the_one_that_reports_speak_of() -> None:
    """A changed generator makes every recorded rate stale; then this test fails."""
    scenario = load(0)
    assert scenario.input_set.upper == [0.573, 0.992]
    assert scenario.disturbance[0].amplitude == [0.083]
    assert [disc.radius for disc in scenario.obstacles] == [0.416, 0.357]


@pytest.mark.parametrize("seed", range(40))
def test_courses_are_valid_and_stay_inside_the_stated_ranges(seed: int) -> None:
    scenario = load(seed)
    force, turn_rate = scenario.input_set.upper
    assert scenario.input_set.lower == [-force, -turn_rate]
    share = scenario.disturbance[0].amplitude[0] * scenario.vehicle.mass / force
    for name, value in (
        ("force limit [N]", force),
        ("turn rate limit [rad/s]", turn_rate),
        ("push over force limit", round(share, 2)),
        ("gate width [m]", round(gap(*scenario.obstacles[:2]), 2)),
        *(("disc radius [m]", disc.radius) for disc in scenario.obstacles),
    ):
        low, high = CAR_COURSE_RANGES[name]
        assert low <= value <= high, name
    assert scenario.barrier.gains in [list(k) for k in car_courses.BARRIER_GAINS]


@pytest.mark.parametrize("seed", range(40))
def test_passages_and_both_ends_of_the_way_stay_open(seed: int) -> None:
    scenario = load(seed)
    discs = scenario.obstacles
    for index, disc in enumerate(discs):
        for end in (scenario.initial_state[:2], scenario.target):
            assert math.dist(disc.center, end) - disc.radius >= 0.6 - 1e-9
        assert all(gap(disc, other) >= 0.198 for other in discs[:index])


def test_courses_vary_in_how_many_discs_and_which_gains_they_have() -> None:
    courses = [load(seed) for seed in range(60)]
    assert {len(course.obstacles) for course in courses} == {2, 3, 4}
    assert len({tuple(course.barrier.gains) for course in courses}) == 3


def test_what_a_course_leaves_alone_is_the_scenarios() -> None:
    shipped, drawn = load_scenario(SHIPPED), load(3)
    assert shipped.vehicle == drawn.vehicle
    assert (shipped.initial_state[:2], shipped.target) == ([0.0, 0.0], [5.0, 0.0])
    assert (drawn.initial_state, drawn.target) == (shipped.initial_state, [5.0, 0.0])
