"""Limits on the input that depend on the state, against closed forms."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.row_gradients import row_gradients
from vcbf_drake.barriers import BarrierSet, StateInputLimit, ackermann_limit
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car


@pytest.fixture(scope="module")
def car() -> ControlAffineModel:
    return ControlAffineModel.from_system(Car())


@pytest.mark.parametrize("speed", [-1.5, 0.0, 0.02, 3.0])
def test_the_turn_rate_is_limited_on_both_sides(car, speed) -> None:
    curvature, smoothing = 1.7, 0.1
    barriers = BarrierSet(car, ackermann_limit(curvature, smoothing))
    assert barriers.names == ("turn rate (left)", "turn rate (right)")
    rows = barriers.rows(np.array([1.0, 2.0, speed, 0.3]), 4.0)
    smooth_speed = np.sqrt(speed**2 + smoothing**2)
    assert_allclose(rows.A, [[0.0, 1.0], [0.0, -1.0]])
    assert_allclose(rows.b, 2 * [curvature * smooth_speed])
    slope = np.zeros((2, 5))
    slope[:, 2] = curvature * speed / smooth_speed
    assert_allclose(row_gradients(rows).b, slope, atol=1e-15)
    assert not row_gradients(rows).A.any()
    assert rows.w.shape == (2, 1)
    assert not rows.w.any()
    assert not row_gradients(rows).w.any()
    assert np.isnan(rows.value).all()
    assert [chain.shape for chain in rows.chain] == [(0,), (0,)]
    assert np.isnan(barriers.values(np.zeros(4), 0.0)).all()


def test_a_limit_may_depend_on_state_time_and_parameters(car) -> None:
    def limit(x, t, p):
        return [x[2] * t, p[0]], np.cos(x[3]) + p[1] * t**2

    x, t = np.array([0.0, 0.0, 2.0, 0.5]), 3.0
    rows = BarrierSet(car, [StateInputLimit(limit, [4.0, 5.0])]).rows(x, t)
    assert_allclose(rows.A, [[6.0, 4.0]])
    assert_allclose(rows.b, [np.cos(0.5) + 45.0])
    assert_allclose(row_gradients(rows).A, [[[0, 0, 3.0, 0, 2.0], np.zeros(5)]])
    assert_allclose(row_gradients(rows).b, [[0, 0, 0, -np.sin(0.5), 30.0]])


def test_the_limited_states_and_inputs_may_be_any(car) -> None:
    limits = ackermann_limit(2.0, 0.1, speed_state=0, turn_rate_input=0, name="rudder")
    rows = BarrierSet(car, limits).rows(np.array([0.5, 0.0, 9.0, 0.0]), 0.0)
    assert_allclose(rows.A, [[1.0, 0.0], [-1.0, 0.0]])
    assert_allclose(rows.b, 2 * [2.0 * np.hypot(0.5, 0.1)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 0.1), "curvature: 0;"),
        ((np.inf, 0.1), "curvature: inf;"),
        ((1.0, 0.0), "smoothing_speed: 0;"),
        ((1.0, np.nan), "smoothing_speed: nan;"),
    ],
)
def test_bad_turn_limits_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"limit 'turn rate': {message}"):
        ackermann_limit(*arguments)


def test_an_input_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match=r"turn_rate_input must be in 0\.\.1, got 2"):
        ackermann_limit(1.0, 0.1, turn_rate_input=2)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, t, p: x[0], r"must return a row of shape \(2,\) .*, got no pair"),
        (
            lambda x, t, p: (np.array([1.0, 0.0, 0.0]), x[0]),
            r"must return a row of shape \(2,\) .*, got \[\(3,\), \(\)\]",
        ),
        (lambda x, t, p: (np.array([1.0, 0.0]), x[0] > 0), "must return symbolic"),
        (lambda x, t, p: (np.array([1.0, 0.0]), p[0]), "fails on symbols: index 0"),
    ],
)
def test_limits_that_do_not_suit_the_model_are_refused(car, function, message) -> None:
    with pytest.raises(ModelError, match=f"^limit 'wind': .*{message}"):
        BarrierSet(car, [StateInputLimit(function, name="wind")])


def test_bad_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match=r"parameters of limit 'wind': .* finite"):
        StateInputLimit(lambda x, t, p: None, [np.nan], name="wind")
