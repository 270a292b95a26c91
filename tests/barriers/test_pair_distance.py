"""Two robots that keep a distance, against plain geometry."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.paired_cars import paired_cars
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, PairDistance
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel

K = (3.0, 2.0)
PAIR = PairDistance(0.5).barrier(K, first=(0, 1), second=(4, 5))


@pytest.mark.parametrize(
    "start",
    [[0.0, 0.0, 0.8, 0.3, 2.0, 0.5, 0.6, 2.5], [0, 0, 0.4, 0.1, 0.6, 0.1, -0.2, 0.2]],
)
def test_rows_are_derivatives(start) -> None:
    def h(x, t):
        return np.hypot(x[0] - x[4], x[1] - x[5]) - 0.5

    u = [0.4, -0.6, -0.2, 0.5]
    assert_rows_are_derivatives(paired_cars(), PAIR, h, start, u)


def test_it_matters_not_who_is_first() -> None:
    cars = ControlAffineModel.from_system(paired_cars())
    other = PairDistance(0.5).barrier(K, first=(4, 5), second=(0, 1), name="turned")
    x = np.array([0.0, 0.0, 0.8, 0.3, 3.0, 4.0, 0.6, 2.5])
    rows = BarrierSet(cars, [PAIR, other]).rows(x, 0.0)
    assert rows.value == pytest.approx([4.5, 4.5])
    assert rows.A[0] == pytest.approx(rows.A[1])
    assert rows.b[0] == pytest.approx(rows.b[1])
    assert np.isfinite(rows.A_gradient).all()


def test_where_both_are_in_one_place_the_row_is_nan() -> None:
    cars = ControlAffineModel.from_system(paired_cars())
    rows = BarrierSet(cars, [PAIR]).rows(np.zeros(8), 0.0)
    assert np.isnan(rows.b).all()


def test_bad_pairs_are_refused() -> None:
    for distance in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=r"^pair: distance:"):
            PairDistance(distance)
    for second in [(4,), (4, 5, 6), (4, 4)]:
        with pytest.raises(ValueError, match="'pair': position must name 2 states"):
            PairDistance(1.0).barrier(K, (0, 1), second)
    with pytest.raises(ValueError, match="first and second are both"):
        PairDistance(1.0).barrier(K, (0, 1), (0, 1))
    with pytest.raises(ModelError, match="relative degree is 2"):
        BarrierSet(
            ControlAffineModel.from_system(paired_cars()),
            [PairDistance(1.0).barrier([1.0], (0, 1), (4, 5))],
        )
