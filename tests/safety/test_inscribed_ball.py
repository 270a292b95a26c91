"""The signed inradius against scipy's linear programs and against differences."""

import numpy as np
import pytest
from scipy.optimize import linprog

from vcbf_drake.errors import UnboundedSetError
from vcbf_drake.safety import inscribed_ball as inscribed_ball_module
from vcbf_drake.safety.inscribed_ball import inscribed_ball


def random_rows(rng, m):
    A = np.vstack([np.eye(m), -np.eye(m), rng.normal(size=(5, m))])
    return A, np.concatenate([np.ones(2 * m), rng.uniform(-1.5, 1.0, 5)])


def linprog_radius(A, b):
    columns = np.column_stack([A, np.linalg.norm(A, axis=1)])
    cost = np.append(np.zeros(A.shape[1]), -1.0)
    return -linprog(cost, A_ub=columns, b_ub=b, bounds=(None, None)).fun


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_radius_agrees_with_scipy_of_empty_sets_too(m):
    rng, radii = np.random.default_rng(m), []
    for _ in range(60):
        A, b = random_rows(rng, m)
        radii.append(inscribed_ball(A, b).radius)
        assert radii[-1] == pytest.approx(linprog_radius(A, b), abs=1e-8)
    assert min(radii) < -0.1 < 0.1 < max(radii)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_derivative_agrees_with_central_differences(m):
    rng, step = np.random.default_rng(30 + m), 1e-6
    for _ in range(40):
        A, b = random_rows(rng, m)
        dA, db = rng.normal(size=A.shape), rng.normal(size=len(b))
        ahead, behind = (linprog_radius(A + h * dA, b + h * db) for h in (step, -step))
        ball = inscribed_ball(A, b)
        exact = ball.multipliers @ (db - np.einsum("ij,ij->i", dA, ball.contacts))
        assert exact == pytest.approx(
            (ahead - behind) / (2.0 * step), rel=1e-6, abs=1e-5
        )


def test_row_of_zeros_that_excludes_everything():
    A = np.vstack([np.eye(2), -np.eye(2), np.zeros((1, 2))])
    ball = inscribed_ball(A, np.array([1.0, 1.0, 1.0, 1.0, -0.1]))
    assert ball.radius == -np.inf
    assert not ball.multipliers.any()
    harmless = inscribed_ball(A, np.array([1.0, 1.0, 1.0, 1.0, 0.1]))
    assert harmless.radius == pytest.approx(1.0)
    assert harmless.multipliers[-1] == 0.0


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e6, 1e12])
def test_the_incircle_of_a_triangle_of_any_size(size):
    """Legs 3 and 4: radius 1 at (1, 1). Below unit size it is exact to 1e-9."""
    A = np.array([[-1.0, 0.0], [0.0, -2.0], [40.0, 30.0]])
    ball = inscribed_ball(A, size * np.array([0.0, 0.0, 120.0]))
    assert ball.radius == pytest.approx(size, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(
        ball.contacts,
        size * np.array([[0.0, 1.0], [1.0, 0.0], [1.8, 1.6]]),
        rtol=1e-9,
        atol=1e-9 * max(1.0, size),
    )
    # The legs' and hypotenuse's lengths over the perimeter 12, and over |a_i|.
    np.testing.assert_allclose(
        ball.multipliers, np.array([4.0, 3.0, 5.0]) / 12.0 / [1.0, 2.0, 50.0], rtol=1e-9
    )


def test_rows_far_away_do_not_blur_the_ball():
    A = np.vstack([np.eye(2), -np.eye(2), [[0.6, 0.8], [0.8, -0.6]]])
    ball = inscribed_ball(A, np.array([1.0, 1.0, 1.0, 1.0, 1e14, 1e9]))
    assert ball.radius == pytest.approx(1.0, abs=1e-12)


def test_balls_of_every_size_are_refused():
    with pytest.raises(UnboundedSetError):
        inscribed_ball(np.array([[1.0, 0.0], [0.0, 1.0]]), np.ones(2))


def test_ordinary_sets_need_the_fast_program_alone(monkeypatch):
    monkeypatch.setattr(inscribed_ball_module, "largest_ball", None)
    rng = np.random.default_rng(6)
    for m in (1, 2, 3):
        for _ in range(20):
            A, b = random_rows(rng, m)
            assert inscribed_ball(A, b).radius == pytest.approx(
                linprog_radius(A, b), abs=1e-8
            )


def test_without_the_fast_program_the_answer_is_the_same(monkeypatch):
    rng = np.random.default_rng(5)
    sets = [random_rows(rng, 3) for _ in range(20)]
    fast = [inscribed_ball(A, b) for A, b in sets]
    monkeypatch.setattr(inscribed_ball_module._Program, "ball", lambda self, rows: None)
    for (A, b), ball in zip(sets, fast, strict=True):
        careful = inscribed_ball(A, b)
        assert careful.radius == pytest.approx(ball.radius, abs=1e-9)
        np.testing.assert_allclose(careful.multipliers, ball.multipliers, atol=1e-8)
