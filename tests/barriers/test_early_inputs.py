"""Barriers whose relative degree is mixed: a car's corners (E8a)."""

import numpy as np
from numpy.testing import assert_allclose
from pydrake.systems.primitives import LinearSystem
import pytest

from vcbf_drake import (
    BarrierSet,
    Car,
    ControlAffineModel,
    ModelError,
    PerceivedSpheres,
    SphereObstacle,
    load_scenario,
    simulate,
)
from vcbf_drake.barriers import HalfSpace, MovingObstacle
from vcbf_drake.plants import CarVehicle
from vcbf_drake.simulation import barriers

RATES = (3.0, 1.0)
GAINS = np.poly(-np.array(RATES))[1:]
AHEAD, LEFT = 0.3, 0.15
STATE = np.array([0.4, -0.2, 0.7, 0.5])
INPUT = np.array([1.3, -0.8])
DISC = np.array([2.0, 0.3]), 0.5


@pytest.fixture(scope="module")
def model():
    return ControlAffineModel.from_system(Car())


@pytest.fixture(scope="module")
def corner():
    return CarVehicle().body_position([AHEAD, LEFT])


def distance(x, t=0.0, velocity=(0.0, 0.0)):
    """How far a car's corner is from the disc, by hand."""
    c, s = np.cos(x[3]), np.sin(x[3])
    place = x[:2] + np.array([c * AHEAD - s * LEFT, s * AHEAD + c * LEFT])
    center, radius = DISC
    return np.linalg.norm(place - center - t * np.array(velocity)) - radius


def rate(function, x, xdot, step=1e-6):
    return (function(x + step * xdot) - function(x - step * xdot)) / (2.0 * step)


def motion(model, x, u):
    f, g = model.drift_and_input_matrix(x)
    return f + g @ u


def test_a_corner_has_a_row_for_each_level(model, corner):
    """Each row is that of differences of the distance, with every input in it."""
    barrier = SphereObstacle(*DISC).barrier(GAINS, corner, "corner")
    rows = BarrierSet(model, [barrier]).rows(STATE, 0.0)
    names = BarrierSet(model, [barrier]).names
    assert names == ("corner", "corner (derivative 1)")

    def level(x):
        coasting = motion(model, x, np.zeros(2))
        return rate(distance, x, coasting) + RATES[0] * distance(x)

    for u in (INPUT, np.zeros(2), -3.0 * INPUT):
        xdot, chi = motion(model, STATE, u), rows.b - rows.A @ u
        first = rate(distance, STATE, xdot) + RATES[0] * distance(STATE)
        last = rate(level, STATE, xdot, 1e-4) + RATES[1] * level(STATE)
        assert_allclose(chi, [last, first], rtol=1e-4)
    assert abs(rows.A[1, 1]) > 0.1 and rows.A[1, 0] == 0.0 != rows.A[0, 0]
    assert_allclose(rows.chain[0], [distance(STATE), level(STATE)], rtol=1e-6)
    assert rows.b[1] == rows.chain[0][1] and np.isnan(rows.value[1])


def test_the_early_row_is_differentiated(model, corner):
    rows = BarrierSet(model, [SphereObstacle(*DISC).barrier(GAINS, corner)])
    xbar = np.array([*STATE, 0.4])

    def entries(point):
        found = rows.rows(point[:4], point[4])
        return np.concatenate([found.A[1], [found.b[1]]])

    slopes = rows.rows(STATE, 0.4).gradients([1])[0, :3]
    for i, unit in enumerate(np.eye(5)):
        assert_allclose(slopes[:, i], rate(entries, xbar, unit), atol=1e-7)


def test_an_early_row_that_no_input_moves_is_no_failed_hypothesis(model, corner):
    """It holds for every input as long as its level is not below 0."""
    barriers_of_car = BarrierSet(model, [HalfSpace([1.0, 0.0]).barrier(GAINS, corner)])
    turned = np.array([1.0, 0.0, 0.5, -np.arctan2(LEFT, AHEAD)])
    rows = barriers_of_car.rows(turned, 0.0)
    assert_allclose(rows.A[1], 0.0, atol=1e-12)
    assert np.isinf(rows.authority(np.ones(2))[1])


def test_early_rows_follow_what_is_perceived_and_what_moves(model, corner):
    center, radius = DISC
    spheres = PerceivedSpheres(capacity=2, dimensions=2)
    seen = BarrierSet(model, spheres.barriers(GAINS, corner))
    slots = spheres.pack([center], [[0.1, -0.2]], [radius])
    found = seen.rows(STATE, 0.0, slots)
    known = SphereObstacle(center, radius, [0.1, -0.2])
    expected = BarrierSet(model, [known.barrier(GAINS, corner)]).rows(STATE, 0.0)
    assert_allclose(found.A[[0, 2]], expected.A)
    assert_allclose(found.b[[0, 2]], expected.b)
    assert_allclose(found.A[[1, 3]], 0.0)
    assert_allclose(found.b[[1, 3]], 1.0)
    path = [[2.0, 0.3], [2.5, 0.2], [3.0, 0.4]]
    moving = MovingObstacle(SphereObstacle([0.0, 0.0], radius), [0.0, 2.0, 4.0], path)
    along = BarrierSet(model, moving.barriers(GAINS, corner))
    offset = moving.offset_at(1.0)
    speed = moving.trajectory().EvalDerivative(1.0, 1).ravel()
    there = SphereObstacle(offset - speed, radius, speed).barrier(GAINS, corner)
    expected = BarrierSet(model, [there]).rows(STATE, 1.0)
    assert_allclose(along.rows(STATE, 1.0).b[1], expected.b[1])
    assert_allclose(along.rows(STATE, 1.0).A[1], expected.A[1])


def test_where_every_input_is_early_the_degree_is_named():
    """An integrator of two inputs: nothing is left for a second derivative."""
    system = LinearSystem(np.zeros((2, 2)), np.eye(2), np.eye(2), np.zeros((2, 2)))
    free = ControlAffineModel.from_system(system)
    wall = HalfSpace([1.0, 0.5]).barrier(GAINS, [0, 1])
    with pytest.raises(ModelError, match="relative degree is 1, not 2: give 1 gain"):
        BarrierSet(free, [wall])


def test_the_corners_of_the_shipped_car_keep_clear():
    """By the corners' own geometry, at every tick; certified between them."""
    corners = [(a, b) for a in (0.2, -0.2) for b in (0.12, -0.12)]
    scenario = load_scenario(
        "car-avoidance",
        {
            "body": [{"point": list(corner)} for corner in corners],
            "obstacles": [{"center": [3.4, 0.15], "radius": 0.4}],
            "between_ticks": "certified",
            "duration": 6.0,
        },
    )
    names = [each.name for each in barriers(scenario)]
    assert names == [f"obstacle 1 (point {i})" for i in (1, 2, 3, 4)]
    result = simulate(scenario, step_time=False)
    assert result.summary["guaranteed"], result.summary["outcome"]
    x, y, _, psi = result.log["state"].T
    c, s = np.cos(psi), np.sin(psi)
    least = min(
        (np.hypot(x + c * a - s * b - 3.4, y + s * a + c * b - 0.15) - 0.4).min()
        for a, b in corners
    )
    certified = result.summary["certified_min_barrier"]
    assert -1e-3 < certified <= result.summary["min_barrier"]
    assert 0.0 < least < 0.1  # Clear of it, and no further away than needed.
