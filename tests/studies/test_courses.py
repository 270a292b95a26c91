"""Random courses of the blimp, and trials that fly them."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from scipy import stats

from vcbf_drake.simulation.loading import dump_scenario, load_scenario
from vcbf_drake.studies import BLIMP_COURSES, CAR_COURSES, Trial, blimp_course
from vcbf_drake.studies.blimp_courses import BLIMP_COURSE_RANGES, SPHERE_COUNTS
from vcbf_drake.studies.car_courses import car_course

BLIMP = "blimp-multiple-obstacles"


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
        (
            "surge speed cap [m/s]",
            lambda c: caps(c)["surge_speed_cap"],
        ),
        (
            "height error cap [m]",
            lambda c: caps(c)["height_error_cap"],
        ),
    ],
)
def test_courses_are_uniform_over_the_stated_ranges(name, read):
    low, high = BLIMP_COURSE_RANGES[name]
    sample = np.array([read(blimp_course(seed)) for seed in range(300)])
    assert low - 1e-3 <= sample.min() <= sample.max() <= high + 1e-3
    assert stats.kstest(sample, stats.uniform(low, high - low).cdf).pvalue > 0.01
