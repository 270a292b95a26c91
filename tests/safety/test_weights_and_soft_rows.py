"""Weights of the cost, and rows that give way at a penalty, against quadprog."""

import numpy as np
import pytest
import quadprog

from tests.helpers.fixed_set import fixed_set
from vcbf_drake.safety import (
    FilterSettings,
    FilterStatus,
    InputSet,
)
from vcbf_drake.safety.decision import choose_input
from vcbf_drake.safety.qp import Frame, VolumeRow

BOX = InputSet.box([-1.0, -4.0, -2.0], [3.0, 4.0, 2.0])


def choose(
    A, b, reference, weights=None, penalties=None, volume_row=None, box=BOX, linear=None
):
    penalties = None if penalties is None else np.array(penalties)
    linear = None if linear is None else np.array(linear)
    return choose_input(
        fixed_set(box, A, b, penalties, linear),
        volume_row,
        np.array(reference, dtype=float),
        np.zeros(len(reference)),
        "least_violation",
        frame=Frame.of(box, weights),
    )


def by_quadprog(W, A, b, reference, penalties, linear=None):
    """The same QP with a slack for every row, not negative, in physical inputs."""
    m, soft = len(reference), np.flatnonzero(np.isfinite(penalties))
    W = np.diag(W) if np.ndim(W) == 1 else np.asarray(W)
    H = np.zeros((m + len(soft), m + len(soft)))
    H[:m, :m] = W
    H[m:, m:] = np.diag(np.asarray(penalties)[soft])
    rows = np.hstack([A, np.zeros((len(b), len(soft)))])
    rows[soft, m + np.arange(len(soft))] = -1.0
    limits = np.hstack([BOX.A, np.zeros((len(BOX.b), len(soft)))])
    signs = np.hstack([np.zeros((len(soft), m)), -np.eye(len(soft))])
    A = np.vstack([limits, rows, signs])
    b = np.concatenate([BOX.b, b, np.zeros(len(soft))])
    g = np.zeros(m + len(soft))
    g[:m] = W @ reference
    if linear is not None:
        g[m:] = -0.5 * np.asarray(linear)[soft]
    return quadprog.solve_qp(H, g, -A.T, -b)[0][:m]


def random_weights(rng):
    if rng.random() < 0.5:
        return 10.0 ** rng.uniform(-2.0, 2.0, 3)
    root = rng.normal(size=(3, 3))
    return root @ root.T + 0.05 * np.eye(3)


def test_weights_and_penalties_agree_with_quadprog():
    rng = np.random.default_rng(0)
    filtered = gave_way = 0
    for _ in range(200):
        n = int(rng.integers(1, 5))
        A = rng.normal(size=(n, 3))
        b = A @ rng.uniform(-0.5, 0.5, 3) + rng.uniform(0.0, 0.5, n)
        reference = rng.uniform(-4.0, 4.0, 3)
        soft = rng.random(n) < 0.4
        penalties = np.where(soft, 10.0 ** rng.uniform(-1.0, 4.0, n), np.inf)
        W = random_weights(rng)
        decision = choose(A, b, reference, W, penalties)
        expected = by_quadprog(W, A, b, reference, penalties)
        np.testing.assert_allclose(decision.input, expected, atol=1e-6)
        slacks = np.minimum(b - A @ expected, 0.0)[soft]
        np.testing.assert_allclose(
            decision.soft_slacks or np.zeros(soft.sum()), slacks, atol=1e-6
        )
        filtered += decision.status == FilterStatus.FILTERED
        gave_way += bool((slacks < -1e-3).any())
    assert filtered > 150 and gave_way > 40


def test_linear_penalties_agree_with_quadprog():
    rng = np.random.default_rng(3)
    held = gave_way = passed = 0
    for _ in range(200):
        n = int(rng.integers(1, 5))
        A = rng.normal(size=(n, 3))
        b = A @ rng.uniform(-0.5, 0.5, 3) + rng.uniform(-0.5, 0.5, n)
        reference = rng.uniform(-4.0, 4.0, 3)
        soft = rng.random(n) < 0.7
        penalties = np.where(soft, 10.0 ** rng.uniform(-1.0, 2.0, n), np.inf)
        linear = np.where(soft, rng.choice([0.0, 0.3, 3.0, 100.0], n), 0.0)
        W = random_weights(rng)
        try:
            expected = by_quadprog(W, A, b, reference, penalties, linear)
        except ValueError:
            continue
        decision = choose(A, b, reference, W, penalties, linear=linear)
        np.testing.assert_allclose(decision.input, expected, atol=1e-6)
        if decision.status == FilterStatus.REFERENCE:
            passed += 1
            continue
        slacks = np.minimum(b - A @ expected, 0.0)[soft]
        np.testing.assert_allclose(decision.soft_slacks, slacks, atol=1e-6)
        gave_way += bool((slacks < -1e-3).any())
        held += bool((linear[soft] > 0.0).any() and (slacks > -1e-9).all())
    assert held > 30 and gave_way > 30 and passed > 5


@pytest.mark.parametrize("quadratic", [1e-3, 1.0, 1e3])
def test_a_linear_penalty_is_exact(quadratic):
    """u_1 >= 2 is soft. Its multiplier at |u|^2 is 4: at more it holds, at less not."""
    A, b, ones = [[-1.0, 0.0, 0.0]], [-2.0], [1.0] * 3
    for linear, expected in ((4.1, 2.0), (1e4, 2.0), (1.0, None), (0.0, None)):
        decision = choose(A, b, [0.0] * 3, ones, [quadratic], linear=[linear])
        # Else u^2 + M (2 - u)^2 + N (2 - u) is least.
        least = (2.0 * quadratic + 0.5 * linear) / (1.0 + quadratic)
        expected = expected or least
        np.testing.assert_allclose(decision.input, [expected, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(decision.soft_slacks, [expected - 2.0], atol=1e-9)
    # What it cannot have, it does not ask for: u_1 <= 1 is not soft.
    A, b = [*A, [1.0, 0.0, 0.0]], [*b, 1.0]
    decision = choose(A, b, [0.0] * 3, ones, [quadratic, np.inf], linear=[1e4, 0.0])
    np.testing.assert_allclose(decision.input, [1.0, 0.0, 0.0], atol=1e-9)
    # And a reference that meets it passes.
    decision = choose(A[:1], b[:1], [2.5, 0.0, 0.0], ones, [quadratic], linear=[1e4])
    assert decision.status == FilterStatus.REFERENCE


def test_a_linear_penalty_beside_limits_as_good_as_none():
    """In coordinates finer than the limits' the penalty is of the same slack."""
    box, A, b = InputSet.box([-1e9], [1e9]), [[-1.0]], [-2.0]
    for linear, expected in ((4.1, 2.0), (2.0, 1.5)):
        decision = choose(A, b, [0.0], [1.0], [1.0], box=box, linear=[linear])
        np.testing.assert_allclose(decision.input, [expected], atol=1e-6)


def test_the_published_metric_is_one_of_the_weights():
    """|u - u_ref|^2 in newtons: the projection on u_1 + u_2 = 0."""
    decision = choose([[1.0, 1.0, 0.0]], [0.0], [1.0, 0.5, 0.2], weights=[1.0] * 3)
    np.testing.assert_allclose(decision.input, [0.25, -0.25, 0.2], atol=1e-12)
    decision = choose([[1.0, 1.0, 0.0]], [0.0], [1.0, 0.5, 0.2])
    assert abs(decision.input[0] - 0.25) > 0.1  # The half-widths are 2 and 4.


def test_a_lyapunov_function_gives_way_to_a_barrier():
    """Row 0, u_1 >= 2, is soft; row 1, u_1 <= 1, is not: min u^2 + M (2 - u)^2."""
    A, b = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [-2.0, 1.0]
    for penalty, expected in ((1.0, 1.0), (0.5, 2.0 / 3.0), (1e6, 1.0)):
        decision = choose(A, b, [0.0] * 3, [1.0] * 3, [penalty, np.inf])
        assert decision.status == FilterStatus.FILTERED
        np.testing.assert_allclose(decision.input, [expected, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(decision.soft_slacks, [expected - 2.0], atol=1e-9)
    decision = choose(A, b, [0.0] * 3, [1.0] * 3)
    assert decision.status == FilterStatus.INFEASIBLE


def test_soft_rows_are_no_part_of_a_conflict_nor_of_the_fallback():
    A = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    decision = choose(A, [0.0, -1.0, -3.0], [0.2] * 3, None, [np.inf, np.inf, 10.0])
    assert decision.status == FilterStatus.INFEASIBLE and decision.conflict == (6, 7)
    np.testing.assert_allclose(decision.input, [0.5, 0.2, 0.2], atol=1e-9)


def test_a_volume_row_gives_way_before_a_soft_row_is_asked():
    """u_1 <= 0 of the volume row, against u_1 >= 1, which is hard."""
    row = VolumeRow(np.array([1.0, 0.0, 0.0]), 0.0)
    A, b = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [-1.0, -1.0]
    decision = choose(A, b, [0.0] * 3, [1.0] * 3, [np.inf, 3.0], row)
    assert decision.status == FilterStatus.RELAXED
    assert decision.slack == pytest.approx(-1.0, abs=3e-9)
    # u_2 minimises u^2 + 3 (u + 1)^2.
    np.testing.assert_allclose(decision.input, [1.0, -0.75, 0.0], atol=1e-8)
    np.testing.assert_allclose(decision.soft_slacks, [-0.25], atol=1e-8)


LOPSIDED = [[1.0, 0.9, 0.0], [-0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    "weights",
    [
        [1.0],
        [1.0, 0.0, 1.0],
        [1.0, -1.0, 1.0],
        np.ones((3, 3)),
        [np.nan] * 3,
        np.full((3, 3), np.inf),
        LOPSIDED,
        1e-9 * np.array(LOPSIDED),
    ],
)
def test_weights_that_are_none_are_refused(weights):
    with pytest.raises(ValueError, match=r"input_weights: .* positive definite"):
        Frame.of(BOX, weights)


def test_settings_check_the_penalties():
    assert FilterSettings(soft_penalties=[1.0, np.inf]).soft_penalties[1] == np.inf
    with pytest.raises(ValueError, match="soft_penalties"):
        FilterSettings(soft_penalties=[0.0])
    FilterSettings(soft_penalties=[1.0, np.inf], soft_linear_penalties=[2.0, 0.0])
    for wrong in ([2.0], [2.0, 1.0], [-1.0, 0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="soft_linear_penalties"):
            FilterSettings(soft_penalties=[1.0, np.inf], soft_linear_penalties=wrong)
