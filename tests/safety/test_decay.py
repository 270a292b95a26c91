"""Barriers that decay faster where else no input is left."""

import numpy as np
import pytest

from tests.helpers.fixed_set import fixed_set
from vcbf_drake import load_scenario, simulate
from vcbf_drake.barriers import HalfSpace
from vcbf_drake.safety import FilterStatus, InputSet
from vcbf_drake.safety.decay import DecayRates
from vcbf_drake.safety.decision import choose_input

LINE = InputSet.box([-1.0], [1.0])


def decide(b, slopes, reference, most=9.0, policy="decay", **choices):
    """Of u <= b_1, -u <= b_2, ... in turn, |u| <= 1, each with its lambda phi."""
    A = np.array([[1.0], [-1.0]] * len(b))[: len(b)]
    return choose_input(
        fixed_set(LINE, A, b),
        None,
        np.array([reference]),
        np.zeros(1),
        policy,
        decay_rates=DecayRates(np.array(slopes), np.full(len(b), most), **choices),
    )


def test_the_rates_grow_by_as_little_as_helps():
    """Min u^2 + 100 w_1^2 + 100 w_2^2, u <= -0.5 + w_1, u >= 0.5 - 2 w_2, by hand.

    On both rows the cost is u^2 + 100 (u + 0.5)^2 + 25 (0.5 - u)^2: 252 u = -75.
    """
    found = decide([-0.5, -0.5], [1.0, 2.0], 0.0)
    assert found.status == FilterStatus.INFEASIBLE
    assert sorted(found.conflict) == [2, 3]
    np.testing.assert_allclose(found.input, [-75.0 / 252.0], atol=1e-7)
    assert found.decay == pytest.approx(1.0 + (0.5 + 75.0 / 252.0) / 2.0)


def test_one_row_that_excludes_the_limits_grows_to_them():
    """U <= -2 + 1.5 w and u >= -1: w = 2/3, whatever the reference."""
    found = decide([-2.0], [1.5], 0.5)
    np.testing.assert_allclose(found.input, [-1.0], atol=1e-9)
    assert found.decay == pytest.approx(5.0 / 3.0)


def test_where_rows_have_an_input_nothing_grows():
    for policy in ("decay", "hold"):
        found = decide([0.2], [1.5], 0.5, policy=policy)
        assert found.status == FilterStatus.FILTERED and found.decay == 1.0
        np.testing.assert_allclose(found.input, [0.2], atol=1e-9)


@pytest.mark.parametrize(("slopes", "most"), [([0.0], 9.0), ([1.5], 1.5), ([0.5], 2.9)])
def test_what_no_rate_can_mend_is_violated_least(slopes, most):
    """A level that is not positive, and a factor beyond what a period allows."""
    found = decide([-2.0], slopes, 0.5, most)
    assert found.status == FilterStatus.INFEASIBLE and found.decay == 1.0
    np.testing.assert_allclose(found.input, [-1.0], atol=1e-7)


def test_optimal_decay_weighs_a_row_against_the_reference():
    """Min (u - 0.5)^2 + 4 w^2 with u <= 0.2 + 1.5 w: the row is in reach, and grows.

    On it u = 0.2 + 1.5 w: -3 (0.3 - 1.5 w) + 8 w = 0, w = 0.9 / 12.5.
    """
    found = decide([0.2], [1.5], 0.5, penalty=4.0, only_where_empty=False)
    assert found.status == FilterStatus.FILTERED
    assert found.decay == pytest.approx(1.0 + 0.9 / 12.5)
    np.testing.assert_allclose(found.input, [0.2 + 1.5 * 0.9 / 12.5], atol=1e-9)
    untouched = decide([0.2], [1.5], 0.1, penalty=4.0, only_where_empty=False)
    assert untouched.status == FilterStatus.REFERENCE and untouched.decay == 1.0


@pytest.mark.parametrize("policy", ["hold", "decay", "least_violation"])
def test_optimal_decay_is_infeasible_where_the_largest_rates_leave_nothing(policy):
    """U <= -2 + 0.2 * 1.5, while u >= -1: a conflict of that row and the limit."""
    found = decide([-2.0], [1.5], 0.5, 1.2, policy, only_where_empty=False)
    assert found.status == FilterStatus.INFEASIBLE and found.decay == 1.0
    assert sorted(found.conflict) == [1, 2]
    held = 0.0 if policy == "hold" else -1.0
    np.testing.assert_allclose(found.input, [held], atol=1e-7)


def test_optimal_decay_solves_the_smooth_problem_without_its_variables():
    """A convex cost over a box, rows that grow and a soft one in it as penalties.

    A point is its minimiser where a step down the gradient, cut off at the box, leads
    nowhere.
    """
    rng = np.random.default_rng(3)
    box = InputSet.box([-1.0, -2.0, -0.5], [1.0, 2.0, 0.5])
    for _ in range(20):
        A, b = rng.normal(size=(5, 3)), rng.uniform(-1.5, 0.5, 5)
        slopes = np.append(rng.uniform(0.1, 2.0, 4), 0.0)
        penalties = np.array([np.inf, np.inf, np.inf, 3.0, np.inf])
        A[4], b[4] = [1.0, 0.0, 0.0], 0.3  # The row that cannot grow.
        reference = rng.uniform(-2.0, 2.0, 3) * box.scale
        rates = DecayRates(slopes, np.full(5, 1e3), 20.0, only_where_empty=False)
        found = choose_input(
            fixed_set(box, A, b, penalties),
            None,
            reference,
            np.zeros(3),
            "stop",
            decay_rates=rates,
        )

        weights, u = np.append(20.0 / slopes[:3] ** 2, [3.0, 0.0]), found.input
        excess = np.maximum(A @ u - b, 0.0)
        slope = 2.0 * ((u - reference) / box.scale**2 + A.T @ (weights * excess))
        low, high = [-1.0, -2.0, -0.5], [0.3, 2.0, 0.5]
        assert (excess[:4] > 0.0).any()
        np.testing.assert_allclose(np.clip(u - slope, low, high), u, atol=1e-7)


def test_rates_at_a_tick():
    """Gains (4, 3) are rates of 3 and 1: the slope is phi_1, the most 0.9 / T."""
    chain = (np.array([2.0, 5.0]), np.array([2.0, -5.0]), np.array([-1.0]))
    wall = HalfSpace([-1.0, 0.0], -5.0).barrier([4.0, 3.0], name="wall")
    rates = DecayRates.at(chain, [wall] * 3, 0.02)
    np.testing.assert_allclose(rates.slopes, [5.0, 0.0, 0.0])
    np.testing.assert_allclose(rates.most, [45.0, 1.0, 1.0])
    cubic = DecayRates.at(chain, [wall.with_class_k(lambda p: 0.1 * p**3)] * 3, 0.02)
    np.testing.assert_allclose(cubic.slopes, [12.5, 0.0, 0.0])
    np.testing.assert_allclose(cubic.most[0], 0.9 * 5.0 / (12.5 * 0.02))


def test_a_car_that_runs_out_of_inputs_goes_on_with_positive_levels():
    """k_p = 0.2 of the car's sensitivity: infeasible at 3.02 s, by the paper."""
    overrides = {"method": "dob-cbf-qp", "infeasible": "decay"}
    result = simulate(load_scenario("car-sensitivity", overrides))
    infeasible = result.log["status"] == FilterStatus.INFEASIBLE
    assert result.summary["infeasible_at"] == pytest.approx(3.02)
    assert result.summary["decayed_ticks"] == infeasible.sum() > 10
    assert np.all((result.log["decay"] > 1.0) == infeasible)
    assert result.summary["outcome"] == "reached"
    for name in ("barrier", "chain", "barrier between ticks"):
        assert result.summary["audit"][name]["held"]
    assert not result.summary["guaranteed"]
