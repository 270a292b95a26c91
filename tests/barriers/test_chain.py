"""Derivatives of barriers, against differences along simulated trajectories."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
from numpy.testing import assert_allclose
from pydrake.examples import QuadrotorPlant
from pydrake.symbolic import Expression, MakeVectorVariable, Variable
import pytest

from tests.helpers.row_gradients import row_gradients
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake.barriers import Barrier, BarrierSet, SphereObstacle
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car


def integrator(
    length: int, disturbed: int, input_state: int | None = None
) -> ControlAffineModel:
    """A chain of integrators; the disturbance acts on one of its states."""
    state = MakeVectorVariable(length, "x")
    drift = np.array([*(1.0 * x for x in state[1:]), Expression(0.0)])
    inputs = np.full((length, 1), Expression(0.0))
    inputs[length - 1 if input_state is None else input_state] = Expression(1.0)
    disturbance = np.zeros((length, 1))
    disturbance[disturbed] = 1.0
    names = ["position", "velocity", "acceleration", "jerk"][:length]
    return ControlAffineModel(state, drift, inputs, disturbance, names, "integrators")


# Plants, each with a state, an input and a disturbance.
BLIMP = (
    Blimp(),
    [0.0, 0.1, -0.1, 0.3, 0.5, 0.2, -0.3, 0.7],
    [0.05, -0.02, 0.001],
    [0.1, -0.2, 0.15],
)
CAR = Car(), [0.0, 0.1, 0.8, 0.3], [0.4, -0.6], [0.3]
# Drake's own plant, as any user's would be.
QUADROTOR = (
    QuadrotorPlant(),
    [0.0, 0.1, -0.1, 0.2, -0.1, 0.3, 0.5, 0.2, -0.3, 0.1, 0.2, -0.1],
    [1.0, 1.2, 1.1, 1.3],
    [],
)
BALL = SphereObstacle([1.0, 0.5, 0.2], 0.3)


def slower(state: int) -> Barrier:
    """A limit of a speed that shrinks with time, of relative degree 1."""
    return Barrier(lambda x, t, p: p[0] * np.exp(-t) - x[state] ** 2, (1.0,), (9.0,))


@pytest.mark.parametrize(
    ("flight", "barrier"),
    [
        (BLIMP, BALL.barrier((3.0, 2.0))),
        (
            BLIMP,
            SphereObstacle([1.0, 0.5, 0.2], 0.3, [-0.3, 0.2, 0.1]).barrier((3.0, 2.0)),
        ),
        (
            BLIMP,
            SphereObstacle([2.0, 0.5, 0.2], 0.3, [-0.3, 0, 0], 0.0, "squared").barrier(
                (5.0, 4)
            ),
        ),
        (BLIMP, slower(4)),
        (CAR, SphereObstacle([2.0, 0.5], 0.3, form="squared").barrier((3.0, 2.0))),
        (CAR, SphereObstacle([2.0, 0.5], 0.3, [0.1, -0.4]).barrier((3.0, 2.0))),
        (CAR, slower(2)),
        (QUADROTOR, BALL.barrier((3.0, 2.0), [0, 1, 2])),
        (QUADROTOR, slower(8)),
    ],
)
def test_rows_are_derivatives_along_a_trajectory(flight, barrier) -> None:
    barriers = BarrierSet(ControlAffineModel.from_system(flight[0]), [barrier])

    def h(x, t):
        return barriers.values(x, t)[0]

    assert_rows_are_derivatives(flight[0], barrier, h, *flight[1:])


def test_relative_degree_one() -> None:
    model = integrator(2, disturbed=1)
    barrier = Barrier(lambda x, t, p: p[0] - x[1] ** 2 + 0.5 * t, [2.0], [4.0])
    rows = BarrierSet(model, [barrier]).rows(np.array([7.0, 1.5]), 3.0)
    h = 4.0 - 1.5**2 + 1.5
    assert_allclose(rows.A, [[3.0]])
    assert_allclose(rows.b, [2.0 * h + 0.5])
    assert_allclose(rows.w, [[-3.0]])
    assert_allclose(rows.chain[0], [h])


def test_relative_degree_three() -> None:
    model = integrator(3, disturbed=2)
    barrier = Barrier(lambda x, t, p: x[0] - p[0], (6.0, 11.0, 6.0), [1.0])
    square = Barrier(lambda x, t, p: x[0] ** 2, (9.0, 26.0, 24.0))
    x0, x1, x2 = 2.0, -0.7, 0.4
    rows = BarrierSet(model, [barrier, square]).rows(np.array([x0, x1, x2]), 0.0)
    h = x0 - 1.0
    assert_allclose(rows.A, [[-1.0], [-2 * x0]])
    assert_allclose(rows.w, [[1.0], [2 * x0]])
    dh, ddh = 2 * x0 * x1, 2 * x1**2 + 2 * x0 * x2
    expected = 9.0 * ddh + 26.0 * dh + 24.0 * x0**2 + 6 * x1 * x2
    assert_allclose(rows.b, [6.0 * x2 + 11.0 * x1 + 6.0 * h, expected])
    # s^3 + 6 s^2 + 11 s + 6 has the roots -3, -2, -1.
    assert_allclose(rows.chain[0], [h, x1 + 3 * h, x2 + 5 * x1 + 6 * h])
    assert_allclose(rows.chain[1], [x0**2, dh + 4 * x0**2, ddh + 7 * dh + 12 * x0**2])
    assert_allclose(row_gradients(rows).b[0], [6.0, 11.0, 6.0, 0.0])


def test_a_model_without_disturbance_has_no_w() -> None:
    state = MakeVectorVariable(2, "x")
    model = ControlAffineModel(
        state,
        np.array([1.0 * state[1], Expression(0.0)]),
        np.array([[Expression(0.0)], [Expression(1.0)]]),
        np.zeros((2, 0)),
    )
    rows = BarrierSet(model, [Barrier(lambda x, t, p: x[0], (3.0, 2.0))]).rows(
        np.ones(2), 0.0
    )
    assert rows.w.shape == (1, 0)
    assert row_gradients(rows).w.shape == (1, 0, 3)
    assert_allclose(rows.b, [5.0])


def test_states_of_the_same_name_are_told_apart() -> None:
    state = np.array([Variable("x"), Variable("x")])
    stands, moves = Expression(0.0), Expression(1.0)
    model = ControlAffineModel(
        state,
        np.array([stands, stands]),
        np.array([[moves, stands], [stands, moves]]),
        np.zeros((2, 0)),
    )
    for i in range(2):
        barrier = Barrier(lambda x, t, p, i=i: x[i], [1.0])
        values = BarrierSet(model, [barrier]).values(np.array([3.0, 4.0]), 0.0)
        assert values == [3.0 + i]


@pytest.mark.parametrize(
    ("model", "function", "gains", "message"),
    [
        (
            integrator(2, disturbed=1),
            lambda x, t, p: x[1],
            (3.0, 2.0),
            "input 0 enters derivative 1 of h, so its relative degree is 1, not 2:"
            " give 1 gain$",
        ),
        (
            integrator(3, disturbed=2),
            lambda x, t, p: x[0],
            (3.0, 2.0),
            "no input enters derivative 2 of h, its relative degree is 3: give 3 gains",
        ),
        (
            integrator(3, disturbed=2, input_state=0),
            lambda x, t, p: x[2] + t,
            (1.0,),
            "no input enters a derivative of h up to order 3: .* inputs of integrators",
        ),
        (
            integrator(2, disturbed=0),
            lambda x, t, p: x[0],
            (3.0, 2.0),
            r"disturbance 0 \(on position\) enters derivative 1 of h, but the inputs"
            r" enter none before 2, .*\(R2\): leave that disturbance out",
        ),
        (
            integrator(1, disturbed=0),
            lambda x, t, p: 1.0,
            (1.0,),
            "no input enters a derivative of h up to order 1",
        ),
        (
            integrator(1, disturbed=0),
            lambda x, t, p: np.array([x[0], x[0]]),
            (1.0,),
            r"function\(x, t, p\) must return one scalar expression, got shape \(2,\)",
        ),
        (
            integrator(1, disturbed=0),
            lambda x, t, p: x[0] > 0,
            (1.0,),
            r"function\(x, t, p\) must return symbolic expressions or numbers",
        ),
        (
            integrator(1, disturbed=0),
            lambda x, t, p: x[0] if x[0] > 0 else -x[0],
            (1.0,),
            r"function\(x, t, p\) fails on symbols",
        ),
        (
            integrator(1, disturbed=0),
            lambda x, t, p: x[0] - p[0],
            (1.0,),
            r"function\(x, t, p\) fails on symbols: index 0 is out of bounds",
        ),
        (
            integrator(1, disturbed=0),
            lambda x, t, p: x[0] * MakeVectorVariable(1, "q")[0],
            (1.0,),
            r"function\(x, t, p\) cannot be compiled: .*q\(0\)",
        ),
    ],
)
def test_barriers_that_do_not_suit_the_model_are_refused(
    model, function, gains, message
) -> None:
    with pytest.raises(ModelError, match=f"^barrier 'wall': {message}"):
        BarrierSet(model, [Barrier(function, gains, name="wall")])


def test_the_relative_degree_is_that_of_the_parameters_given() -> None:
    model = ControlAffineModel.from_system(Car())

    def wall(x, t, p):
        return p[:2] @ x[:2] + p[2] * x[2] - p[3]

    BarrierSet(model, [Barrier(wall, (3.0, 2.0), [1.0, 0.0, 0.0, 1.0])])
    with pytest.raises(ModelError, match="relative degree is 1, not 2"):
        BarrierSet(model, [Barrier(wall, (3.0, 2.0), [1.0, 0.0, 0.5, 1.0])])


def test_terms_that_cancel_only_numerically_count_as_zero() -> None:
    model = ControlAffineModel.from_system(Car())

    def height(x, t, p):
        speed = x[2] * (np.sin(x[0]) ** 2 + np.cos(x[0]) ** 2 - 1.0)
        return x[0] - 1.0 + speed

    rows = BarrierSet(model, [Barrier(height, (3.0, 2.0))]).rows(np.ones(4), 0.0)
    assert_allclose(rows.w, [[np.cos(1.0)]])


def test_barriers_are_accepted_where_few_states_are_in_their_domain() -> None:
    model = integrator(1, disturbed=0)
    barrier = Barrier(lambda x, t, p: np.log(x[0] - 1e6), (1.0,))
    with pytest.warns(UserWarning, match=r"finite at \d of"):
        barriers = BarrierSet(model, [barrier])
    assert np.isnan(barriers.values(np.zeros(1), 0.0)[0])


PROGRAM = """
import numpy as np
from vcbf_drake.barriers import BarrierSet, SphereObstacle, ackermann_limit
from vcbf_drake.plants import Blimp, Car
from vcbf_drake.model import ControlAffineModel

def show(model, barriers):
    generator = np.random.default_rng(0)
    barriers = BarrierSet(model, barriers)
    for _ in range(5):
        rows = barriers.rows(generator.normal(size=model.num_states), 0.7)
        slopes = rows.gradients(range(len(rows.b)))
        for each in (rows.value, rows.A, rows.b, rows.w, slopes):
            print(each.tobytes().hex())
        print(*(chain.tobytes().hex() for chain in rows.chain))

moving = SphereObstacle([0.5, 0, 0.3], 0.2, [0.1, -0.3, 0.2]).barrier((10.0, 3.55))
show(ControlAffineModel.from_system(Blimp()), [moving])
disc = SphereObstacle([2.0, 0.3], 0.4, form="squared").barrier((4.0, 3.0))
show(ControlAffineModel.from_system(Car()), [disc, *ackermann_limit(2.0, 0.1)])
"""


def test_numbers_are_the_same_bits_in_every_process() -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            env={**os.environ, "PYTHONHASHSEED": seed},
            stdout=subprocess.PIPE,
            text=True,
        )
        for seed in ("0", "1", "4242")
    ]
    outputs = [process.communicate()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0]
    assert len(outputs[0].splitlines()) == 60
    assert outputs[0] == outputs[1] == outputs[2]
