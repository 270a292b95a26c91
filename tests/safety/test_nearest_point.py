import numpy as np
import pytest
import quadprog
from scipy.optimize import linprog

from tests.helpers.fake_solver import solver_that_answers
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.polytope import minimise_linear
from vcbf_drake.safety.programs import check_solver
from vcbf_drake.safety.projection import (
    Projection,
    UnitRows,
    is_optimal,
    nearest_by_active_set,
    nearest_point,
)


def random_problem(rng, kind):
    """A box, random rows, and one of the things that make QPs hard."""
    m, n = rng.integers(1, 5), rng.integers(2, 15)
    rows, bounds = rng.normal(size=(n, m)), rng.uniform(-0.2, 1.0, n)
    if kind == "repeated rows":
        rows[1], bounds[1] = 3.0 * rows[0], 3.0 * bounds[0]
    elif kind == "badly scaled rows":
        scale = 10.0 ** rng.uniform(-4.0, 4.0, n)
        rows, bounds = rows * scale[:, None], bounds * scale
    elif kind == "many rows through one vertex":
        bounds = rows @ rng.uniform(-0.5, 0.5, m)
    A = np.vstack([np.eye(m), -np.eye(m), rows])
    b = np.concatenate([np.ones(2 * m), bounds])
    return A, b, rng.normal(size=m) * 10.0 ** rng.uniform(-1.0, 1.5)


def quadprog_answer(A, b, reference):
    length = np.linalg.norm(A, axis=1)
    try:
        return quadprog.solve_qp(
            np.eye(len(reference)), reference, -A.T / length, -b / length
        )[0]
    except ValueError:
        return None


@pytest.mark.parametrize(
    "kind",
    [
        "plain",
        "repeated rows",
        "badly scaled rows",
        "many rows through one vertex",
    ],
)
def test_agrees_with_quadprog(kind):
    rng = np.random.default_rng([7, len(kind)])
    solved = 0
    for _ in range(400):
        A, b, reference = random_problem(rng, kind)
        expected = quadprog_answer(A, b, reference)
        try:
            point = nearest_point(A, b, reference)
        except EmptySetError:
            assert expected is None
            continue
        slack = (b - A @ point) / np.linalg.norm(A, axis=1)
        assert slack.min() >= -1e-9
        if expected is not None:
            solved += 1
            np.testing.assert_allclose(point, expected, atol=1e-8)
    assert solved > 100


def test_solves_the_instances_on_which_an_interior_point_method_cycles():
    """Trivially feasible; Clarabel with default settings runs into its limit."""
    rows = np.array(
        [
            [-0.0245, 0.0438, 0.0],
            [-0.7989, -0.5991, 0.0],
            [-0.9184, -0.3769, 0.0],
            [-0.9501, -0.2679, 0.0],
            [-0.8115, -0.5842, 0.0],
            [-0.9582, -0.2785, 0.0],
        ]
    )
    bounds = np.array([9.0013, 4.8413, 22.3975, 38.1006, 29.3474, 21.6401])
    box = np.array([1.5, 1.5, 1.0])
    for far in (1.0, 20.0):  # Inside the set, and far outside of it.
        rng = np.random.default_rng(0)
        for _ in range(300):
            perturbed = rows * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, rows.shape))
            A = np.vstack([np.eye(3), -np.eye(3), perturbed])
            b = np.concatenate([box, box, bounds])
            reference = far * rng.uniform(-0.3, 0.3, 3)
            expected = quadprog_answer(A, b, reference)
            point = nearest_point(A, b, reference)
            np.testing.assert_allclose(point, expected, atol=1e-9)


def test_reference_inside_passes_through_untouched():
    A, b = np.vstack([np.eye(2), -np.eye(2)]), np.ones(4)
    for reference in (np.array([0.1, -0.3]), np.array([1.0, -0.3])):
        np.testing.assert_array_equal(nearest_point(A, b, reference), reference)


def test_multipliers_satisfy_the_optimality_conditions_in_the_units_given():
    A = np.array([[2.0, 0.0], [0.0, 5.0], [-1.0, 0.0], [0.0, -1.0]])
    b = np.array([2.0, 5.0, 1.0, 1.0])
    solution = nearest_by_active_set(A, b, np.array([3.0, 2.0]))
    np.testing.assert_allclose(solution.point, [1.0, 1.0])
    np.testing.assert_allclose(
        np.array([3.0, 2.0]) - solution.multipliers @ A, solution.point
    )
    np.testing.assert_allclose(solution.multipliers, [1.0, 0.2, 0.0, 0.0])


def test_an_empty_set_is_certified():
    A = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    with pytest.raises(EmptySetError) as caught:
        nearest_point(A, np.array([-1.0, 0.5, 1.0, 1.0]), np.zeros(2))
    assert caught.value.inradius == pytest.approx(-0.25)


def test_a_row_without_coefficients_is_empty_only_when_its_bound_is_negative():
    A = np.array([[1.0], [-1.0], [0.0]])
    far = np.array([5.0])
    assert nearest_point(A, np.array([1.0, 1.0, 0.0]), far) == pytest.approx(1.0)
    with pytest.raises(EmptySetError) as caught:
        nearest_point(A, np.array([1.0, 1.0, -1e-3]), far)
    assert caught.value.inradius == -np.inf
    # One such row is enough, whatever the others of its kind say.
    A = np.vstack([A, [0.0]])
    for bounds in ([1.0, 1.0, -1e-3, 5.0], [1.0, 1.0, 5.0, -1e-3]):
        with pytest.raises(EmptySetError):
            nearest_point(A, np.array(bounds), far)


SOLVERS = ("Clarabel", "Clp", "NLopt", "OSQP", "SNOPT")


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("kind", ["plain", "badly scaled rows"])
def test_every_solver_leads_to_the_same_point(kind, solver):
    check_solver(solver)
    rng = np.random.default_rng([9, len(kind)])
    solved = 0
    for _ in range(60):
        A, b, reference = random_problem(rng, kind)
        expected = quadprog_answer(A, b, reference)
        if expected is None:
            continue
        solved += 1
        found = nearest_point(A, b, reference, solver=solver)
        np.testing.assert_allclose(found, expected, atol=1e-8)
    assert solved > 20


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Clarabell", "solver: 'Clarabell'; it must be one of Clarabel, Clp"),
        ("Gurobi", "for Gurobi is not in this build of Drake"),
        ("Mosek", "for Mosek has no license here"),
    ],
)
def test_a_solver_that_cannot_be_asked_is_refused_in_one_line(name, message):
    with pytest.raises(ValueError, match=message) as raised:
        check_solver(name)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("proposal", [None, [0.0, 0.3], [np.nan, np.nan], [9.0, 9.0]])
def test_a_wrong_proposal_is_not_believed(proposal):
    """A solver that gives up, cycles or lies costs time, and nothing else."""
    A, b = np.eye(2), np.array([0.5, 0.3])
    with solver_that_answers(proposal and np.array(proposal)) as solver:
        found = nearest_point(A, b, np.array([1.0, 0.0]), solver=solver)
        np.testing.assert_allclose(found, [0.5, 0.0], atol=1e-15)
        A, sides = np.vstack([A, -A]), np.array([0.5, 0.3, -1.0, 1.0])
        with pytest.raises(EmptySetError):
            nearest_point(A, sides, b, solver=solver)


@pytest.mark.parametrize(
    ("point", "is_accepted"),
    [
        ((1.0, 0.0), True),
        ((1.0 + 0.5e-10, 0.0), True),
        ((1.0 + 1.5e-10, 0.0), False),  # Outside.
        ((1.0 - 1e-7, 0.0), False),  # Further away than it need be.
        ((1.0, 1e-2), False),  # Off to the side.
    ],
)
def test_a_point_is_judged_by_how_much_nearer_another_may_be(point, is_accepted):
    A, b, reference = np.array([[1.0, 0.0]]), np.ones(1), np.array([2.0, 0.0])
    rows, proposed = UnitRows(A, b), Projection(np.array(point), np.ones(1))
    assert is_optimal(proposed, rows, reference) == is_accepted


BOX = np.vstack([np.eye(2), -np.eye(2)])


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


@pytest.mark.parametrize("angle", [1e-3, 1e-5])
def test_a_narrow_corner_is_found_to_its_tip(angle):
    """Two rows that meet at a narrow angle, far from where anything else is."""
    rows = np.array([[angle, 1.0], [angle, -1.0], [-1.0, 0.0]])
    point = minimise_linear(
        np.array([-1.0, 0.0]), rows, np.array([2e3 * angle] * 2 + [1.0])
    )
    np.testing.assert_allclose(point, [2e3, 0.0], rtol=1e-6, atol=1e-6)


def test_answers_do_not_depend_on_the_program_before():
    first = minimise_linear(np.array([1.0, -1.0]), BOX, np.ones(4))
    np.testing.assert_allclose(first, [-1.0, 1.0])
    other = minimise_linear(np.array([0.0, 2.0]), 2.0 * BOX, np.arange(1.0, 5.0))
    assert other[1] == pytest.approx(-2.0)
    again = minimise_linear(np.array([1.0, -1.0]), BOX, np.ones(4))
    np.testing.assert_array_equal(again, first)


@pytest.mark.parametrize(
    ("rows", "bounds", "error"),
    [
        (BOX, np.array([-1.0, 1.0, 0.5, 1.0]), EmptySetError),  # 0.5 apart.
        (np.eye(2), np.ones(2), SolverError),  # Without a least.
    ],
)
def test_no_minimiser_is_said_with_the_rows(rows, bounds, error):
    with pytest.raises(error) as raised:
        minimise_linear(np.array([1.0, 1.0]), rows, bounds)
    np.testing.assert_array_equal(raised.value.A, rows)
    np.testing.assert_array_equal(raised.value.b, bounds)


def test_the_multipliers_of_far_slacks_prove_nothing():
    """A slab of next to no width, and a row that gives way at next to no price.

    z = (1/2, 1/2, 1e-9) all but balances the rows, and yet they have a point: the last
    variable may be as large as it has to.
    """
    A = np.array([[1.0, 0.0, 0.0], [-1.0, 2e-9, 0.0], [0.0, -1.0, 1e-4]])
    b = np.array([0.0, -3e-9, 0.5])
    point = nearest_point(A, b, np.zeros(3))
    assert (A @ point <= b + 1e-9).all()


def test_short_rows_have_a_direction_too():
    """Of limits of 1e-12, a row u <= 3e-13 is one: no unit makes it a blank."""
    A = 1e-12 * np.array([[1.0, 0.0], [0.0, -1.0]])
    point = nearest_point(A, 1e-12 * np.array([0.3, 0.2]), np.ones(2))
    np.testing.assert_allclose(point, [0.3, 1.0], atol=1e-15)


@pytest.mark.parametrize("short", [1e-13, 1e-160, 2e-311, 5e-324])
def test_rows_of_any_length_are_rows(short):
    """v_1 + v_2 <= -1, as short as floats can be; nothing overflows on the way."""
    A = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [short, short]])
    b = np.array([1.0, 1.0, 1.0, 1.0, -short])
    point = nearest_point(A, b, np.array([0.7, 0.9]))
    np.testing.assert_allclose(point, [-0.6, -0.4], atol=1e-12)


@pytest.mark.parametrize("tilt", [1e-6, 1e-9, 1e-12])
def test_the_least_on_a_wedge_is_its_tip(tilt):
    """Rows opposite but for an angle: its multipliers are as large as 1 / tilt."""
    A = np.array([[tilt, 1.0], [tilt, -1.0], [-1.0, 0.0], [1.0, 0.0]])
    b = np.array([0.5 * tilt, 0.5 * tilt, 1.0, 1.0])
    point = minimise_linear(np.array([-1.0, 0.0]), A, b)
    np.testing.assert_allclose(point, [0.5, 0.0], atol=1e-15 / tilt + 1e-12)
    assert (A @ point <= b + 1e-10).all()
