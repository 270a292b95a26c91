"""Limits of one state, against closed forms."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, StateLimit
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car, CarParameters

START = [0.0, 0.1, -0.1, 0.3, 0.5, 0.2, -0.3, 0.7]
INPUT, WIND = [0.05, -0.02, 0.001], [0.1, -0.2, 0.15]


def test_a_speed_limit_bounds_the_force() -> None:
    car = ControlAffineModel.from_system(Car(CarParameters(mass=1.7)))
    limit = StateLimit(2, lower=-0.5, upper=1.5)
    barriers = BarrierSet(car, limit.barriers([2.0], name="speed"))
    assert barriers.names == ("speed (low)", "speed (high)")
    rows = barriers.rows(np.array([0.0, 0.0, 1.0, 0.3]), 0.0)
    assert_allclose(rows.value, [1.5, 0.5])
    # dv/dt = a / m, so -2 (v + 0.5) <= a / m <= 2 (1.5 - v).
    assert_allclose(rows.A, [[-1 / 1.7, 0.0], [1 / 1.7, 0.0]])
    assert_allclose(rows.b, [3.0, 1.0])
    assert_allclose(rows.w, [[1.0], [-1.0]])


@pytest.mark.parametrize("state", [2, 6])
def test_rows_are_derivatives(state) -> None:
    gains = {2: (3.0, 2.0), 6: (3.0,)}[state]
    (barrier,) = StateLimit(state, upper=1.0).barriers(gains)

    def h(x, t):
        return 1.0 - x[state]

    assert_rows_are_derivatives(Blimp(), barrier, h, START, INPUT, WIND)


def test_the_gains_must_fit_the_state() -> None:
    blimp = ControlAffineModel.from_system(Blimp())
    for state, gains, degree in ((2, [1.0], 2), (6, [3.0, 2.0], 1)):
        with pytest.raises(ModelError, match=f"relative degree is {degree}"):
            BarrierSet(blimp, StateLimit(state, lower=0.0).barriers(gains))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ((2.0, 1.0), "lower must be below upper, got 2.0 and 1.0"),
        ((np.nan, 1.0), "lower must be below upper"),
        ((-np.inf, np.inf), "give lower, upper or both"),
    ],
)
def test_bad_limits_are_refused(limits, message) -> None:
    with pytest.raises(ValueError, match=f"^state limit: {message}"):
        StateLimit(0, *limits)
