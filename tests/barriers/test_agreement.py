"""Barriers whose symbols have other values than the function that was written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import if_then_else, max as symbolic_max, sqrt as symbolic_sqrt
from pydrake.systems.primitives import LinearSystem
import pytest

from vcbf_drake.barriers import Barrier, BarrierSet, HalfSpace, StateInputLimit
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel, point_position

GAINS = [3.0, 2.0]
URDF = Path(__file__).parents[2] / "examples" / "models" / "planar_arm.urdf"


@pytest.fixture(scope="module")
def model() -> ControlAffineModel:
    """A double integrator."""
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    return ControlAffineModel.from_system(LinearSystem(A, B, np.eye(2)))


def value(model, barrier, x):
    return BarrierSet(model, [barrier]).values(np.array(x), 0.0)[0]


@pytest.mark.parametrize(
    ("function", "right"),
    [
        (lambda x, t, p: ((x[0] - p[0]) ** 2) ** 0.5 - 1.0, 2.5),
        (lambda x, t, p: ((x[0] - p[0]) ** 4) ** 0.25 - 1.0, 2.5),
        (lambda x, t, p: ((x[0] - p[0]) * (x[0] - p[0])) ** 1.5, 42.875),
        (lambda x, t, p: ((x[0] - p[0]) ** 2) ** -0.5, 1.0 / 3.5),
        (lambda x, t, p: (((x[0] - p[0]) / p[1]) ** 2) ** 0.5, 1.75),
        (lambda x, t, p: ((x[0] - p[0]) ** 2) ** 0.25, 3.5**0.5),
        (lambda x, t, p: np.power(np.square(x[0] - p[0]), 0.5), 3.5),
        (lambda x, t, p: ((x[0] - t) ** 2) ** 0.5, 3.0),
        (lambda x, t, p: (x[0] ** -2) ** -0.5, 3.0),
        (lambda x, t, p: x[0] + (p[1] ** 2) ** 0.5, -1.0),
    ],
)
def test_a_barrier_that_its_symbols_misread_is_refused(model, function, right):
    barrier = Barrier(function, GAINS, parameters=[0.5, -2.0], name="post")
    at = function(np.array([-3.0, 0.0]), 0.0, barrier.parameters)
    assert np.isclose(at, right)
    expected = r"barrier 'post': function\(x, t, p\) is .* at x = \["
    with pytest.raises(ModelError, match=expected) as error:
        BarrierSet(model, [barrier])
    assert "makes of its symbols is" in str(error.value)
    assert "write (e**2 + c**2)**0.5" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("function", "right"),
    [
        (lambda x, t, p: ((x[0] - p[0]) ** 2 + 0.01) ** 0.5, 12.26**0.5),
        (lambda x, t, p: (4.0 * (x[0] - p[0]) ** 2) ** 0.5, 7.0),
        (lambda x, t, p: symbolic_sqrt((x[0] - p[0]) ** 2 + 0.01), 12.26**0.5),
        (lambda x, t, p: x[0] - symbolic_max(p[0], p[1]), -3.5),
        (lambda x, t, p: x[0] - if_then_else(p[1] > 0.0, p[0], p[1]), -1.0),
        (lambda x, t, p: (x[0] - p[0]).sin(), np.sin(-3.5)),  # Of expressions only.
        (lambda x, t, p: 1.0 / (1.0 + np.exp(-x[0])), 1.0 / (1.0 + np.exp(3.0))),
        (lambda x, t, p: (1e4 - x[0] ** 2) ** 0.5, (1e4 - 9.0) ** 0.5),
        (lambda x, t, p: x[0] + (p[0] * p[0]) ** 0.5, -2.5),  # p[0] > 0
        (lambda x, t, p: (x[0] - p[0]) / (x[0] - p[0]) * x[0], -3.0),  # 0 / 0 there
    ],
)
def test_what_is_read_rightly_passes(model, function, right):
    barrier = Barrier(function, GAINS, parameters=[0.5, -2.0])
    assert np.isclose(value(model, barrier, [-3.0, 0.0]), right)


def test_every_barrier_of_a_formula_is_compared(model):
    def offset(x, t, p):
        return x[0] + (p[0] ** 2) ** 0.5

    good, bad = (Barrier(offset, GAINS, [number]) for number in (2.0, -2.0))
    BarrierSet(model, [good, good])
    with pytest.raises(ModelError, match="makes of its symbols"):
        BarrierSet(model, [good, bad])


def test_a_formula_read_rightly_does_not_vouch_for_another_that_reads_the_same(model):
    straight = Barrier(lambda x, t, p: x[0] - p[0], GAINS, [1.0])
    folded = Barrier(lambda x, t, p: ((x[0] - p[0]) ** 2) ** 0.5, GAINS, [1.0])
    BarrierSet(model, [straight])
    with pytest.raises(ModelError, match="makes of its symbols"):
        BarrierSet(model, [straight, folded])


def test_rounding_far_from_the_origin_is_no_difference(model):
    """As in coordinates of a map: metres, millions of them."""

    def squared(x, t, p):
        return x[0] * x[0] - 2.0 * p[0] * x[0] + p[0] * p[0] - 0.25

    BarrierSet(model, [Barrier(squared, GAINS, [5.3e6])])


def test_a_limit_that_its_symbols_misread_is_refused(model):
    def slower_when_far(x, t, p):
        return np.array([1.0]), (x[0] ** 2) ** 0.5

    limit = StateInputLimit(slower_when_far, name="brake")
    with pytest.raises(ModelError, match="limit 'brake': function"):
        BarrierSet(model, [limit])


def test_a_barrier_whose_values_are_hardly_anywhere_is_said_not_to_be_compared(model):
    barrier = Barrier(lambda x, t, p: (x[0] - 1e9) ** 0.5, GAINS)
    with pytest.warns(UserWarning, match=r"finite at 0 of \d+ points only"):
        BarrierSet(model, [barrier])


def test_a_barrier_that_is_another_at_each_call_is_refused(model):
    """A draw of [0, 1) is hidden in the rounding that draws of another one show."""
    random, calls = np.random.default_rng(0), []

    def counted(x, t, p):
        calls.append(x)
        return x[0] + len(calls)

    for function in (lambda x, t, p: x[0] + random.random(), counted):
        with pytest.raises(ModelError, match=r"'post': .* must depend on its arg"):
            BarrierSet(model, [Barrier(function, GAINS, name="post")])


def test_a_point_of_an_arm_is_compared_by_its_kinematics_in_numbers():
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(URDF)
    plant.Finalize()
    model = ControlAffineModel.from_system(plant, "actuation")
    hand = point_position(plant, "forearm", [0.5, 0.0, 0.0], axes=[0, 2])

    def folded(x):
        return (hand(x) ** 2) ** 0.5

    floor = HalfSpace([0.0, 1.0], -0.5)
    BarrierSet(model, [floor.barrier(GAINS, position=hand)])
    with pytest.raises(ModelError, match="makes of its symbols"):
        BarrierSet(model, [floor.barrier(GAINS, position=folded)])


def test_a_formula_without_a_value_at_one_place_is_no_other_formula(model):
    """A logarithm of 0: NumPy goes on to exp(-inf), plain Python does not."""
    formula = lambda x, t, p: np.exp(0.5 * np.log(x[0] ** 2)) - 1.0  # noqa: E731
    barrier = Barrier(formula, GAINS)
    rows = BarrierSet(model, [barrier]).rows
    state = np.zeros(model.num_states)
    assert np.isnan(rows(state, 0.0).value[0])
    state[0] = -3.0
    assert rows(state, 0.0).value[0] == pytest.approx(2.0)
