"""Rows along a backup law's flow, against closed forms and another integrator.

The double integrator x1'' = u with |u| <= 1, h = -x1 and the law u_b = -1 is the
standard example of backup barriers: its flow is x1 + x2 tau - tau^2 / 2, and the set
that the law keeps is x1 + max(x2, 0)^2 / 2 <= 0.
"""

import numpy as np
from pydrake.math import tanh
import pytest
from scipy.integrate import solve_ivp

from tests.helpers.braking_integrator import FullBrake, braking_integrator
from vcbf_drake.barriers import Barrier, BarrierSet, SphereObstacle, ackermann_limit
from vcbf_drake.barriers.backup_rows import BackupRows
from vcbf_drake.errors import ModelError, VcbfError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car, CarParameters
from vcbf_drake.safety import (
    DisturbanceKnowledge,
    FilterSettings,
    FilterStatus,
    InputSet,
    SafetyFilter,
    disturbance_margin,
)

ALPHA, HORIZON = 2.0, 3.0


@pytest.fixture(scope="module")
def integrator():
    return braking_integrator(HORIZON)


def wall():
    # alpha is the largest decay rate.
    return Barrier(lambda x, t, p: -x[0], [ALPHA + 1.0, ALPHA], name="wall")


def filter_of(model, barriers, margin=0.0, limits=1.0, **settings):
    m = model.num_inputs
    return SafetyFilter(
        model,
        barriers,
        InputSet.box([-limits] * m, [limits] * m),
        FilterSettings(method="backup", backup_margin=margin, **settings),
    )


def decide(safety_filter, x, reference):
    context = safety_filter.CreateDefaultContext()
    q = safety_filter.model.num_disturbances
    values = {"state": x, "reference": reference, "estimate": np.zeros(2 * q + 4)}
    for name, value in values.items():
        safety_filter.GetInputPort(name).FixValue(context, value)
    return safety_filter.decision(context)


@pytest.mark.parametrize("x", [[-3.0, 1.0], [-0.4, 0.2], [-1.0, -0.5]])
def test_rows_of_the_double_integrator_in_closed_form(integrator, x):
    barriers = [wall()]
    barrier_set, x = BarrierSet(integrator, barriers), np.array(x)
    rows = BackupRows(integrator, barriers, barrier_set, [FullBrake(HORIZON)], 0.3)
    found = rows.rows(x, 0.0, barrier_set.rows(x, 0.0), None)
    tau = np.linspace(0.0, HORIZON, len(found.b) + 1)[1:]
    height = -(x[0] + x[1] * tau - 0.5 * tau**2)
    np.testing.assert_allclose(found.value, height, atol=1e-12)
    # tau u <= -x2 + alpha (h - margin)
    np.testing.assert_allclose(found.A[:, 0], tau, atol=1e-12)
    np.testing.assert_allclose(found.b, -x[1] + ALPHA * (height - 0.3), atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_input_of_the_double_integrator_in_closed_form(integrator, seed):
    rng, safety_filter = np.random.default_rng(seed), filter_of(integrator, [wall()])
    for _ in range(20):
        v = rng.uniform(-1.0, 1.5)
        x = np.array([-0.5 * max(v, 0.0) ** 2 - rng.uniform(0.13, 1.0), v])
        tau = np.linspace(0.0, HORIZON, 61)[1:]
        height = -(x[0] + x[1] * tau - 0.5 * tau**2)
        most = np.min((-x[1] + ALPHA * height) / tau)
        reference = rng.uniform(-1.0, 1.0)
        decision = decide(safety_filter, x, [reference])
        assert decision.status < FilterStatus.INFEASIBLE
        assert decision.input[0] == pytest.approx(min(reference, most), abs=1e-7)


def test_the_double_integrator_comes_to_rest_at_its_wall(integrator):
    """A reference that never brakes: the QP brakes for it, never too late."""
    safety_filter = filter_of(integrator, [wall()], margin=0.01)
    x, T, fastest = np.array([-2.0, 0.0]), 0.01, 0.0
    for _ in range(1200):
        decision = decide(safety_filter, x, [1.0])
        assert decision.status < FilterStatus.INFEASIBLE
        (u,) = decision.input
        x = x + T * np.array([x[1] + 0.5 * T * u, u])
        fastest = max(fastest, x[1])
        assert x[0] + 0.5 * max(x[1], 0.0) ** 2 < 0.0
    assert fastest > 1.0 and abs(x[1]) < 1e-3
    # At rest the row of the first tau asks u <= alpha (h - margin + tau^2 / 2) / tau.
    assert x[0] == pytest.approx(-(0.01 - 0.5 * 0.05**2), abs=1e-5)


def test_the_disturbance_enters_through_the_flow():
    car = ControlAffineModel.from_system(Car())
    x, delta = np.array([0.0, 0.0, 0.6, 0.0]), 0.1
    limits = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    manoeuvres = car.make_manoeuvres(*limits, delta, 0.02)
    disc = SphereObstacle((3.0, 0.1), 0.4).barrier([4.0, 3.0])
    barrier_set = BarrierSet(car, [disc])
    rows = BackupRows(car, [disc], barrier_set, manoeuvres, 0.0)
    found = rows.rows(x, 0.0, barrier_set.rows(x, 0.0), None)
    # d and the force over the mass enter alike.
    np.testing.assert_allclose(found.w[:, 0], -found.A[:, 0] * 2.0, atol=1e-12)
    known = DisturbanceKnowledge(np.array([0.05]), np.zeros(1), 0.02, 0.0, 0.0)
    worst = np.minimum(0.03 * found.w[:, 0], 0.07 * found.w[:, 0])
    np.testing.assert_allclose(disturbance_margin(found, known), worst, atol=1e-12)


@pytest.mark.parametrize("speed", [0.7, 0.0, -0.3])
def test_flow_and_sensitivity_of_the_car_by_another_integrator(speed):
    mass, delta, limit = 2.0, 0.1, 1.0
    car = ControlAffineModel.from_system(Car(CarParameters(mass)))
    bounds = np.array([-limit, -1.0]), np.array([limit, 1.0])
    manoeuvres = car.make_manoeuvres(*bounds, delta, 0.02)
    center, radius = np.array([2.0, 0.3]), 0.5
    disc = SphereObstacle(tuple(center), radius).barrier([4.0, 3.0])
    barrier_set = BarrierSet(car, [disc])
    rows = BackupRows(car, [disc], barrier_set, manoeuvres, 0.0)

    def braked(x, until):
        def rate(_, x):
            weakest = limit / mass - delta
            v = x[2]
            return [
                v * np.cos(x[3]),
                v * np.sin(x[3]),
                -weakest * float(tanh(v / 0.1)),
                0.0,
            ]

        found = solve_ivp(rate, (0.0, 6.0), x, t_eval=until, rtol=1e-10, atol=1e-12)
        return found.y.T

    def heights(x, until):
        return np.linalg.norm(braked(x, until)[:, :2] - center, axis=1) - radius

    x, tau = np.array([0.2, -0.1, speed, 0.25]), np.linspace(0.0, 6.0, 61)[1:]
    found = rows.rows(x, 0.0, barrier_set.rows(x, 0.0), None)
    np.testing.assert_allclose(found.value, heights(x, tau), atol=2e-4)
    step, slopes = 1e-5, []
    for i in range(4):
        unit = step * np.eye(4)[i]
        slopes.append((heights(x + unit, tau) - heights(x - unit, tau)) / (2.0 * step))
    slopes = np.array(slopes).T
    g = np.array([[0, 0], [0, 0], [1 / mass, 0], [0, 1]])
    np.testing.assert_allclose(found.A, -slopes @ g, atol=3e-3)
    f = np.array([x[2] * np.cos(x[3]), x[2] * np.sin(x[3]), 0.0, 0.0])
    alpha = 3.0  # Of s^2 + 4 s + 3.
    expected = slopes @ f + alpha * heights(x, tau)
    np.testing.assert_allclose(found.b, expected, atol=3e-3)


def test_limits_of_the_input_are_rows_as_ever():
    car = ControlAffineModel.from_system(Car())
    disc = SphereObstacle((3.0, 0.1), 0.4).barrier([4.0, 3.0])
    barriers = [disc, *ackermann_limit(2.0, 0.1)]
    safety_filter = filter_of(car, barriers)
    x = np.array([0.0, 0.0, 0.2, 0.0])
    decision = decide(safety_filter, x, [0.0, 1.0])
    assert decision.status == FilterStatus.FILTERED
    assert decision.input[1] == pytest.approx(2.0 * np.hypot(0.2, 0.1))


def test_what_is_refused():
    model = ControlAffineModel.from_system(Car())
    disc = SphereObstacle((3.0, 0.1), 0.4).barrier([4.0, 3.0])
    with pytest.raises(VcbfError, match="infeasible: 'decay'"):
        filter_of(model, [disc], infeasible="decay")
    with pytest.raises(VcbfError, match="between_ticks: 'certified'"):
        filter_of(model, [disc], between_ticks="certified")
    model.make_manoeuvres = None
    with pytest.raises(ModelError, match="no backup manoeuvre"):
        filter_of(model, [disc])
