"""Volumes and faces against scipy's hulls, and derivatives against differences."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection

from vcbf_drake.errors import SolverError
from vcbf_drake.safety.face_volumes import face_volumes


def box(m):
    return np.concatenate([np.eye(m), -np.eye(m)])


def random_polytope(rng, m, cuts=5):
    """A box around the origin, cut by random planes that leave the origin inside."""
    normals = rng.normal(size=(cuts, m)) * rng.uniform(0.1, 10.0, (cuts, 1))
    distance = rng.uniform(0.1, 1.2, cuts) * np.linalg.norm(normals, axis=1)
    return np.vstack([box(m), normals]), np.concatenate([np.ones(2 * m), distance])


def hull_volume(A, b):
    corners = HalfspaceIntersection(np.c_[A, -b], np.zeros(A.shape[1])).intersections
    return ConvexHull(corners).volume


@pytest.mark.parametrize("m", [2, 3])
def test_volume_agrees_with_a_hull_of_the_corners(m):
    rng = np.random.default_rng(m)
    for _ in range(40):
        A, b = random_polytope(rng, m)
        assert face_volumes(A, b)[0] == pytest.approx(hull_volume(A, b), rel=1e-9)


def test_interval():
    A, b = np.array([[2.0], [-1.0], [4.0]]), np.array([2.0, 0.5, 10.0])
    volume, multipliers, points = face_volumes(A, b)
    assert volume == pytest.approx(1.5)
    np.testing.assert_allclose(multipliers, [0.5, 1.0, 0.0])
    np.testing.assert_allclose(points[:2, 0], [1.0, -0.5])


@pytest.mark.parametrize("width", [1e-6, 0.5, 1.0, 3.0])
def test_intervals_of_any_width(width):
    volume, multipliers, points = face_volumes(
        np.array([[1.0], [-1.0]]), np.array([2.0 + width, -2.0])
    )
    assert volume == pytest.approx(width, rel=1e-9)
    np.testing.assert_allclose(multipliers, [1.0, 1.0])
    np.testing.assert_allclose(points[:, 0], [2.0 + width, 2.0])


@pytest.mark.parametrize("m", [1, 2, 3])
def test_derivative_agrees_with_central_differences(m):
    rng, step = np.random.default_rng(10 + m), 1e-6
    for _ in range(20):
        A, b = random_polytope(rng, m)
        dA, db = rng.normal(size=A.shape), rng.normal(size=len(b))
        ahead, behind = (face_volumes(A + h * dA, b + h * db)[0] for h in (step, -step))
        _, multipliers, points = face_volumes(A, b)
        exact = multipliers @ (db - np.einsum("ij,ij->i", dA, points))
        assert exact == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-6)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_rows_given_twice_or_scaled_count_once(m):
    A, b = random_polytope(np.random.default_rng(20 + m), m)
    volume, multipliers, _ = face_volumes(A, b)
    again, shared, _ = face_volumes(np.vstack([A, 3.0 * A]), np.append(b, 3.0 * b))
    assert again == pytest.approx(volume)
    once, twice = shared[: len(b)], 3.0 * shared[len(b) :]
    np.testing.assert_allclose(once + twice, multipliers)
    assert not (once * twice).any()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_empty_and_flat_sets_have_no_volume(m):
    A = np.vstack([box(m), np.eye(m)[:1]])
    for most in (-1.5, -1.0):
        volume, multipliers, _ = face_volumes(A, np.append(np.ones(2 * m), most))
        assert volume == pytest.approx(0.0, abs=1e-12)
        assert multipliers.any() == (m > 1 and most == -1.0)
    blank = np.vstack([box(m), np.zeros((1, m))])
    assert face_volumes(blank, np.append(np.ones(2 * m), -0.1))[0] == 0.0
    kept, multipliers, _ = face_volumes(blank, np.append(np.ones(2 * m), 0.1))
    assert kept == pytest.approx(2.0**m)
    assert multipliers[-1] == 0.0


def test_unbounded_set_is_refused():
    with pytest.raises(SolverError, match="unbounded"):
        face_volumes(np.array([[1.0, 0.0], [0.0, 1.0]]), np.ones(2))
