"""Half-spaces, against the distance to a plane."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from pydrake.examples import QuadrotorPlant
import pytest

from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, HalfSpace
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car

K = (3.0, 2.0)


@pytest.fixture(scope="module")
def car() -> ControlAffineModel:
    return ControlAffineModel.from_system(Car())


def test_the_value_is_the_distance_to_the_plane(car) -> None:
    x = np.array([3.0, 4.0, 0.5, 0.1])
    wall = HalfSpace([0.6, 0.8], 2.0, margin=0.5)
    assert BarrierSet(car, [wall.barrier(K)]).values(x, 0.0) == pytest.approx([2.5])


def test_a_normal_of_any_length_is_the_same_half_space(car) -> None:
    long, unit = HalfSpace([6.0, 8.0], 20.0, 0.5), HalfSpace([0.6, 0.8], 2.0, 0.5)
    barriers = BarrierSet(car, [long.barrier(K), unit.barrier(K, name="wall")])
    assert barriers.names == ("half-space", "wall")
    rows = barriers.rows(np.array([1.0, 0.0, 0.5, 0.1]), 0.0)
    assert_allclose(rows.b[0], rows.b[1], rtol=1e-14)


@pytest.mark.parametrize(
    ("system", "start", "u", "d"),
    [
        (
            Blimp(),
            [0.0, 0.1, -0.1, 0.3, 0.5, 0.2, -0.3, 0.7],
            [0.05, -0.02, 0.001],
            [0.1, -0.2, 0.15],
        ),
        (
            QuadrotorPlant(),
            [0.0, 0.1, -0.1, 0.2, -0.1, 0.3, 0.5, 0.2, -0.3, 0.1, 0.2, -0.1],
            [1.0, 1.2, 1.1, 1.3],
            [],
        ),
    ],
)
def test_rows_are_derivatives(system, start, u, d) -> None:
    normal = np.array([1.0, -2.0, 2.0]) / 3.0

    def h(x, t):
        return normal @ x[:3] + 1.0 - 0.1

    barrier = HalfSpace([1.0, -2.0, 2.0], -3.0, margin=0.1).barrier(
        K, position=(0, 1, 2)
    )
    assert_rows_are_derivatives(system, barrier, h, start, u, d)


def test_the_position_may_be_any_states(car) -> None:
    barrier = HalfSpace([1.0, 0.0]).barrier(K, position=(1, 0))
    assert BarrierSet(car, [barrier]).values(np.arange(4.0), 0.0) == [1.0]
    for position in [(0,), (0, 1, 2), (1, 1)]:
        with pytest.raises(ValueError, match="'half-space': position must name 2"):
            HalfSpace([1.0, 0.0]).barrier(K, position)


def test_another_number_of_gains_is_refused(car) -> None:
    for gains in ([1.0], [3.0, 3.0, 1.0]):
        with pytest.raises(ModelError, match="relative degree is 2"):
            BarrierSet(car, [HalfSpace([1.0, 0.0]).barrier(gains)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0],), "normal must have 2 or 3 numbers, not all 0"),
        (([0.0, 0.0],), "normal must have 2 or 3 numbers, not all 0"),
        (([1.0, np.nan],), r"normal: .*finite numbers"),
        (([1.0, 0.0], np.inf), r"offset: .*finite numbers"),
        (([1.0, 0.0], 0.0, -1.0), "margin: -1"),
    ],
)
def test_bad_half_spaces_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"^half-space: {message}"):
        HalfSpace(*arguments)
