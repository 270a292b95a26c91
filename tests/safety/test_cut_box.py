"""The largest ellipsoid of a box that one row cuts."""

import numpy as np
import pytest

from tests.helpers.fixed_set import fixed_set
from vcbf_drake.safety import InputSet
from vcbf_drake.safety.ellipsoid import cut_box, inscribed_ellipsoid
from vcbf_drake.safety.volume import VolumeMeasure


def sides(a, b):
    """The box and the row that cuts it, as rows."""
    m = len(a)
    return np.vstack([np.eye(m), -np.eye(m), a]), np.append(np.ones(2 * m), b)


@pytest.mark.parametrize("m", [2, 3, 5, 8])
def test_agrees_with_the_cone_program(m):
    rng = np.random.default_rng(m)
    for share in (1e-3, 0.1, 0.4, 0.7, 0.9, 0.999):
        a = rng.normal(size=m) * 10.0 ** rng.uniform(-2.0, 0.0, m)
        a /= np.linalg.norm(a)
        least = -np.abs(a).sum()
        b = least + share * (1.0 - least)
        center, frame, multipliers = cut_box(a, b)
        oracle = inscribed_ellipsoid(*sides(a, b))
        log_det = np.linalg.slogdet(frame)[1]
        assert log_det == pytest.approx(oracle.log_det, abs=1e-8)
        np.testing.assert_allclose(center, oracle.center, atol=1e-8)
        np.testing.assert_allclose(
            frame @ frame.T, oracle.shape @ oracle.shape, atol=1e-8
        )
        np.testing.assert_allclose(
            multipliers, oracle.multipliers, rtol=1e-7, atol=1e-9
        )


def test_a_corner_alone_is_the_simplex():
    """Far sides and the row: the ellipsoid of a simplex, centred where weights are."""
    m, b = 3, -1.7
    a = np.full(m, m**-0.5)
    center, frame, multipliers = cut_box(a, b)
    edge = (b + m**0.5) / (m**-0.5)  # From the corner along each axis.
    np.testing.assert_allclose(center, -1.0 + edge / (m + 1.0))
    np.testing.assert_allclose(np.linalg.norm(frame, axis=1), edge / (m + 1.0))
    assert multipliers[:m].tolist() == [0.0, 0.0, 0.0]
    weights = multipliers[m:] * [
        *np.linalg.norm(frame, axis=1),
        edge / (m + 1) / m**0.5,
    ]
    np.testing.assert_allclose(weights, m / (m + 1.0))


def test_multipliers_are_the_derivative_of_log_det():
    a, step = np.array([0.8, -0.36, 0.48]), 1e-6
    for b in (-0.6, 0.0, 0.5, 0.9):
        (low, high) = (
            np.linalg.slogdet(cut_box(a, b + s)[1])[1] for s in (-step, step)
        )
        slope = (high - low) / (2.0 * step)
        assert cut_box(a, b)[2][-1] == pytest.approx(slope, rel=1e-6)


def test_the_edges_of_its_domain():
    """Where the row only just cuts, and where it leaves next to nothing."""
    box = VolumeMeasure(InputSet.box(-np.ones(3), np.ones(3)))
    a = np.array([[0.6, 0.0, -0.8]])
    for s in (1e-16, 1e-12, 1e-6):
        e = box.largest(a, np.array([1.0 - s]))
        assert e.certified_gap < 1e-9 and -2.0 * s <= e.log_det <= 0.0
    e = box.largest(a, np.array([-1.4 + 1e-6]))
    assert e.certified_gap < 1e-7 and e.log_det < -25.0


def test_one_row_asks_no_solver():
    box = InputSet.box([-1.0, -1.0], [1.0, 1.0])
    # The second row holds everywhere in the box.
    volume = VolumeMeasure(box)(fixed_set(box, [[0.6, 0.8], [1.0, 0.0]], [0.5, 1.1]))
    e = VolumeMeasure(box).largest(np.array([[0.6, 0.8]]), np.array([0.5]))
    assert volume.value == np.exp(e.log_det) < 1.0
    center, _, multipliers = cut_box(np.array([0.6, 0.8]), 0.5)
    np.testing.assert_array_equal(e.center, center)
    np.testing.assert_allclose(e.multipliers, multipliers, rtol=1e-15)
