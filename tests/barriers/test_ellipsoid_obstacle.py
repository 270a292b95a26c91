"""Ellipsoids, against the exact distance and closed forms."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.optimize import brentq

from tests.helpers.row_gradients import row_gradients
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, EllipsoidObstacle, SphereObstacle
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car

K = (3.0, 2.0)
ANGLE = 0.7
TURN = np.array(
    [[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1.0]]
)
CENTER, AXES = np.array([1.0, 0.5, -0.2]), np.array([1.5, 0.6, 0.9])


@pytest.fixture(scope="module")
def blimp() -> ControlAffineModel:
    return ControlAffineModel.from_system(Blimp())


def exact_distance(z) -> float:
    """From a point outside, in the ellipsoid's own axes, by its nearest point."""
    root = brentq(
        lambda s: np.sum((AXES * z / (AXES**2 + s)) ** 2) - 1.0, 0.0, 1e4, xtol=1e-13
    )
    return np.linalg.norm(z - AXES**2 * z / (AXES**2 + root))


def at(position) -> np.ndarray:
    return np.append(position, np.zeros(5))


def test_outside_it_never_exceeds_the_exact_distance(blimp) -> None:
    margin = 0.1
    obstacle = EllipsoidObstacle(CENTER, AXES, TURN, margin=margin)
    barriers = BarrierSet(blimp, [obstacle.barrier(K)])
    generator = np.random.default_rng(0)
    for _ in range(200):
        direction = generator.normal(size=3)
        direction /= np.linalg.norm(direction / AXES)
        z = direction * (1.0 + generator.exponential(0.7))
        (h,) = barriers.values(at(CENTER + TURN @ z), 0.0)
        assert -margin - 1e-12 <= h <= exact_distance(z) - margin + 1e-9


def test_it_is_exact_on_the_surface_and_along_the_shortest_axis(blimp) -> None:
    barriers = BarrierSet(
        blimp, [EllipsoidObstacle(CENTER, AXES, TURN, margin=0.1).barrier(K)]
    )
    for i, scale in ((0, 1.0), (1, 1.0), (2, 1.0), (1, 4.0), (1, 0.5)):
        z = scale * AXES[i] * np.eye(3)[i]
        expected = AXES[1] * (scale - 1.0) - 0.1
        assert barriers.values(at(CENTER + TURN @ z), 0.0) == pytest.approx([expected])


def test_equal_axes_make_a_sphere(blimp) -> None:
    velocity = [0.1, -0.2, 0.3]
    ball = EllipsoidObstacle(CENTER, [0.4] * 3, TURN, velocity, margin=0.1)
    sphere = SphereObstacle(CENTER, 0.4, velocity, margin=0.1)
    rows = BarrierSet(blimp, [ball.barrier(K), sphere.barrier(K)]).rows(
        np.random.default_rng(1).normal(size=8), 1.3
    )
    for array in (rows.value, rows.A, rows.b, rows.w, row_gradients(rows).b):
        assert_allclose(array[0], array[1], rtol=1e-10, atol=1e-12)


def test_rows_are_derivatives() -> None:
    a, velocity = np.array([0.8, 0.3]), np.array([-0.2, 0.1])
    R = TURN[:2, :2]
    obstacle = EllipsoidObstacle([2.0, 0.5], a, R, velocity, margin=0.1)
    assert_allclose(obstacle.center_at(2.0), [1.6, 0.7])

    def h(x, t):
        offset = x[:2] - [2.0, 0.5] - velocity * t
        Q = R @ np.diag(a**-2) @ R.T
        return 0.3 * (np.sqrt(offset @ Q @ offset) - 1.0) - 0.1

    start, u, d = [0.0, 0.1, 0.8, 0.3], [0.4, -0.6], [0.3]
    assert_rows_are_derivatives(Car(), obstacle.barrier(K), h, start, u, d)


def test_at_the_centre_the_row_is_nan(blimp) -> None:
    rows = BarrierSet(blimp, [EllipsoidObstacle(CENTER, AXES).barrier(K)]).rows(
        at(CENTER), 0.0
    )
    assert not np.isfinite(rows.b).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"center": [1.0]}, "center: .* 2 or 3 numbers"),
        ({"center": [1.0, np.inf]}, r"center: .*finite numbers"),
        ({"semi_axes": [1.0]}, r"semi_axes: \[1.0\]; it must be a list of 2"),
        ({"semi_axes": [1.0, 0.0]}, r"semi_axes\[1\]: .* finite and above 0"),
        ({"velocity": [1.0]}, "velocity: .* a list of 2 numbers"),
        ({"margin": -0.1}, "margin: -0.1"),
        ({"rotation": np.eye(3)}, r"rotation.*2 rows of 2"),
        ({"rotation": [[1.0, 0.1], [0.0, 1.0]]}, "rotation must have orthonormal"),
        ({"rotation": np.full((2, 2), np.nan)}, "rotation.*finite"),
    ],
)
def test_bad_ellipsoids_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"^ellipsoid: {message}"):
        EllipsoidObstacle(**{"center": [1.0, 2.0], "semi_axes": [0.5, 1], **arguments})
