"""What rows leave of an ellipsoid: against sampling, Drake and scipy."""

import numpy as np
from pydrake.geometry.optimization import HPolyhedron
import pytest
from scipy.optimize import minimize_scalar

from vcbf_drake.safety import InputSet, ellipsoid_solver
from vcbf_drake.safety.cut_ellipsoid import cut_ellipsoid, estimated_weights
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver


def cut_box(m, count, generator):
    """A box and rows around its centre, each cutting the unit ball."""
    rows = generator.normal(size=(count, m))
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    return rows, generator.uniform(0.2, 0.95, count)


def whole(rows, bounds):
    m = rows.shape[1]
    box = np.vstack([np.eye(m), -np.eye(m)])
    return np.vstack([box, rows]), np.append(np.ones(2 * m), bounds)


@pytest.mark.parametrize("m", [2, 3, 6])
@pytest.mark.parametrize("beta", [-0.6, -0.2, 0.0, 0.3, 0.9])
def test_what_one_row_leaves_of_the_ball_is_largest(m, beta):
    n = np.random.default_rng(m).normal(size=m)
    n /= np.linalg.norm(n)
    center, frame = cut_ellipsoid(n[None], np.array([beta]), np.zeros(m), np.eye(m))
    height = np.linspace(-1.0, 1.0, 20001)[1:-1]

    def volume(tau):
        """Of the widest ellipsoid of revolution of half-length tau at the row."""
        along = beta - tau + tau * height
        across = np.min((1.0 - along**2) / (1.0 - height**2))
        return np.log(tau) + 0.5 * (m - 1) * np.log(max(across, 1e-300))

    found = minimize_scalar(
        lambda tau: -volume(tau), bounds=(1e-3, 0.5 * (1.0 + beta)), method="bounded"
    )
    assert np.linalg.slogdet(frame)[1] == pytest.approx(-found.fun, abs=1e-5)
    # It touches the row, and the ball from inside.
    assert n @ center + np.linalg.norm(frame.T @ n) == pytest.approx(beta, abs=1e-12)
    points = np.random.default_rng(1).normal(size=(5000, m))
    points /= np.linalg.norm(points, axis=1)[:, None]
    farthest = np.linalg.norm(center + points @ frame.T, axis=1).max()
    assert farthest < 1.0 + 1e-9


@pytest.mark.parametrize("m", [2, 3, 4])
def test_what_is_left_meets_every_row(m):
    generator = np.random.default_rng(10 + m)
    for _ in range(30):
        A, b = whole(*cut_box(m, 5, generator))
        center, frame = cut_ellipsoid(A, b, np.zeros(m), np.eye(m))
        reach = np.linalg.norm(A @ frame, axis=1)
        assert np.all(A @ center + reach <= b + 2e-3 * reach)
        largest = HPolyhedron(A, b).MaximumVolumeInscribedEllipsoid()
        excess = np.linalg.slogdet(frame)[1] + np.linalg.slogdet(largest.A())[1]
        assert excess < 1e-2


@pytest.mark.parametrize("m", [2, 3])
def test_estimates_are_the_weights_where_the_ellipsoid_is_largest(m):
    generator = np.random.default_rng(20 + m)
    for _ in range(20):
        A, b = whole(*cut_box(m, 3, generator))
        largest = HPolyhedron(A, b).MaximumVolumeInscribedEllipsoid()
        normals = A @ np.linalg.inv(largest.A())
        length = np.linalg.norm(normals, axis=1)
        n, e = normals / length[:, None], (b - A @ largest.center()) / length - 1.0
        w = estimated_weights(n, e)
        assert np.all(w >= 0.0)
        np.testing.assert_allclose((n.T * w) @ n, np.eye(m), atol=1e-3)
        np.testing.assert_allclose(w @ n, 0.0, atol=1e-3)


def test_rows_that_face_each_other_are_left_to_the_solver():
    rows, bounds = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-0.8, 0.9])
    assert cut_ellipsoid(rows, bounds, np.zeros(2), np.eye(2)) is None
    solver = InscribedEllipsoidSolver(InputSet.box([-1.0, -1.0], [1.0, 1.0]))
    tilted = np.array([[1.0, 0.5], [-1.0, -0.5]])
    for gap in (1e-1, 1e-3, 1e-5):
        found = solver.solve(tilted, np.array([0.3, gap - 0.3]))
        # Of the parallelogram they leave, pi / 4 of the area.
        assert np.exp(found.log_det) == pytest.approx(2.0 * gap / 4.0, rel=1e-7)


def sets(m):
    generator = np.random.default_rng(30 + m)
    yield InputSet.box(-np.ones(m), np.ones(m))
    cut_off = np.vstack([np.eye(m), -np.eye(m), np.ones((1, m))])
    yield InputSet(cut_off, np.append(np.ones(2 * m), generator.uniform(0.5, 1.0)))


@pytest.mark.parametrize("m", [2, 3, 4])
def test_few_sets_need_the_cone_program(monkeypatch, m):
    by_cone_program, asked = ellipsoid_solver._by_cone_program, []

    def counted(A, b):
        asked.append(len(b))
        return by_cone_program(A, b)

    monkeypatch.setattr(ellipsoid_solver, "_by_cone_program", counted)
    generator, count = np.random.default_rng(40 + m), 0
    for input_set in sets(m):
        solver = InscribedEllipsoidSolver(input_set)
        for _ in range(30):
            A, b = cut_box(m, int(generator.integers(1, 5)), generator)
            found = solver.solve(A, b)
            rows = np.vstack([input_set.A_normalised, A])
            bounds = np.append(input_set.b_normalised, b)
            largest = HPolyhedron(rows, bounds).MaximumVolumeInscribedEllipsoid()
            log_det = -np.linalg.slogdet(largest.A())[1]
            assert found.log_det == pytest.approx(log_det, abs=1e-4)
            assert found.log_det > log_det - 1e-6
            assert found.certified_gap < 1e-8
            count += 1
    assert len(asked) <= 0.15 * count


def test_without_newtons_method_the_cone_program_answers(monkeypatch):
    solver = InscribedEllipsoidSolver(InputSet.box(-np.ones(3), np.ones(3)))
    A, b = cut_box(3, 3, np.random.default_rng(5))
    found = solver.solve(A, b)
    monkeypatch.setattr(ellipsoid_solver, "_cut_down", lambda *_: None)
    other = solver.solve(A, b)
    assert found.log_det == pytest.approx(other.log_det, abs=2e-9)
    np.testing.assert_allclose(found.shape, other.shape, atol=1e-7)
    np.testing.assert_allclose(found.multipliers, other.multipliers, atol=1e-6)
