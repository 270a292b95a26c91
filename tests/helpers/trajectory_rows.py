"""Rows of one barrier against differences of h along a simulated trajectory."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
import pytest

from tests.helpers.row_gradients import row_gradients
from vcbf_drake.barriers import BarrierSet
from vcbf_drake.model import ControlAffineModel

STEP = 0.004  # Between the samples of a trajectory. In seconds.
# Central differences of order four: the weights at -2, -1, 0, 1, 2 steps.
DIFFERENCES = (
    np.array([0, 0, 1, 0, 0]),
    np.array([1, -8, 0, 8, -1]) / (12 * STEP),
    np.array([-1, 16, -30, 16, -1]) / (12 * STEP**2),
)


def assert_rows_are_derivatives(
    system, barrier, h, start, u, d=(), input_port=0
) -> None:
    """Checks h, the row and its gradients under a constant input and disturbance.

    `h(x, t)` is the closed form in plain NumPy, `input_port` the input's name or index.
    """
    model = ControlAffineModel.from_system(system, input_port)
    barriers = BarrierSet(model, [barrier])
    simulator = Simulator(system)
    ResetIntegratorFromFlags(simulator, "runge_kutta5", 1e-3)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    context = simulator.get_mutable_context()
    context.SetContinuousState(start)
    (
        system.GetInputPort(input_port)
        if isinstance(input_port, str)
        else system.get_input_port(input_port)
    ).FixValue(context, u)
    if len(d):
        system.GetInputPort("disturbance").FixValue(context, d)
    times, states = STEP * np.arange(45), []
    for t in times:
        simulator.AdvanceTo(t)
        states.append(context.get_continuous_state_vector().CopyToVector())
    expected = np.array([h(x, t) for x, t in zip(states, times, strict=True)])
    assert_allclose(barriers.values_along(np.array(states), times)[:, 0], expected)
    for i in range(2, 43, 10):
        rows = barriers.rows(states[i], times[i])
        eta = [each @ expected[i - 2 : i + 3] for each in DIFFERENCES]
        derivatives = eta[barrier.relative_degree :: -1]
        slack = rows.b[0] - rows.A[0] @ u + rows.w[0] @ np.asarray(d, dtype=float)
        right = np.dot([1.0, *barrier.gains], derivatives)
        assert slack == pytest.approx(right, rel=1e-6, abs=1e-6)
        levels = [eta[0]]
        if barrier.relative_degree == 2:
            levels.append(eta[1] + barrier.decay_rates[0] * eta[0])
        assert_allclose(rows.chain[0], levels, rtol=1e-6, atol=1e-6)
    _assert_gradients_are_differences(barriers, np.append(states[7], times[7]))


def _assert_gradients_are_differences(barriers, xbar, step=1e-5) -> None:
    rows = barriers.rows(xbar[:-1], xbar[-1])
    for i, direction in enumerate(np.eye(len(xbar))):
        ahead, behind = xbar + step * direction, xbar - step * direction
        ahead = barriers.rows(ahead[:-1], ahead[-1])
        behind = barriers.rows(behind[:-1], behind[-1])
        for name in ("A", "b", "w"):
            difference = (getattr(ahead, name) - getattr(behind, name)) / (2 * step)
            gradient = getattr(row_gradients(rows), name)[..., i]
            assert_allclose(gradient, difference, rtol=1e-5, atol=1e-6)
