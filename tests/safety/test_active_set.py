"""The projection's dual against its optimality conditions and against quadprog."""

import numpy as np
from numpy.testing import assert_allclose
import pytest
import quadprog

from vcbf_drake.safety.projection import nearest_by_active_set


def random_problem(rng, m, n):
    """Rows of any length around a point they all allow."""
    A = rng.normal(size=(n, m)) * 10.0 ** rng.uniform(-1.0, 1.0, (n, 1))
    inside = rng.normal(size=m)
    return A, A @ inside + rng.uniform(0.0, 1.0, n), 3.0 * rng.normal(size=m)


@pytest.mark.parametrize(("m", "n"), [(1, 4), (2, 3), (2, 9), (3, 12), (4, 20), (6, 8)])
def test_the_multipliers_are_optimal_and_project(m, n):
    """A A'y >= violation and y >= 0, one of them equal; reference - A'y is nearest."""
    rng = np.random.default_rng([m, n])
    longest = 0
    for _ in range(150):
        A, b, reference = random_problem(rng, m, n)
        y = nearest_by_active_set(A, b, reference).multipliers
        slack = A @ (y @ A) - (A @ reference - b)
        size = 1.0 + np.abs(A @ reference - b).max()
        assert y.min() >= 0.0
        assert slack.min() >= -1e-10 * size
        assert_allclose(y * slack, 0.0, atol=1e-9 * size**2)
        nearest = quadprog.solve_qp(np.eye(m), reference, -A.T, -b)[0]
        assert_allclose(reference - y @ A, nearest, atol=1e-8 * size)
        longest = max(longest, np.count_nonzero(y))
    assert longest >= min(m, 2)  # Some answers rest on several rows.


def test_a_reference_that_meets_every_row_needs_no_multiplier():
    A, b = np.array([[2.0, 1.0], [-1.0, 3.0]]), np.array([1.0, 1.0])
    assert not nearest_by_active_set(A, b, np.zeros(2)).multipliers.any()
    assert (
        nearest_by_active_set(
            np.zeros((0, 2)), np.zeros(0), np.ones(2)
        ).multipliers.size
        == 0
    )


def test_rows_without_a_common_point_end_in_farkas_proof():
    A, b = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]]), np.array([-1.0, 0.0, 5.0])
    found = nearest_by_active_set(A, b, np.array([0.3, 0.2]))
    assert np.isfinite(found.multipliers).all() and found.multipliers.min() >= 0.0
    assert found.conflict.min() >= 0.0
    assert_allclose(found.conflict @ A, 0.0, atol=1e-15)
    assert found.conflict @ b < -0.5 * found.conflict.max()
    b[1] = 2.0
    assert nearest_by_active_set(A, b, np.array([0.3, 0.2])).conflict is None


@pytest.mark.parametrize("tilt", [1.0, 1e-8, 1e-15])
@pytest.mark.parametrize("far", [2.0, 1e12])
def test_rational_numbers_round_nothing_at_any_angle(tilt, far):
    """Two rows that meet at (1, 0), as steep as they may be."""
    A = np.array([[tilt, 1.0], [tilt, -1.0]])
    found = nearest_by_active_set(
        A, np.array([tilt, tilt]), np.array([far, 0.0]), is_exact=True
    )
    assert found.conflict is None
    assert_allclose(found.point, [1.0, 0.0], rtol=0.0, atol=0.0)
    assert_allclose(found.multipliers, 0.5 * (far - 1.0) / tilt, rtol=1e-15)


def test_rational_numbers_tell_a_gap_of_one_rounding_from_none():
    A, ulp = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.finfo(float).eps
    touching = nearest_by_active_set(
        A, np.array([1.0, -1.0]), np.zeros(2), is_exact=True
    )
    assert touching.conflict is None
    assert_allclose(touching.point, [1.0, 0.0], rtol=0.0, atol=0.0)
    apart = nearest_by_active_set(
        A, np.array([1.0, -1.0 - ulp]), np.zeros(2), is_exact=True
    )
    assert_allclose(apart.conflict, [1.0, 1.0], rtol=0.0, atol=0.0)


@pytest.mark.parametrize(("m", "n"), [(1, 4), (3, 12), (4, 20)])
def test_rational_numbers_and_floats_agree(m, n):
    rng = np.random.default_rng([m, n, 1])
    for _ in range(20):
        A, b, reference = random_problem(rng, m, n)
        floats = nearest_by_active_set(A, b, reference)
        exact = nearest_by_active_set(A, b, reference, is_exact=True)
        assert_allclose(exact.point, floats.point, atol=1e-9)
        assert_allclose(exact.multipliers, floats.multipliers, atol=1e-6)
