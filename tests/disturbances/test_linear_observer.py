from __future__ import annotations

import math

import numpy as np
import pytest

from tests.helpers.observer_runs import Bench, DragModel, run
from vcbf_drake.disturbances import (
    BandLimitedNoise,
    Constant,
    DisturbanceBounds,
    DisturbanceSource,
    LinearDisturbanceObserver,
    Sinusoid,
    SmoothStep,
)

SIGNALS = {
    "constant": [Constant([0.3, -0.4])],
    "sinusoid": [Sinusoid([0.3, 0.1], frequency=2.0, phase=0.4)],
    "step": [SmoothStep([0.3, -0.3], start=1.0, duration=0.7)],
    "noise": [BandLimitedNoise([0.2, 0.2], bandwidth=4.0, seed=3)],
}
MODEL = DragModel()


@pytest.mark.parametrize("rate", [1.0, 60.0])
@pytest.mark.parametrize("period", [1e-3, 1e-2])
@pytest.mark.parametrize("name", SIGNALS)
def test_error_is_under_its_bound_at_every_tick(name, period, rate):
    d = DisturbanceSource(SIGNALS[name], 4.0)
    observer = LinearDisturbanceObserver(MODEL, period, d.bounds, rate)
    result = run(observer, MODEL, d.value, 0.5 if period < 5e-3 else 3.0)
    assert np.all(result.error <= result.bound + 1e-9)


@pytest.mark.parametrize(
    ("period", "rate"), [(1e-3, 4.0), (0.05, 4.0), (0.5, 7.0), (0.5, 0.01)]
)
def test_bound_is_exact_for_a_ramp(period, rate):
    """From 0.5; the bound is for starts up to delta1, which the ramp never exceeds.

    The slowest observer is worse in the end than none: its bound rises.
    """
    bounds = DisturbanceBounds(30.0, 0.8, 0.0)
    model = DragModel(1, linear=0.0, cubic=0.0)
    observer = LinearDisturbanceObserver(model, period, bounds, rate)
    bench = Bench(observer)
    for k in range(60):
        t = k * period
        bench.measure(t, np.array([0.0, 0.5 * t + 0.8 * t**2 / 2]))
        error = 0.5 + 0.8 * t - bench.output("disturbance_estimate")[0]
        error += (30.0 - 0.5) * math.exp(-rate * t)
        assert error == pytest.approx(bench.estimate().error_bound, rel=1e-9)
        bench.update()


def test_bound_tends_to_that_of_continuous_time():
    bounds = DisturbanceBounds(0.5, 0.6, 0.9)
    observer = LinearDisturbanceObserver(MODEL, 1e-5, bounds, 4.0)
    for t in (0.0, 0.3, 5.0):
        decay = math.exp(-4.0 * t)
        limit = 0.5 * decay + 0.6 / 4.0 * (1.0 - decay)  # (B4)
        assert observer.error_bound(t) == pytest.approx(limit, rel=1e-6)


def test_estimate_follows_the_continuous_observer():
    """Against (E67) itself, integrated with the true velocity and no drift."""
    model = DragModel(1, linear=0.0, cubic=0.0)
    bounds = DisturbanceBounds(1.0, 2.0, 4.0)
    observer = LinearDisturbanceObserver(model, 0.01, bounds, 4.0)
    bench, h = Bench(observer), 1e-4
    z, worst = 0.0, 0.0
    for i in range(10001):
        t = i * h
        v = (1.0 - math.cos(2.0 * t)) / 2.0  # d = sin(2 t)
        if i % 100 == 0:
            bench.measure(t, np.array([0.0, v]))
            estimate = bench.output("disturbance_estimate")[0]
            worst = max(worst, abs(estimate - (z + 4.0 * v)))
            bench.update()
        z += h * -4.0 * (z + 4.0 * v)
    assert worst < 1e-3


def test_rate_and_gain():
    d = DisturbanceSource(SIGNALS["sinusoid"], 4.0)
    observer = LinearDisturbanceObserver(MODEL, 1e-3, d.bounds, 4.0)
    assert observer.estimate_gain == 4.0
    result = run(observer, MODEL, d.value, 0.5)
    np.testing.assert_array_equal(result.rate, np.zeros_like(result.rate))
    move = np.diff(result.estimate, axis=0) / 1e-3
    middle = (result.estimate[1:] + result.estimate[:-1]) / 2
    truth = d.value(result.time[:-1] + 5e-4)
    np.testing.assert_allclose(move, 4.0 * (truth - middle), atol=1e-4)


def test_bound_rate_is_the_derivative_of_the_bound():
    bounds = DisturbanceBounds(0.1, 0.6, 0.9)
    model = DragModel(linear=0.0, cubic=0.0)  # Its means are exact.
    observer = LinearDisturbanceObserver(model, 0.02, bounds, 2.0)
    bench, h = Bench(observer), 1e-5
    bench.update()
    for t in (0.1, 0.7, 2.0):
        bench.measure(t, np.zeros(4))
        numeric = (observer.error_bound(t + h) - observer.error_bound(t - h)) / (2 * h)
        assert bench.estimate().error_bound_rate == pytest.approx(numeric, rel=1e-6)


@pytest.mark.parametrize("name", ["rate", "period"])
def test_bad_arguments_are_refused(name):
    arguments = {"period": 0.01, "rate": 4.0, name: 0.0}
    with pytest.raises(ValueError, match=f"{name}: 0; it must be finite and above"):
        LinearDisturbanceObserver(
            MODEL, bounds=DisturbanceBounds(1.0, 1.0, 1.0), **arguments
        )
