"""Two robots that keep a distance, against plain geometry."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.testing import assert_allclose
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, Multiplexer
import pytest

from tests.helpers.paired_cars import paired_cars
from tests.helpers.row_gradients import row_gradients
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import BarrierSet, PairDistance
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car

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
    assert np.isfinite(row_gradients(rows).A).all()


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


def test_pairs_among_many_have_the_rows_of_two_alone():
    """Of many cars in one plant, each pair's numbers are its own."""
    many, count = fleet(5), 5
    two = ControlAffineModel.from_system(fleet(2))
    model = ControlAffineModel.from_system(many)
    pairs = list(itertools.combinations(range(count), 2))
    barriers = BarrierSet(
        model,
        [
            PairDistance(0.5).barrier(
                [4.0, 3.0], (4 * i, 4 * i + 1), (4 * j, 4 * j + 1)
            )
            for i, j in pairs
        ],
    )
    alone = BarrierSet(two, [PairDistance(0.5).barrier([4.0, 3.0], (0, 1), (4, 5))])
    x = np.random.default_rng(1).normal(size=4 * count)
    rows = barriers.rows(x, 0.0)
    for row, (i, j) in enumerate(pairs):
        states = [4 * car + k for car in (i, j) for k in range(4)]
        inputs = [2 * car + k for car in (i, j) for k in range(2)]
        expected = alone.rows(x[states], 0.0)
        A, w = np.zeros(2 * count), np.zeros(count)
        A[inputs], w[[i, j]] = expected.A[0], expected.w[0]
        assert_allclose(rows.A[row], A, atol=1e-12)
        assert_allclose(rows.w[row], w, atol=1e-12)
        assert_allclose(rows.b[row], expected.b[0])
        assert_allclose(rows.chain[row], expected.chain[0])
        slopes = np.zeros((len(A) + 1 + count, 4 * count + 1))
        entries = [*inputs, len(A), *(len(A) + 1 + car for car in (i, j))]
        slopes[np.ix_(entries, [*states, 4 * count])] = expected.gradients([0])[0]
        assert_allclose(rows.gradients([row])[0], slopes, atol=1e-11)


def fleet(count):
    """Cars in one diagram: their states, inputs and disturbances one by one."""
    builder = DiagramBuilder()
    states = builder.AddSystem(Multiplexer([4] * count))
    inputs = builder.AddSystem(Demultiplexer(2 * count, 2))
    gusts = builder.AddSystem(Demultiplexer(count, 1))
    for i in range(count):
        car = builder.AddNamedSystem(f"car{i}", Car())
        builder.Connect(car.GetOutputPort("state"), states.get_input_port(i))
        builder.Connect(inputs.get_output_port(i), car.GetInputPort("input"))
        builder.Connect(gusts.get_output_port(i), car.GetInputPort("disturbance"))
    builder.ExportInput(inputs.get_input_port(0), "input")
    builder.ExportInput(gusts.get_input_port(0), "disturbance")
    builder.ExportOutput(states.get_output_port(0), "state")
    return builder.Build()
