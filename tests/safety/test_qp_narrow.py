"""Narrow sets, flat sets and heavy penalties, against projections in rationals."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest

from tests.helpers.fixed_set import fixed_set
from tests.properties.campaign import make_example
from tests.properties.first_order_optimality import solve_exactly
from vcbf_drake.errors import EmptySetError
from vcbf_drake.safety import FilterStatus, InputSet
from vcbf_drake.safety.decision import choose_input
from vcbf_drake.safety.polytope import minimise_linear
from vcbf_drake.safety.projection import nearest_by_active_set, nearest_point
from vcbf_drake.safety.qp import VolumeRow

SQUARE = np.vstack([np.eye(2), -np.eye(2)])


def exact_projection(A, b, reference):
    """The choice of active rows that satisfies every condition, without rounding."""
    A = [[Fraction(float(x)) for x in row] for row in A]
    b, r = ([Fraction(float(x)) for x in values] for values in (b, reference))

    def dot(x, y):
        return sum(p * q for p, q in zip(x, y, strict=True))

    for size in range(len(r) + 1):
        for active in combinations(range(len(b)), size):
            gram = [[dot(A[i], A[j]) for j in active] for i in active]
            y = solve_exactly(gram, [dot(A[i], r) - b[i] for i in active])
            if y is None or min(y, default=0) < 0:
                continue
            columns = zip(*(A[i] for i in active), strict=True) if active else ()
            push = [dot(column, y) for column in columns] or [0] * len(r)
            v = [x - p for x, p in zip(r, push, strict=True)]
            if all(dot(row, v) <= c for row, c in zip(A, b, strict=True)):
                return np.array([float(x) for x in v])
    return None


def in_unit_box(A, b, reference, volume_row=None):
    """What the filter answers in the box |u_j| <= 1."""
    reference = np.array(reference, dtype=float)
    box = InputSet.box(-np.ones(len(reference)), np.ones(len(reference)))
    feasible, held = fixed_set(box, A, b), np.zeros(len(reference))
    return choose_input(feasible, volume_row, reference, held, "least_violation")


@pytest.mark.parametrize("far", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("angle", [1.0, 1e-3, 1e-7])
def test_the_active_set_is_exact_at_narrow_angles_and_from_far_away(angle, far):
    rng = np.random.default_rng([int(far), int(1.0 / angle)])
    for _ in range(15):
        m = int(rng.integers(1, 4))
        A = rng.normal(size=(4, m))
        A = A[0] + angle * A
        A /= np.linalg.norm(A, axis=1)[:, None]
        A = np.vstack([np.eye(m), -np.eye(m), A])
        b = A @ rng.uniform(-0.5, 0.5, m) + rng.uniform(0.0, 0.3, len(A))
        reference = far * rng.normal(size=m)
        found = nearest_by_active_set(A, b, reference)
        expected = exact_projection(A, b, reference)
        # What rounding of the rows moves is more where they meet at a narrow angle.
        np.testing.assert_allclose(found.point, expected, atol=1e-14 / angle)
        slack = b - A @ found.point
        assert slack.min() >= -1e-14
        assert np.abs(slack[found.multipliers > 0.0]).max(initial=0.0) <= 1e-14


def test_a_conflict_of_the_active_set_is_farkas_proof():
    A = np.array([[1.0, 0.0], [-0.6, 0.8], [-0.6, -0.8], [0.0, 1.0]])
    found = nearest_by_active_set(A, np.array([-1.0, 0.5, 0.5, 4.0]), np.ones(2))
    assert found.conflict is not None and found.conflict.min() >= 0.0
    np.testing.assert_allclose(found.conflict @ A, 0.0, atol=1e-15)
    assert found.conflict @ [-1.0, 0.5, 0.5, 4.0] < 0.0


@pytest.mark.parametrize(("gap", "is_empty"), [(0.0, 0), (5e-10, 0), (2e-9, 1)])
def test_only_rows_that_are_not_firm_are_opened(gap, is_empty):
    """The last row wants u_1 + u_2 >= 2 + gap of the square: at its corner, at best."""
    A = np.vstack([SQUARE, [-np.sqrt(0.5), -np.sqrt(0.5)]])
    b = np.array([1.0, 1.0, 1.0, 1.0, -np.sqrt(2.0) - gap])
    if is_empty:
        with pytest.raises(EmptySetError) as raised:
            nearest_point(A, b, np.array([0.3, -0.2]), 4)
        assert raised.value.conflict == (0, 1, 4)
        return
    point = nearest_point(A, b, np.array([0.3, -0.2]), 4)
    assert point.max() <= 1.0 + 1e-15
    np.testing.assert_allclose(point, [1.0, 1.0], atol=1e-8)


def test_a_row_of_zeros_is_not_opened():
    decision = in_unit_box([[0.0, 0.0], [1.0, 0.0]], [-6e-10, 0.5], [2.0, 0.0])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (4,)


def test_a_row_that_is_all_but_zero_conflicts_with_the_input_limits_alone():
    decision = in_unit_box([[1e-15, 0.0], [1.0, 0.0]], [-0.3, 0.5], [2.0, 0.0])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (2, 4)


def test_rows_that_are_all_but_zero_do_not_stop_a_volume_row_from_giving_way():
    volume_row = VolumeRow(np.array([1.0, 1.0]), -3.0)
    A, b = [[1e-15, 0.0], [5e-13, 0.0], [0.0, -1.0]], [0.0, -1e-13, 0.2]
    decision = in_unit_box(A, b, [0.5, 0.5], volume_row)
    assert decision.status == FilterStatus.RELAXED
    np.testing.assert_allclose(decision.input, [-1.0, -0.2], atol=1e-9)
    assert decision.slack == pytest.approx(-1.8, abs=1e-9)


def test_a_flat_set_between_rows_of_tiny_and_of_no_coefficients():
    box = InputSet.box([-1.0, -0.2, -3.0], [0.5, 0.3, 1.0])
    A = np.array([[-1e-9, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rows = np.vstack([box.A_normalised, A * box.scale])
    bounds = np.append(box.b_normalised, -A @ box.center)
    reference = (np.full(3, -1.0) - box.center) / box.scale
    point = box.center + box.scale * nearest_point(rows, bounds, reference, 6)
    assert (A @ point <= 1e-9).all() and box.contains(point)
    assert abs(point[1]) <= 1e-9 and point[2] == pytest.approx(-1.0, abs=1e-9)


@pytest.mark.parametrize("penalty", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("size", [1.0, 1e3])
def test_a_heavy_penalty_pushes_against_a_corner(size, penalty):
    """In (u, sqrt(M) delta), the projection that the printed slack asks for."""
    A, b = np.array([[1.0, 0.7], [-0.4, 1.0]]), np.array([0.4, 0.3])
    a, c = size * np.array([-0.8, -0.6]), -2.0 * size
    reference, root = np.array([-0.5, -0.4]), np.sqrt(penalty)
    volume_row = VolumeRow(a, c, penalty)
    decision = in_unit_box(A, b, reference, volume_row)
    assert decision.status == FilterStatus.RELAXED
    rows = np.column_stack([np.vstack([SQUARE, A, a]), [0.0] * 6 + [1.0 / root]])
    bounds = np.array([1.0, 1.0, 1.0, 1.0, *b, c])
    expected = exact_projection(rows, bounds, np.append(reference, 0.0))
    np.testing.assert_allclose(decision.input, expected[:2], atol=1e-9)
    assert decision.slack == pytest.approx(expected[2] / root, abs=2e-9 * size)


def test_a_linear_program_on_a_flat_set_is_exact():
    """On the segment u_1 = u_2 of the square, and of its corner alone."""
    A = np.vstack([SQUARE, [1.0, -1.0], [-1.0, 1.0]])
    b = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    point = minimise_linear(np.array([1.0, 0.5]), A, b)
    np.testing.assert_allclose(point, [-1.0, -1.0], atol=1e-12)
    corner = minimise_linear(
        np.array([1.0, 0.5]), np.vstack([A, [-1.0, -1.0]]), np.append(b, -2.0)
    )
    np.testing.assert_allclose(corner, [1.0, 1.0], atol=1e-12)


# Of seed 0: slabs narrower than rounding, heavy penalties, weights and lengths of very
# different size, and sets that are empty by less than the tolerance.
MENDED = (
    *(1163, 1489, 1674, 2539, 3838, 3979, 10279, 26337, 38979, 44229, 73433, 157621),
    *(166594, 175451, 550875, 587331, 637148, 664252),
)


@pytest.mark.parametrize("number", MENDED)
def test_hostile_ticks_that_had_no_verified_answer_or_a_wrong_one(number):
    assert make_example(0, number).broken == ()
