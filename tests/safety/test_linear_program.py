"""Small linear programs against scipy's."""

import numpy as np
import pytest
from scipy.optimize import linprog

from vcbf_drake.errors import SolverError
from vcbf_drake.safety import linear_program
from vcbf_drake.safety.linear_program import minimise_linear

BOX = np.vstack([np.eye(2), -np.eye(2)])


@pytest.fixture(params=["nearest points", "program"])
def way(request, monkeypatch):
    """Each of the two ways, the second without the first."""
    if request.param == "program":
        monkeypatch.setattr(linear_program, "_by_nearest_points", lambda *_: None)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_the_minimum_agrees_with_scipy(scale):
    rng = np.random.default_rng(1)
    for _ in range(40):
        m = int(rng.integers(1, 5))
        A = np.vstack([np.eye(m), -np.eye(m), rng.normal(size=(5, m))])
        b = scale * rng.uniform(0.1, 1.0, len(A))
        cost = rng.normal(size=m)
        point = minimise_linear(cost, A, b)
        assert (A @ point <= b + 1e-7 * (1.0 + scale)).all()
        least = linprog(cost, A_ub=A, b_ub=b, bounds=(None, None)).fun
        assert cost @ point == pytest.approx(least, abs=1e-6 * scale)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("angle", [1e-3, 1e-5])
def test_a_narrow_corner_is_found_to_its_tip(angle):
    """Two rows that meet at a narrow angle, far from where anything else is."""
    rows = np.array([[angle, 1.0], [angle, -1.0], [-1.0, 0.0]])
    point = minimise_linear(
        np.array([-1.0, 0.0]), rows, np.array([2e3 * angle] * 2 + [1.0])
    )
    np.testing.assert_allclose(point, [2e3, 0.0], rtol=1e-6, atol=1e-6)


@pytest.mark.usefixtures("way")
def test_answers_do_not_depend_on_the_program_before():
    first = minimise_linear(np.array([1.0, -1.0]), BOX, np.ones(4))
    np.testing.assert_allclose(first, [-1.0, 1.0])
    other = minimise_linear(np.array([0.0, 2.0]), 2.0 * BOX, np.arange(1.0, 5.0))
    assert other[1] == pytest.approx(-2.0)
    again = minimise_linear(np.array([1.0, -1.0]), BOX, np.ones(4))
    np.testing.assert_array_equal(again, first)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(
    ("rows", "bounds"),
    [
        (BOX, np.array([-1.0, 1.0, 0.5, 1.0])),  # Empty: 0.5 apart.
        (np.array([[1.0, 0.0], [0.0, 1.0]]), np.ones(2)),  # Without a least.
    ],
)
def test_no_minimiser_is_said_with_the_rows(rows, bounds):
    with pytest.raises(SolverError, match="no verified solution") as raised:
        minimise_linear(np.array([1.0, 1.0]), rows, bounds)
    np.testing.assert_array_equal(raised.value.A, rows)
    np.testing.assert_array_equal(raised.value.b, bounds)
