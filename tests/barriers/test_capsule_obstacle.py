"""Capsules, against the exact distance and closed forms."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.row_gradients import row_gradients
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, CapsuleObstacle, SphereObstacle
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car

K = (3.0, 2.0)
START, END = np.array([1.0, 0.5, -0.2]), np.array([2.0, -1.0, 0.4])


def exact_distance(points, start, end, radius):
    """The signed distance to the surface, from the nearest point of the segment."""
    along = (points - start) @ (end - start) / np.sum((end - start) ** 2)
    nearest = start + np.clip(along, 0.0, 1.0)[:, np.newaxis] * (end - start)
    return np.linalg.norm(points - nearest, axis=1) - radius


@pytest.mark.parametrize("smoothing", [1e-3, 0.05, 0.5, 5.0])
def test_it_never_exceeds_the_exact_distance_and_is_less_by_the_gap(smoothing) -> None:
    blimp = ControlAffineModel.from_system(Blimp())
    pole = CapsuleObstacle(START, END, 0.3, margin=0.1, smoothing=smoothing)
    points = np.random.default_rng(0).normal(scale=1.5, size=(500, 3))
    # Points of the axis itself, its ends among them, and one far away.
    points[:6] = START + np.linspace(-1, 2, 6)[:, np.newaxis] * (END - START)
    points[6:9] = START, END, 100.0 * END
    x = np.hstack([points, np.zeros((len(points), 5))])
    barriers = BarrierSet(blimp, [pole.barrier(K)])
    h = barriers.values_along(x, np.zeros(len(x)))[:, 0]
    below = exact_distance(points, START, END, 0.3) - 0.1 - h
    assert below.min() >= -1e-12
    assert below.max() <= pole.gap + 1e-12
    assert np.isfinite(row_gradients(barriers.rows(x[3], 0.0)).b).all()


def test_the_gap_of_a_long_capsule() -> None:
    pole = CapsuleObstacle([0.0, 0.0], [0.0, 9.0], 0.3, smoothing=0.05)
    assert pole.gap == pytest.approx(0.05 / 2.0, rel=0.01)


def test_abeam_of_a_long_capsule_it_is_a_disc_in_its_cross_section() -> None:
    blimp = ControlAffineModel.from_system(Blimp())
    pole = CapsuleObstacle([1.0, 0.5, -100], [1.0, 0.5, 100], 0.3, smoothing=1e-3)
    disc = SphereObstacle([1.0, 0.5], 0.3 + pole.gap)
    barriers = BarrierSet(blimp, [pole.barrier(K), disc.barrier(K)])
    rows = barriers.rows(np.random.default_rng(1).normal(size=8), 0.0)
    for array in (rows.value, rows.A, rows.b, rows.w):
        assert_allclose(array[0], array[1], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("start", [[0.0, 0.1, 0.8, 0.3], [0.9, 0.9, 0.7, -1.0]])
def test_rows_are_derivatives(start) -> None:
    e, velocity = 0.2, np.array([-0.2, 0.1])
    ends = np.array([1.0, 0.5]), np.array([1.6, 1.3])
    pole = CapsuleObstacle(*ends, 0.2, velocity, margin=0.1, smoothing=e)
    assert_allclose(pole.center_at(2.0), [0.9, 1.1])

    def h(x, t):
        offset = x[:2] - [1.3, 0.9] - velocity * t
        z, y = offset @ [0.6, 0.8], offset @ [-0.8, 0.6]
        s = (np.hypot(z - 0.5, e) + np.hypot(z + 0.5, e)) / 2 - 0.5
        return np.hypot(y, s) - pole.gap - 0.2 - 0.1

    u, d = [0.4, -0.6], [0.3]
    assert_rows_are_derivatives(Car(), pole.barrier(K), h, start, u, d)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": [1.0], "end": [2.0]}, "center: .* 2 or 3 numbers"),
        ({"end": [1.0, 2.0]}, "two different points of one size"),
        ({"end": [1.0, 2.0, 3.0]}, "two different points of one size"),
        ({"start": np.ones(2), "end": np.ones(2)}, r"got \[1.0, 1.0\] and \[1.0, 1.0"),
        ({"end": [1.0, np.nan]}, r"end: .*finite numbers"),
        ({"velocity": [1.0]}, "velocity: .* a list of 2 numbers"),
        ({"radius": -1.0}, "radius: -1"),
        ({"margin": -0.1}, "margin: -0.1"),
        ({"smoothing": 0.0}, "smoothing: 0"),
    ],
)
def test_bad_capsules_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"^capsule: .*{message}"):
        CapsuleObstacle(
            **{"start": [1.0, 2.0], "end": [2.0, 2.0], "radius": 0.5, **arguments}
        )
