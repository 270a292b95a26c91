"""The ``feasible_set`` port's value: what is packed comes back."""

import numpy as np
from numpy.testing import assert_allclose

from vcbf_drake.safety.volume import unpack_feasible_set


def test_a_packed_set_comes_back_with_a_symmetric_shape():
    """Of one tick and of a log; the ellipsoid is the same set of points."""
    rng = np.random.default_rng(6)
    packed, frames = [], rng.normal(size=(4, 3, 3))
    frames[2] = np.nan  # Empty at that tick.
    rows, bounds = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5))
    centers = rng.normal(size=(4, 3))
    for tick in range(4):
        parts = rows[tick].ravel(), bounds[tick], frames[tick].ravel(), centers[tick]
        packed.append(np.concatenate(parts))
    log = unpack_feasible_set(np.array(packed), 3)
    assert_allclose(log.A, rows)
    assert_allclose(log.b, bounds)
    assert_allclose(log.center, centers)
    for tick, frame in enumerate(frames):
        one = unpack_feasible_set(packed[tick], 3).shape
        assert_allclose(one, log.shape[tick])
        assert_allclose(one, one.T, atol=1e-14)
        assert_allclose(one @ one, frame @ frame.T, rtol=1e-10, atol=1e-12)
        assert tick == 2 or np.linalg.eigvalsh(one).min() > 0.0


def test_a_frame_that_is_not_whole_is_not_known():
    frame = np.eye(2)
    frame[0, 1] = np.nan
    packed = np.concatenate([np.eye(2).ravel(), np.ones(2), frame.ravel(), np.zeros(2)])
    assert np.isnan(unpack_feasible_set(packed, 2).shape).all()
