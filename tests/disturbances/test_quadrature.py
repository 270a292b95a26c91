"""Means of f + g u from a few points, on plants that are fast for their period."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.observer_runs import Bench, DragModel, rise, run
from vcbf_drake.disturbances import (
    Constant,
    DisturbanceSource,
    LinearDisturbanceObserver,
    RiseGains,
    RiseObserver,
    Sinusoid,
)

OBSERVERS = pytest.mark.parametrize("kind", [RiseObserver, LinearDisturbanceObserver])


def settled_errors(kind, drag: float, period: float, signal) -> tuple:
    """Errors and bounds of v' = -drag v + u + d, u anew at each tick, solved exactly.

    d is taken as linear in time between 64 points an interval.
    """
    d = DisturbanceSource([signal], 20.0)
    model = DragModel(1, linear=drag, cubic=0.0)
    observer = kind(model, period, d.bounds)
    bench, generator, v = Bench(observer), np.random.default_rng(2), 0.0
    h = period / 64
    decay, weight = np.exp(-drag * h), -np.expm1(-drag * h) / drag
    errors, bounds, quadrature = [], [], []
    for k in range(200):
        t = k * period
        bench.measure(t, np.array([0.0, v]))
        errors.append(abs(d.value(t)[0] - bench.output("disturbance_estimate")[0]))
        bounds.append(bench.estimate().error_bound)
        quadrature.append(bench.estimate().quadrature_error)
        bench.update()
        u = generator.uniform(-1.0, 1.0)
        bench.hold(np.array([u]))
        for i in range(64):
            a, b = d.value(t + i * h)[0], d.value(t + (i + 1) * h)[0]
            ramp = (h - weight) / drag * (b - a) / h
            v = decay * v + weight * (1.3 * u + a) + ramp
    assert bench.estimate().refused_intervals == 0.0
    return np.array(errors), np.array(bounds), np.array(quadrature), observer


@OBSERVERS
@pytest.mark.parametrize(
    ("drag", "period"), [(0.4, 0.02), (5.0, 0.02), (20.0, 0.02), (10.0, 0.1)]
)
@pytest.mark.parametrize(
    "signal", [Constant([0.4]), Sinusoid([0.4], frequency=1.5)], ids=["still", "gusts"]
)
def test_a_fast_plant_s_error_is_under_its_bound(kind, drag, period, signal) -> None:
    errors, bounds, quadrature, _ = settled_errors(kind, drag, period, signal)
    assert np.all(errors <= bounds)
    assert np.all(np.diff(quadrature) >= 0.0)


def test_without_its_quadrature_term_the_bound_is_broken() -> None:
    """With a still wind, drag times period 2, it was over by 2e-2 for |d| = 0.4."""
    errors, bounds, quadrature, observer = settled_errors(
        RiseObserver, 20.0, 0.1, Constant([0.4])
    )
    naive = [observer.error_bound(0.1 * k) for k in range(200)]
    over = np.max(errors - naive)
    assert over > 0.02
    assert np.all(errors <= bounds)
    assert quadrature[-1] < 20.0 * over


def test_a_quadrature_error_is_a_disturbance_with_larger_bounds() -> None:
    """(E42): delta2 + 2 Q / T and delta3 + 4 Q / T^2 are what the gains must suit."""
    d = DisturbanceSource([Sinusoid([0.4], frequency=1.5)], 20.0)
    gains, period, Q = RiseGains(5.0, 6.0, 4.0), 0.1, 0.02
    observer = rise(DragModel(1), period, d.bounds, gains)
    beta = observer.gain_conditions(Q)[-1]
    delta2 = d.bounds.delta2 + 2.0 * Q / period
    delta3 = d.bounds.delta3 + 4.0 * Q / period**2
    assert beta.right == pytest.approx(delta2 + (1.0 + 4.0 * period) * delta3)
    assert observer.gain_conditions()[-1].holds and not beta.holds


@OBSERVERS
def test_a_plant_without_drift_has_exact_means(kind) -> None:
    d = DisturbanceSource([Sinusoid([0.4], frequency=1.5)], 20.0)
    model = DragModel(1, linear=0.0, cubic=0.0)
    result = run(kind(model, 0.02, d.bounds), model, d.value, 2.0)
    observer = kind(model, 0.02, d.bounds)
    naive = [observer.error_bound(t) for t in result.time]
    np.testing.assert_allclose(result.bound, naive, rtol=1e-9)
