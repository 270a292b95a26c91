"""Random courses of the blimp and the car, and trials over them."""

from __future__ import annotations

import json
import math
import pickle
from typing import Any

import numpy as np
import pytest
from scipy import stats

from examples.paper.blimp_courses import (
    BLIMP_COURSE_RANGES,
    BLIMP_COURSES,
    SPHERE_COUNTS,
    blimp_course,
)
from examples.paper.car_courses import (
    BARRIER_GAINS,
    CAR_COURSE_RANGES,
    CAR_COURSES,
    car_course,
)
from vcbf_drake.simulation import Scenario
from vcbf_drake.simulation.loading import dump_scenario, load_scenario
from vcbf_drake.studies import Trial

BLIMP, SHIPPED = "blimp-multiple-obstacles", "car-sensitivity"


def test_the_shipped_scenario_is_course_five():
    shipped = load_scenario(BLIMP)
    course = load_scenario(BLIMP, blimp_course(5))
    course.name = shipped.name
    assert dump_scenario(course) == dump_scenario(shipped)


def test_a_course_is_the_same_in_every_study():
    trials = [
        Trial(BLIMP, method, 3, seed, BLIMP_COURSES)
        for method in ("dob-cbf-qp", "dob-vcbf-qp")
        for seed in (0, 7)
    ]
    drawn = {trial.all_overrides() for trial in trials}
    assert len(drawn) == 1
    assert trials[0].load().name == "blimp-course-3"


def test_trials_on_courses_travel_to_other_processes():
    for courses, scenario in ((BLIMP_COURSES, BLIMP), (CAR_COURSES, "car-sensitivity")):
        trial = Trial(scenario, "dob-cbf-qp", 1, variation=courses)
        again = pickle.loads(pickle.dumps(trial))
        assert again == trial
        assert again.all_overrides() == trial.all_overrides()


def test_a_cars_course_keeps_the_trials_approach_gain():
    slow = "{vehicle: {controller: {approach_gain: 0.4}}}"
    trial = Trial("car-sensitivity", "cbf-qp", 2, 0, CAR_COURSES, slow)
    scenario = trial.load()
    assert scenario.vehicle.controller.approach_gain == 0.4
    discs = car_course(2)["obstacles"]
    assert [each.center for each in scenario.obstacles] == [d["center"] for d in discs]


def test_spheres_are_clear_of_start_and_target():
    counts = set()
    for seed in range(100):
        spheres = blimp_course(seed)["obstacles"]
        counts.add(len(spheres))
        for sphere in spheres:
            center, radius = sphere["center"], sphere["radius"]
            # Centres and radii are rounded to the centimetre.
            assert math.dist(center, (0.0, 0.0, 0.0)) > radius + 1.5 - 0.02
            assert math.dist(center, (14.0, 3.0, 2.5)) > radius + 1.2 - 0.02
            assert 0.5 <= radius <= 1.0
    assert counts == set(SPHERE_COUNTS)


def caps(course):
    """The controller's caps that a course sets."""
    return course["vehicle"]["controller"]


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("thrust [m/s^2]", lambda c: c["input_set"]["upper"][0] / 0.1715),
        (
            "reverse thrust over thrust",
            lambda c: -c["input_set"]["lower"][0] / c["input_set"]["upper"][0],
        ),
        ("surge speed cap [m/s]", lambda c: caps(c)["surge_speed_cap"]),
        ("height error cap [m]", lambda c: caps(c)["height_error_cap"]),
    ],
)
def test_courses_are_uniform_over_the_stated_ranges(name, read):
    low, high = BLIMP_COURSE_RANGES[name]
    sample = np.array([read(blimp_course(seed)) for seed in range(300)])
    assert low - 1e-3 <= sample.min() <= sample.max() <= high + 1e-3
    assert stats.kstest(sample, stats.uniform(low, high - low).cdf).pvalue > 0.01


# The car ---------------------------------------------------------------------------


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
    assert scenario.barrier.gains in [list(k) for k in BARRIER_GAINS]


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
