"""Boxes, against the exact distance and closed forms."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.row_gradients import row_gradients
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, BoxObstacle
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car

K = (3.0, 2.0)
CENTER, HALF = np.array([1.0, 0.5, -0.2]), np.array([0.8, 0.3, 0.5])
TURN = np.array([[0.6, -0.8], [0.8, 0.6]])


def exact_distance(offset, half):
    """From the nearest point of the box, 0 inside; offsets (N, k) in its own axes."""
    return np.linalg.norm(offset - np.clip(offset, -half, half), axis=-1)


def samples(half, count):
    """Points inside, on the faces, edges and corners, near and far."""
    generator = np.random.default_rng(0)
    points = generator.normal(size=(count, len(half))) * half * 2.0
    on_face = generator.random(points.shape) < 0.3
    return np.where(on_face, np.sign(points) * half, points)


@pytest.mark.parametrize("smoothing", [1e-3, 0.05, 0.5, 5.0])
def test_it_never_exceeds_the_exact_distance_and_is_less_by_the_gap(smoothing) -> None:
    blimp = ControlAffineModel.from_system(Blimp())
    box = BoxObstacle(CENTER, HALF, margin=0.1, smoothing=smoothing)
    z = samples(HALF, 500)
    z[:3] = HALF, np.zeros(3), 100.0 * HALF
    x = np.hstack([CENTER + z, np.zeros((len(z), 5))])
    barriers = BarrierSet(blimp, [box.barrier(K)])
    h = barriers.values_along(x, np.zeros(len(z)))[:, 0]
    below = exact_distance(z, HALF) - 0.1 - h
    assert below.min() >= -1e-12
    assert below.max() <= box.gap + 1e-12
    # The whole gap is lost deep inside, and hardly any of it far away.
    assert smoothing > 0.1 or h[1] == pytest.approx(-0.1 - box.gap, abs=0.01)
    rows = barriers.rows(x[0], 0.0)
    assert np.isfinite(row_gradients(rows).b).all()


def test_the_gap_of_a_wide_box() -> None:
    box = BoxObstacle([0.0, 0.0], [5.0, 4.0], smoothing=0.05)
    assert box.gap == pytest.approx(np.sqrt(2.0) * 0.05 / 2.0, rel=0.01)


def test_a_turned_box_is_a_box_seen_turned() -> None:
    car = ControlAffineModel.from_system(Car())
    turned = BoxObstacle([1.0, 0.5], HALF[:2], TURN, [0.1, 0.3]).barrier(K)
    straight = BoxObstacle(
        TURN.T @ [1.0, 0.5], HALF[:2], None, TURN.T @ [0.1, 0.3]
    ).barrier(K)
    angle = np.arctan2(0.8, 0.6)
    x = np.array([-0.4, 0.9, 0.8, 0.3])
    seen = np.array([*(TURN.T @ x[:2]), 0.8, 0.3 - angle])
    rows = BarrierSet(car, [turned]).rows(x, 0.7)
    expected = BarrierSet(car, [straight]).rows(seen, 0.7)
    for name in ("value", "A", "b", "w"):
        assert_allclose(getattr(rows, name), getattr(expected, name), rtol=1e-10)


@pytest.mark.parametrize(
    "start", [[0.0, 0.1, 0.8, 0.3], [1.2, -0.6, 0.8, 1.2], [1.9, 0.6, 0.7, 0.0]]
)
def test_rows_are_derivatives(start) -> None:
    e, a, velocity = 0.2, HALF[:2], np.array([-0.2, 0.1])
    box = BoxObstacle([2.0, 0.5], a, TURN, velocity, margin=0.1, smoothing=e)
    assert_allclose(box.center_at(2.0), [1.6, 0.7])

    def h(x, t):
        z = TURN.T @ (x[:2] - [2.0, 0.5] - velocity * t)
        s = (np.hypot(z - a, e) + np.hypot(z + a, e)) / 2 - a
        return np.linalg.norm(s) - box.gap - 0.1

    u, d = [0.4, -0.6], [0.3]
    assert_rows_are_derivatives(Car(), box.barrier(K), h, start, u, d)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"center": [1.0]}, "center: .* 2 or 3 numbers"),
        ({"half_widths": [1.0]}, r"half_widths: \[1.0\]; it must be a list of 2"),
        ({"half_widths": [1.0, -1.0]}, r"half_widths\[1\]: .* not below 0"),
        ({"velocity": [1.0]}, "velocity: .* a list of 2 numbers"),
        ({"margin": -0.1}, "margin: -0.1"),
        ({"smoothing": 0.0}, "smoothing: 0"),
        ({"rotation": np.eye(3)}, r"rotation.*2 rows of 2"),
        ({"rotation": [[1.0, 0.1], [0.0, 1.0]]}, "rotation must have orthonormal"),
    ],
)
def test_bad_boxes_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"^box: {message}"):
        BoxObstacle(**{"center": [1.0, 2.0], "half_widths": [0.5, 1], **arguments})
