from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from tests.helpers.fixed_set import fixed_set, normalised
from vcbf_drake.barriers import BarrierRows
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety import (
    DisturbanceKnowledge,
    FilterStatus,
    InputSet,
    chebyshev_ball,
    decision as decision_module,
)
from vcbf_drake.safety.decision import choose_input, least_violation
from vcbf_drake.safety.projection import nearest_point
from vcbf_drake.safety.qp import Frame, RowCosts, VolumeRow, feasible_set

BOX = InputSet.box([-1.0, -2.0], [3.0, 2.0])
ORIGIN = np.zeros(2)


def set_of(A, b, input_set=BOX, weights=None):
    """The feasible set of plain rows A u <= b, without any disturbance."""
    A, b = np.atleast_2d(np.array(A, dtype=float)), np.atleast_1d(b).astype(float)
    n, m = A.shape
    rows = BarrierRows(
        value=np.ones(n),
        chain=tuple(np.ones(2) for _ in range(n)),
        A=A,
        b=b,
        w=np.zeros((n, 1)),
        num_states=2,
        gradients=lambda rows: np.zeros((len(rows), m + 2, 3)),
    )
    costs = RowCosts.equal(n)
    if weights is not None:
        costs = replace(costs, weights=weights)
    return feasible_set(input_set, rows, DisturbanceKnowledge.constant(1, 0.0), costs)


def choose(feasible, reference, volume_row=None, **options):
    settings = {"exact_slack": True, "policy": "stop", "held_input": ORIGIN}
    settings |= options
    if volume_row is not None and settings["exact_slack"]:
        volume_row = volume_row._replace(slack_penalty=np.inf)
    return choose_input(
        feasible,
        volume_row,
        np.array(reference, dtype=float),
        settings["held_input"],
        settings["policy"],
    )


def test_reference_passes_through_bit_for_bit():
    reference = np.array([0.1, 0.2]) / 3.0
    decision = choose(set_of([1.0, 1.0], 1.0), reference)
    assert decision.status == FilterStatus.REFERENCE
    assert np.array_equal(decision.input, reference)


def test_no_input_leaves_a_box_by_an_ulp():
    """In normalised inputs the next number above a limit may be the limit itself."""
    rng = np.random.default_rng(3)
    statuses = []
    for _ in range(200):
        lower, upper = -rng.uniform(0.01, 0.5, 3), rng.uniform(0.01, 0.5, 3)
        box = InputSet.box(lower, upper)
        for limits, outward in ((upper, np.inf), (lower, -np.inf)):
            reference = np.nextafter(limits, outward)
            rows = set_of(np.zeros((0, 3)), np.zeros(0), box)
            decision = choose(rows, reference, held_input=np.zeros(3))
            assert (lower <= decision.input).all() and (decision.input <= upper).all()
            statuses.append(decision.status)
    assert set(statuses) == {FilterStatus.FILTERED}


def test_filtered_input_is_the_nearest_point_the_normalised_norm():
    # Half-widths are 2 and 2, so the norm is Euclid's and the answer a projection.
    decision = choose(set_of([1.0, 1.0], 1.0), [2.0, 1.0])
    assert decision.status == FilterStatus.FILTERED
    np.testing.assert_allclose(decision.input, [1.0, 0.0], atol=1e-9)
    assert decision.slack == 0.0


@pytest.mark.parametrize("exact_slack", [True, False])
def test_a_volume_row_that_holds_anyway_has_no_slack(exact_slack):
    row = VolumeRow(a=np.array([0.0, 1.0]), c=1.0, slack_penalty=1e3)
    decision = choose(set_of([1.0, 1.0], 1.0), [2.0, 1.0], row, exact_slack=exact_slack)
    assert decision.status == FilterStatus.FILTERED and decision.slack == 0.0
    np.testing.assert_allclose(decision.input, [1.0, 0.0], atol=1e-9)


def test_volume_row_is_kept_exactly_when_it_can_be():
    row = VolumeRow(a=np.array([1.0, 0.0]), c=-0.5, slack_penalty=1e3)
    decision = choose(set_of([0.0, 1.0], 1.0), [0.0, 0.0], row)
    assert decision.slack == 0.0
    np.testing.assert_allclose(decision.input, [-0.5, 0.0], atol=1e-9)


def test_volume_row_gives_way_by_the_least_slack():
    row = VolumeRow(a=np.array([1.0, 0.0]), c=-1.5, slack_penalty=1e3)
    decision = choose(set_of([0.0, 1.0], 1.0), [0.0, 0.3], row)
    assert decision.status == FilterStatus.RELAXED
    assert decision.slack == pytest.approx(-0.5, abs=1e-7)
    np.testing.assert_allclose(decision.input, [-1.0, 0.3], atol=1e-7)


def test_paper_penalty_leaves_the_slack_that_its_optimality_conditions_say():
    """Delta = -mu / (2 M) whenever the row is active (R35): never exactly zero."""
    penalty, feasible = 50.0, set_of([0.0, 1.0], 1.0)
    row = VolumeRow(a=np.array([1.0, 0.0]), c=-0.5, slack_penalty=penalty)
    decision = choose(feasible, [0.0, 0.0], row, exact_slack=False)
    # In v = (u - center) / 2: min (v1 + 1/2)^2 + M d^2, 2 v1 + 1 + d <= -1/2.
    # With s = 2 v1 + 1: min s^2 / 4 + M d^2, s + d = -1/2.
    expected = -0.5 * (1.0 / 4.0) / (1.0 / 4.0 + penalty)
    assert decision.slack == pytest.approx(expected, rel=1e-9)
    assert decision.input[0] == pytest.approx(-0.5 - expected, rel=1e-9)


def test_infeasible_rows_are_named():
    feasible = set_of([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]], [-0.5, 0.2, 1.0])
    decision = choose(feasible, [0.0, 0.0])
    assert decision.status == FilterStatus.INFEASIBLE
    assert decision.conflict == (4, 5)  # After the box's four rows.
    assert decision.slack == 0.0


def test_infeasible_stays_infeasible_with_a_volume_row_in_the_qp():
    feasible = set_of([[1.0, 0.0], [-1.0, 0.0]], [-0.5, 0.2])
    vanished = VolumeRow(a=np.zeros(2), c=-0.06, slack_penalty=1e3)
    for exact_slack in (True, False):
        decision = choose(feasible, [0.0, 0.0], vanished, exact_slack=exact_slack)
        assert decision.status == FilterStatus.INFEASIBLE


def test_least_violation_is_the_minimax_violation():
    rng = np.random.default_rng(11)
    checked = 0
    for _ in range(200):
        A, b = rng.normal(size=(4, 2)), rng.uniform(-3.0, -0.2, 4)
        feasible = set_of(A, b)
        if chebyshev_ball(*normalised(feasible))[1] > -1e-6:
            continue
        decision = choose(feasible, rng.normal(size=2), policy="least_violation")
        oracle = linprog(
            [0.0, 0.0, 1.0],
            A_ub=np.column_stack([A, -np.ones(4)]),
            b_ub=b,
            bounds=[(-1.0, 3.0), (-2.0, 2.0), (0.0, None)],
        )
        violation = np.max(A @ decision.input - b)
        assert violation == pytest.approx(oracle.fun, abs=1e-6)
        assert BOX.contains(decision.input)
        checked += 1
    assert checked > 50


def test_weights_say_which_barrier_gives_way():
    # u1 <= -0.5 and u1 >= 0.2 cannot both hold; the violations add up to 0.7.
    weights = np.array([6.0, 1.0])
    feasible = set_of([[1.0, 0.0], [-1.0, 0.0]], [-0.5, -0.2], weights=weights)
    decision = choose(feasible, ORIGIN, policy="least_violation")
    assert decision.input[0] == pytest.approx(-0.4, abs=1e-6)


def test_hold_keeps_the_held_input_inside_the_input_set():
    feasible = set_of([[1.0, 0.0], [-1.0, 0.0]], [-0.5, 0.2])
    decision = choose(feasible, ORIGIN, policy="hold", held_input=np.array([9.0, 0.5]))
    assert decision.status == FilterStatus.INFEASIBLE
    np.testing.assert_allclose(decision.input, [3.0, 0.5])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["A", "b", "reference", "reference and held input"])
def test_numbers_that_are_not_finite_never_leave_the_filter(bad, where):
    feasible = set_of([bad if where == "A" else 1.0, 0.0], bad if where == "b" else 1.0)
    reference = [bad if "reference" in where else 0.0, 0.0]
    held = np.full(2, bad) if "held" in where else ORIGIN
    decision = choose(feasible, reference, held_input=held)
    assert decision.status == FilterStatus.FAILED
    assert BOX.contains(decision.input)


def test_a_reference_far_outside_is_brought_back():
    decision = choose(set_of([1.0, 1.0], 1.0), [1e200, -1e200])
    assert decision.status == FilterStatus.FILTERED
    np.testing.assert_allclose(decision.input, [3.0, -2.0], atol=1e-6)


def test_a_reference_far_outside_is_brought_back_along_a_row():
    """To (1, 0): as far on either input, in input ranges, from where it came."""
    decision = choose(set_of([1.0, 1.0], 1.0), [1e200, 1e200])
    assert decision.status == FilterStatus.FILTERED
    np.testing.assert_allclose(decision.input, [1.0, 0.0], atol=1e-6)


def failing(*arguments, **options):
    raise SolverError("no answer", np.zeros((1, 2)), np.zeros(1))


def test_an_emptiness_that_floats_cannot_prove_is_proven_in_rationals():
    """Rows that meet, at u_2 = -3e10: in conflict with a limit, by next to nothing."""
    feasible = set_of([[1.0, 0.0], [-1.0, 1e-11]], [-0.5, 0.2])
    decision = choose(feasible, [0.0, 0.5])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (3, 4, 5)
    np.testing.assert_allclose(decision.input, [-0.35, 0.5], atol=1e-6)


def test_the_fallback_on_a_set_that_is_not_empty_stays_near_the_reference():
    """No barrier need give way, so none is kept further than it asks for."""
    feasible = set_of([[1.0, 0.0], [0.0, 1.0]], [0.5, 5.0])
    reference = BOX.center + BOX.scale * [0.4, 0.2]
    found = least_violation(feasible, Frame.of(BOX), reference, ORIGIN)
    np.testing.assert_allclose(found, [0.5, 0.4], atol=1e-6)


def test_a_volume_row_that_holds_after_all_has_no_slack(monkeypatch):
    """The first attempt finds no point, by rounding alone; the second keeps all."""
    attempts = []

    def at_the_second(A, b, *others):
        attempts.append(others)
        if len(attempts) == 1:
            raise EmptySetError(A, b, -1e-9, np.eye(len(b))[-1])
        return nearest_point(A, b, *others)

    monkeypatch.setattr(decision_module, "nearest_point", at_the_second)
    row = VolumeRow(a=np.array([1.0, 0.0]), c=-0.5, slack_penalty=1e3)
    decision = choose(set_of([0.0, 1.0], 1.0), [-0.8, 1.5], row)
    assert decision.status == FilterStatus.FILTERED and decision.slack == 0.0
    np.testing.assert_allclose(decision.input, [-0.8, 1.0], atol=1e-9)


def test_without_limits_and_hard_rows_the_least_violation_is_none():
    unbounded = InputSet.box([-np.inf, -np.inf], [np.inf, np.inf])
    feasible = fixed_set(unbounded, [[1.0, 0.0]], [-1.0], np.array([10.0]))
    frame, reference = Frame.of(unbounded), np.array([2.0, 3.0])
    u = least_violation(feasible, frame, reference, np.zeros(2))
    np.testing.assert_allclose(u, reference)


def test_without_any_solver_the_held_input_acts(monkeypatch):
    monkeypatch.setattr(decision_module, "nearest_point", failing)
    monkeypatch.setattr(decision_module, "minimise_linear", failing)
    decision = choose(set_of([1.0, 1.0], -1.0), [2.0, 1.0], held_input=[-9.0, 0.5])
    assert decision.status == FilterStatus.FAILED
    np.testing.assert_allclose(decision.input, [-1.0, 0.5])
    assert decision.slack == 0.0


@pytest.mark.parametrize(
    ("a", "c", "is_finite"),
    [
        ([1.0, 2.0], 0.5, True),
        ([1.0, np.nan], 0.5, False),
        ([np.inf, 2.0], 0.5, False),
        ([1.0, 2.0], -np.inf, False),
    ],
)
def test_a_volume_row_is_finite_as_a_whole(a, c, is_finite):
    assert VolumeRow(np.array(a), c, 1e3).is_finite == is_finite


def test_a_reference_far_away_in_one_input_alone():
    """The other input is not moved by what is lost in rounding."""
    decision = choose(set_of([1.0, 1.0], 1.0), [1e12, 0.25])
    assert decision.status == FilterStatus.FILTERED
    np.testing.assert_allclose(decision.input, [3.0, -2.0], atol=1e-9)
    decision = choose(set_of([1.0, 0.0], 1.0), [1e12, 0.25])
    np.testing.assert_allclose(decision.input, [1.0, 0.25], atol=1e-9)
