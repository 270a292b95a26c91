"""A box cut by one row: the closed form against optimality and against Drake."""

import numpy as np
from numpy.testing import assert_allclose
from pydrake.geometry.optimization import HPolyhedron
import pytest

from vcbf_drake.safety.cut_box import box_cut_by_row


def unit_rows(m, count=40):
    generator = np.random.default_rng(m)
    for _ in range(count):
        a = generator.normal(size=m) * 10.0 ** generator.uniform(-1.5, 0.0, m)
        a /= np.linalg.norm(a)
        yield a, generator.uniform(-0.95 * np.abs(a).sum(), 0.999)


def set_of(a, b):
    m = len(a)
    return np.vstack([np.eye(m), -np.eye(m), a]), np.append(np.ones(2 * m), b)


@pytest.mark.parametrize("m", [2, 3, 4, 6])
def test_the_optimality_conditions_hold(m):
    """B^-1 = sum lambda_i sym(B a_i a_i') / |B a_i|, sum lambda_i a_i = 0, inside."""
    for a, b in unit_rows(m):
        center, frame, multipliers = box_cut_by_row(a, b)
        A, bounds = set_of(a, b)
        reach = np.linalg.norm(A @ frame, axis=1)
        slack = bounds - A @ center - reach
        assert slack.min() > -1e-13
        assert multipliers.min() >= 0.0
        assert_allclose(multipliers * slack, 0.0, atol=1e-12 * (1 + multipliers.max()))
        assert_allclose(multipliers @ A, 0.0, atol=1e-12 * (1 + multipliers.max()))
        normals = A @ frame / reach[:, None]
        weights = (multipliers * reach)[:, None]
        assert_allclose((weights * normals).T @ normals, np.eye(m), atol=1e-11)


@pytest.mark.parametrize("m", [2, 3])
def test_it_is_the_ellipsoid_that_drake_finds(m):
    for a, b in unit_rows(m, 12):
        if b < 0.0:
            continue
        center, frame, _ = box_cut_by_row(a, b)
        drake = HPolyhedron(*set_of(a, b)).MaximumVolumeInscribedEllipsoid()
        assert_allclose(center, drake.center(), atol=1e-4)
        covariance = np.linalg.inv(drake.A().T @ drake.A())
        assert_allclose(frame @ frame.T, covariance, atol=1e-4)


def test_a_mirrored_row_has_a_mirrored_ellipsoid():
    a, b = np.array([0.6, 0.8]), 0.2
    center, frame, multipliers = box_cut_by_row(a, b)
    mirrored = box_cut_by_row(a * [-1.0, 1.0], b)
    assert_allclose(mirrored[0], center * [-1.0, 1.0])
    sign = np.outer([-1.0, 1.0], [-1.0, 1.0])
    assert_allclose(mirrored[1] @ mirrored[1].T, frame @ frame.T * sign)
    assert_allclose(mirrored[2], multipliers[[2, 1, 0, 3, 4]])


def test_a_corner_of_the_box_is_a_triangle():
    """Steiner's inellipse: centre in the centroid, area pi / (3 sqrt 3) of it."""
    a = np.array([1.0, 1.0]) / np.sqrt(2.0)
    center, frame, _ = box_cut_by_row(a, -1.0 / np.sqrt(2.0))
    assert_allclose(center, [-2.0 / 3.0, -2.0 / 3.0], rtol=1e-12)
    area = np.pi * abs(np.linalg.det(frame))
    assert area == pytest.approx(np.pi / (3.0 * np.sqrt(3.0)) * 0.5, rel=1e-12)


def test_rows_it_does_not_know_are_left_to_the_solver():
    assert box_cut_by_row(np.array([1.0, 1e-7]), 0.5) is None
    assert box_cut_by_row(np.array([0.6, 0.8]), -1.4) is None
