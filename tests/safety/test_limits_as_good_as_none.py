"""Limits that are next to infinite, infinite, or leave an input no room at all."""

import numpy as np
from pydrake.symbolic import Expression, MakeVectorVariable
import pytest
from scipy.optimize import linprog

from tests.helpers.fixed_set import fixed_set
from vcbf_drake import Car, ControlAffineModel, SafetyFilter, SphereObstacle
from vcbf_drake.barriers import StateLimit
from vcbf_drake.safety import FilterSettings, FilterStatus, InputSet
from vcbf_drake.safety.decision import choose_input

FAR = [1e6, 1e8, 1e9, 1e10, 1e12, 1e300, 1.7e308, np.inf]


def choose(input_set, A, b, reference, policy="least_violation"):
    feasible, held = fixed_set(input_set, A, b), np.zeros(len(reference))
    reference = np.array(reference, dtype=float)
    return choose_input(feasible, None, reference, held, policy)


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("reference", [0.0, 1.5, 5.0, -7e3])
def test_rows_a_unit_apart_exclude_each_other(far, reference):
    """U <= 1 and u >= 2: least violated halfway."""
    box = InputSet.box([-far], [far])
    decision = choose(box, [[1.0], [-1.0]], [1.0, -2.0], [reference])
    assert decision.status == FilterStatus.INFEASIBLE
    assert decision.conflict == (2, 3)
    np.testing.assert_allclose(decision.input, [1.5], atol=1e-8)


@pytest.mark.parametrize("far", [1e13, 1e14, 3e14, 1e15])
@pytest.mark.parametrize("gap", [1.0, 0.01, 1e-4])
def test_what_excludes_every_input_is_decided_without_rounding(far, gap):
    """U <= 1 and u >= 1 + gap: in half-widths they are less apart than a rounding."""
    box = InputSet.box([-far], [far])
    decision = choose(box, [[1.0], [-1.0]], [1.0, -1.0 - gap], [0.0])
    assert decision.status == FilterStatus.INFEASIBLE
    assert decision.conflict == (2, 3)
    np.testing.assert_allclose(decision.input, [1.0 + 0.5 * gap], atol=1e-8)


@pytest.mark.parametrize("far", [*FAR, 3e14, 1e15])
@pytest.mark.parametrize("least", [0.0, -1.0])
def test_rows_that_exclude_each_other_are_named_whatever_the_limits(far, least):
    """U <= 1 and u >= 2, in inputs from least * far to far."""
    box = InputSet.box([least * far if least else 0.0], [far])
    x = MakeVectorVariable(1, "x")
    one = np.array([[Expression(1.0)]])
    model = ControlAffineModel(x, 0.0 * one[0], one, np.zeros((1, 0)))
    barriers = StateLimit(0, -1.0, 1.0).barriers()
    filtered = SafetyFilter(model, barriers, box, FilterSettings(method="cbf-qp"))
    A = np.vstack([box.A, [[1.0], [-1.0]]])
    names = ("state limit (low)", "state limit (high)")
    assert filtered.names_in_conflict(A, np.append(box.b, [1.0, -2.0])) == names
    assert filtered.names_in_conflict(A, np.append(box.b, [2.0, -1.0])) == ()


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("reference", [1.5, 0.0, 9.0])
def test_rows_a_unit_apart_leave_what_is_between_them(far, reference):
    box = InputSet.box([-far], [far])
    decision = choose(box, [[1.0], [-1.0]], [2.0, -1.0], [reference])
    np.testing.assert_allclose(decision.input, [np.clip(reference, 1, 2)], atol=1e-8)


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("other", [1.0, 1e10])
def test_an_oblique_row_is_met_to_its_own_size(far, other):
    """2 u_1 + u_2 >= 2, and u_2 <= 0.1: by hand, in the norm of the half-widths."""
    box = InputSet.box([-far, -other], [far, other])
    A, b = [[-2.0, -1.0], [0.0, 1.0]], [-2.0, 0.1]
    decision = choose(box, A, b, [0.0, 0.0])
    assert decision.status == FilterStatus.FILTERED
    a = np.array([2.0, 1.0]) * box.scale
    v = a * 2.0 / (a @ a)
    expected = box.scale * v
    if expected[1] > 0.1:
        expected = [0.95, 0.1]
    np.testing.assert_allclose(decision.input, expected, atol=2e-8)


@pytest.mark.parametrize("far", FAR)
def test_a_limit_that_matters_beside_one_that_does_not(far):
    """u_1 <= 5, u_1 >= 6 beside u_2 <= 0.5, which holds to a unit of its own."""
    box, A = InputSet.box([-far, -1.0], [far, 1.0]), [[1.0, 0.0], [-1.0, 0.0], [0, 1.0]]
    decision = choose(box, A, [5.0, -6.0, 0.5], [7.0, 0.4])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (4, 5)
    np.testing.assert_allclose(decision.input, [5.5, 0.4], atol=1e-6)
    decision = choose(box, A, [5.0, -4.0, 0.5], [7.0, 0.9])
    assert decision.status == FilterStatus.FILTERED
    np.testing.assert_allclose(decision.input, [5.0, 0.5], atol=1e-9)


@pytest.mark.parametrize("far", [1e3, 1e6, 1e9, 1e12])
def test_the_least_violation_beside_limits_that_matter(far):
    """Against a linear program in the inputs' own units, where 1e4 is far enough."""
    rng, empty = np.random.default_rng(int(np.log10(far))), 0
    box, near = InputSet.box([-far, -1.0], [far, 1.0]), [(-1e4, 1e4), (-1.0, 1.0)]
    for _ in range(60):
        n = int(rng.integers(2, 6))
        A, b = rng.normal(size=(n, 2)), rng.normal(size=n) - 1.0
        if far == 1e3:
            near[0] = (-1e3, 1e3)
        lp = np.column_stack([A, -np.ones(n)])
        least = linprog([0, 0, 1.0], lp, b, bounds=[*near, (0.0, None)]).fun
        if least < 1e-3:
            continue
        empty += 1
        decision = choose(box, A, b, rng.normal(size=2))
        assert decision.status == FilterStatus.INFEASIBLE
        violation = np.max(A @ decision.input - b)
        assert violation == pytest.approx(least, rel=1e-6, abs=1e-6)
    assert empty > 10


@pytest.mark.parametrize("small", [1e-6, 1e-12, 1e-15])
def test_limits_of_next_to_nothing_are_limits(small):
    """A row with a coefficient of 1 is short beside them, and yet it is a row."""
    box = InputSet.box([-small, -small], [small, small])
    decision = choose(box, [[1.0, 0.0]], [0.3 * small], [small, 0.1 * small])
    assert decision.status == FilterStatus.FILTERED
    expected = [0.3 * small, 0.1 * small]
    np.testing.assert_allclose(decision.input, expected, atol=1e-9 * small)
    decision = choose(box, [[1.0, 0.0]], [-2.0 * small], [small, 0.1 * small])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (2, 4)
    np.testing.assert_allclose(decision.input, [-small, 0.1 * small], rtol=1e-8)


@pytest.mark.parametrize("size", [1e100, 1e300])
def test_rows_whose_squares_overflow_are_violated_least(size):
    box, A = InputSet.box([-1.0, -1.0], [1.0, 1.0]), [[size, 0.0], [-size, 0.0]]
    decision = choose(box, A, [0.3 * size, -0.5 * size], [0.7, 0.9])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (4, 5)
    np.testing.assert_allclose(decision.input, [0.4, 0.9], atol=1e-8)


@pytest.mark.parametrize("far", [1e9, 1e12, 1e300, np.inf])
def test_limits_on_one_side_alone(far):
    box = InputSet.box([0.0, -1.0], [far, 1.0])
    decision = choose(box, [[1.0, 0.0]], [3.0], [7.0, -5.0])
    np.testing.assert_allclose(decision.input, [3.0, -1.0], atol=1e-6)
    decision = choose(box, [[1.0, 0.0]], [-3.0], [7.0, 0.5])
    assert decision.status == FilterStatus.INFEASIBLE
    assert decision.conflict == (2, 4)
    np.testing.assert_allclose(decision.input, [0.0, 0.5], atol=1e-6)


def test_without_limits_a_reference_far_away_is_met():
    box = InputSet.box([-np.inf, -np.inf], [np.inf, np.inf])
    decision = choose(box, [[1.0, 0.0]], [1.0], [1e7, -3e5])
    assert decision.status == FilterStatus.FILTERED
    np.testing.assert_allclose(decision.input, [1.0, -3e5], rtol=1e-9)
    decision = choose(box, [[1.0, 0.0]], [1e8], [1e7, -3e5])
    assert decision.status == FilterStatus.REFERENCE


def test_a_limit_whose_square_overflows_is_none():
    box = InputSet.box([-1e300, -2.0], [3.0, 1e101])
    assert not box.is_bounded
    np.testing.assert_array_equal(box.b, [3.0, np.inf, np.inf, 2.0])


def test_a_dead_actuator_stays_where_it_is():
    """As a box and as rows; the other inputs do what it leaves to do."""
    box = InputSet.box([-1.0, 0.3, -2.0], [1.0, 0.3, 2.0])
    rows = InputSet(np.vstack([box.A, [[1.0, 0.0, 1.0]]]), [*box.b, 1.5])
    for input_set in (box, rows):
        np.testing.assert_array_equal(input_set.scale, [1.0, 0.0, 2.0])
        assert input_set.center[1] == 0.3
        decision = choose(input_set, [[1.0, 1.0, 0.0]], [0.5], [0.9, 0.7, 0.1])
        assert decision.status == FilterStatus.FILTERED
        np.testing.assert_allclose(decision.input, [0.2, 0.3, 0.1], atol=1e-9)
        # A reference that asks of it what it does not do does not pass ...
        decision = choose(input_set, [[1.0, 1.0, 0.0]], [0.5], [0.1, 0.7, 0.1])
        assert decision.status == FilterStatus.FILTERED
        np.testing.assert_allclose(decision.input, [0.1, 0.3, 0.1], atol=1e-12)
        # ... and one that does not, does.
        decision = choose(input_set, [[1.0, 1.0, 0.0]], [0.5], [0.1, 0.3, 0.1])
        assert decision.status == FilterStatus.REFERENCE
        decision = choose(input_set, [[0.0, 1.0, 0.0]], [0.1], [0.1, 0.3, 0.1])
        assert decision.status == FilterStatus.INFEASIBLE
        assert input_set.contains([0.1, 0.3, 0.1])
        assert not input_set.contains([0.1, 0.31, 0.1])
        np.testing.assert_array_equal(
            input_set.project([0.1, 5.0, 0.1]), [0.1, 0.3, 0.1]
        )


def test_all_actuators_dead():
    for input_set in (
        InputSet.box([0.5, -1.0], [0.5, -1.0]),
        InputSet(np.vstack([np.eye(2), -np.eye(2)]), [0.5, -1.0, -0.5, 1.0]),
    ):
        decision = choose(input_set, [[1.0, 1.0]], [1.0], [3.0, 3.0])
        np.testing.assert_allclose(decision.input, [0.5, -1.0])
        decision = choose(input_set, [[1.0, 1.0]], [-1.0], [3.0, 3.0])
        assert decision.status == FilterStatus.INFEASIBLE
        np.testing.assert_allclose(decision.input, [0.5, -1.0])


def test_the_volume_barrier_alone_needs_limits():
    model = ControlAffineModel.from_system(Car())
    barriers = [SphereObstacle([3.0, 0.1], 0.5).barrier([4.0, 3.0])]
    inputs = InputSet.box([-np.inf, -0.5], [np.inf, 0.5])
    with pytest.raises(ValueError, match=r"an infinite limit.*finite for the volume"):
        SafetyFilter(model, barriers, inputs, FilterSettings(method="dob-vcbf-qp"))
    settings = FilterSettings(method="cbf-qp")
    safety_filter = SafetyFilter(model, barriers, inputs, settings)
    context = safety_filter.CreateDefaultContext()
    safety_filter.GetInputPort("state").FixValue(context, [2.0, 0.0, 0.0, 1.0])
    safety_filter.GetInputPort("reference").FixValue(context, [5.0, 0.0])
    decision = safety_filter.decision(context)
    assert decision.status == FilterStatus.FILTERED
    feasible = safety_filter.feasible_set(context)
    assert (feasible.A @ decision.input <= feasible.b + 1e-9).all()
    assert np.isnan(safety_filter.GetOutputPort("volume").Eval(context)[0])
    assert safety_filter.GetOutputPort("feasible_set").Eval(context).shape == (21,)
    assert "upper limit of input 1" in safety_filter.programs(context).qp_rows
