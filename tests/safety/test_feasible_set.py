"""The feasible set: the disturbance's worst, and the same set in other inputs."""

import dataclasses

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.fixed_set import normalised
from vcbf_drake.barriers import BarrierRows
from vcbf_drake.safety import DisturbanceKnowledge, InputSet, disturbance_margin
from vcbf_drake.safety.qp import RowCosts, feasible_set

TRIANGLE = InputSet([[1.0, 1.0], [-1.0, 1.0], [0.0, -1.0]], [3.0, 1.0, 2.0])
BOX = InputSet.box([-1.0, -0.2], [3.0, 0.6])


def random_rows(rng, n, q=3):
    return BarrierRows(
        value=np.ones(n),
        chain=tuple(np.ones(2) for _ in range(n)),
        A=rng.normal(size=(n, 2)),
        b=rng.normal(size=n),
        w=rng.normal(size=(n, q)),
        num_states=2,
        gradients=lambda rows: np.zeros((len(rows), 4 + q, 3)),
    )


def knowledge(rng, q=3):
    return DisturbanceKnowledge(rng.normal(size=q), np.zeros(q), 0.7, 0.0, 0.0)


def test_margin_is_the_least_of_what_the_disturbance_may_do():
    """Of w'd over |d - estimate| <= bound, by many d on the sphere."""
    rng = np.random.default_rng(0)
    rows, known = random_rows(rng, 5), knowledge(rng)
    errors = rng.normal(size=(20000, 3))
    errors *= known.bound / np.linalg.norm(errors, axis=1, keepdims=True)
    values = rows.w @ (known.estimate + errors).T
    margin = disturbance_margin(rows, known)
    assert (values.min(axis=1) >= margin).all()
    assert_allclose(margin, values.min(axis=1), atol=2e-3)


def test_without_an_observer_the_ball_is_around_zero():
    known = DisturbanceKnowledge.constant(3, 0.4)
    rows = random_rows(np.random.default_rng(1), 4)
    assert not known.estimate.any() and not known.rate.any()
    assert known.bound_rate == 0.0 and known.gain == 0.0
    length = np.linalg.norm(rows.w, axis=1)
    assert_allclose(disturbance_margin(rows, known), -0.4 * length)


@pytest.mark.parametrize("input_set", [BOX, TRIANGLE])
def test_normalised_rows_are_the_same_set(input_set):
    rng = np.random.default_rng(2)
    rows, known = random_rows(rng, 6), knowledge(rng)
    feasible = feasible_set(input_set, rows, known)
    k = len(input_set.b)
    assert feasible.num_input_rows == k
    assert_allclose(feasible.A, np.vstack([input_set.A, rows.A]))
    assert_allclose(feasible.b[k:], rows.b + disturbance_margin(rows, known))
    v = rng.uniform(-2.0, 2.0, (500, 2))
    u = input_set.center + input_set.scale * v
    A_v, b_v = normalised(feasible)
    slack, slack_v = feasible.b - u @ feasible.A.T, b_v - v @ A_v.T
    assert_allclose(slack_v[:, k:], slack[:, k:], atol=1e-12)
    # The input set's own rows are of unit length in v, so only the signs agree.
    clear = np.abs(slack_v) > 1e-9
    assert (np.sign(slack)[clear] == np.sign(slack_v)[clear]).all()


@pytest.mark.parametrize("input_set", [BOX, TRIANGLE])
def test_rows_that_are_left_out_hold_on_the_whole_bounding_box(input_set):
    rng = np.random.default_rng(3)
    corners = np.array([[s, t] for s in (-1.0, 1.0) for t in (-1.0, 1.0)])
    kinds = set()
    for _ in range(30):
        feasible = feasible_set(input_set, random_rows(rng, 4), knowledge(rng))
        cuts = (corners @ feasible.normals.T > feasible.distance).any(axis=0)
        assert feasible.cut.tolist() == np.flatnonzero(cuts).tolist()
        kinds |= set(cuts.tolist())
    assert kinds == {True, False}


@pytest.mark.parametrize("input_set", [BOX, TRIANGLE])
def test_a_reserve_is_taken_off_the_barrier_rows_alone(input_set):
    rng = np.random.default_rng(7)
    rows, known = random_rows(rng, 4), knowledge(rng)
    reserve, k = rng.uniform(0.0, 1.0, 4), len(input_set.b)
    feasible = feasible_set(input_set, rows, known)
    tightened = feasible.tightened(reserve)
    assert_allclose(tightened.b[:k], feasible.b[:k])
    assert_allclose(tightened.b[k:], feasible.b[k:] - reserve)
    A_v, b_v = normalised(feasible)
    assert_allclose(normalised(tightened)[0], A_v)
    assert_allclose(normalised(tightened)[1][:k], b_v[:k])
    assert_allclose(normalised(tightened)[1][k:], b_v[k:] - reserve)
    rows = dataclasses.replace(rows, b=rows.b - reserve)
    expected = feasible_set(input_set, rows, known)
    assert tightened.cut.tolist() == expected.cut.tolist()


@pytest.mark.parametrize("where", ["A", "b", "w"])
def test_numbers_that_are_not_finite_are_seen(where):
    rng = np.random.default_rng(4)
    rows = random_rows(rng, 2)
    assert feasible_set(BOX, rows, knowledge(rng)).is_finite
    getattr(rows, where)[1] = np.nan
    assert not feasible_set(BOX, rows, knowledge(rng)).is_finite


def test_weights_are_ones_by_default():
    rows = random_rows(np.random.default_rng(5), 2)
    known = DisturbanceKnowledge.constant(3, 0.0)
    assert feasible_set(BOX, rows, known).costs.weights.tolist() == [1.0, 1.0]
    costs = dataclasses.replace(RowCosts.equal(2), weights=np.array([2.0, 3.0]))
    assert feasible_set(BOX, rows, known, costs).costs is costs
