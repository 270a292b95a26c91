from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    ZeroOrderHold,
)
import pytest

from tests.helpers.observer_runs import Bench, DragModel, rise, run
from vcbf_drake.disturbances import (
    BandLimitedNoise,
    Constant,
    DisturbanceBounds,
    DisturbanceEstimate,
    DisturbanceSource,
    Recorded,
    RiseGains,
    Sinusoid,
    SmoothStep,
)
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp

SIGNALS = {
    "constant": [Constant([0.3, -0.4])],
    # delta2 = 0.59, delta3 = 0.98.
    "sinusoids": [
        Constant([0.0, 0.15]),
        Sinusoid([0.3, 0.0], frequency=1.0, phase=0.4),
        Sinusoid([0.13, 0.0], frequency=2.3),
        Sinusoid([0.0, 0.2], frequency=0.8, phase=1.57),
    ],
    "step": [SmoothStep([0.3, -0.3], start=1.0, duration=1.5)],
    "noise": [BandLimitedNoise([0.2, 0.2], bandwidth=2.0, seed=3)],
    "recorded": [
        Recorded(
            np.linspace(-1.0, 6.0, 9).tolist(),
            (0.2 * np.random.default_rng(0).normal(size=(9, 2))).tolist(),
        )
    ],
}
STEPS = ("implicit", "saturated", "explicit")
MODEL = DragModel()
FREE = DragModel(linear=0.0, cubic=0.0)  # Its means are exact.
BOUNDS = DisturbanceBounds(0.5, 0.6, 0.9)
# What is left of the quadrature's and the test plant's own errors.
ROUNDING = 1e-9


def source(name: str) -> DisturbanceSource:
    return DisturbanceSource(SIGNALS[name], 5.0)


@pytest.mark.parametrize("period", [1e-3, 1e-2])
@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("name", SIGNALS)
def test_error_is_under_its_bound_at_every_tick(name, step, period):
    d = source(name)
    observer = rise(MODEL, period, d.bounds, step=step)
    assert all(condition.holds for condition in observer.gain_conditions())
    result = run(observer, MODEL, d.value, 0.8 if period < 5e-3 else 3.0)
    assert np.all(result.error <= result.bound + ROUNDING)


def worst_error(step, gains, bounds, period, layer, direction):
    """Largest error over bound when d'' always pushes where it hurts.

    A plant without drift, so that states are known exactly; d' and d'' are as large
    as the bounds allow. d starts at delta1 and grows to what is declared; the bound is
    that for starts up to delta1.
    """
    q = 2
    model = DragModel(q, linear=0.0, cubic=0.0)
    growth = 120 * period * bounds.delta2
    delta1, bounds = bounds.delta1, replace(bounds, delta1=bounds.delta1 + growth)
    observer = rise(model, period, bounds, gains=gains, step=step, boundary_layer=layer)
    bench, unit = Bench(observer), np.array([0.6, 0.8])
    d, rate, v = delta1 * unit, bounds.delta2 * unit, np.zeros(q)
    if direction == "back":
        rate = -rate
    worst = 0.0
    for k in range(120):
        bench.measure(k * period, np.concatenate((np.zeros(q), v)))
        estimate = bench.output("disturbance_estimate")
        error = d - estimate
        decay = (1.0 + observer.gains.decay_rate * period) ** (-k / 2)
        bound = bench.estimate().error_bound - growth * decay
        worst = max(worst, np.linalg.norm(error) / bound)
        bench.update()
        push = {"with": error, "against": -error, "out": unit, "back": -unit}[direction]
        bend = bounds.delta3 * push / max(np.linalg.norm(push), 1e-9)
        new_rate = rate + period * bend
        new_rate *= min(1.0, bounds.delta2 / np.linalg.norm(new_rate))
        bend = (new_rate - rate) / period
        v = v + period * (d + period * rate / 2 + period**2 * bend / 6)
        d, rate = d + period * (rate + period * bend / 2), new_rate
    return worst


def test_bound_holds_against_the_worst_disturbances_found():
    generator = np.random.default_rng(11)
    worst = {"implicit": 0.0, "saturated": 0.0}
    for i in range(48):
        step = ("implicit", "saturated")[i % 2]
        direction = ("with", "against", "out", "back")[i // 2 % 4]
        alpha, gamma = generator.uniform(1.1, 8.0), generator.uniform(0.3, 6.0)
        period = 10 ** generator.uniform(-3.0, -0.7)
        bounds = DisturbanceBounds(*generator.uniform(0.1, 2.0, 3))
        kappa = min(alpha - 1.0, gamma)
        least = bounds.delta2 + (1 + kappa * period) * bounds.delta3 / (alpha - kappa)
        gains = RiseGains(alpha, least * generator.choice([1.001, 2.0]), gamma)
        layer = 10 ** generator.uniform(-3.0, 0.0)
        ratio = worst_error(step, gains, bounds, period, layer, direction)
        worst[step] = max(worst[step], ratio)
    assert worst["implicit"] <= 1.0 + ROUNDING
    assert worst["saturated"] <= 1.0 + ROUNDING
    assert worst["implicit"] > 0.9  # The bound is no larger than it has to be.


def test_sliding_estimate_is_the_mean_of_the_last_interval():
    d, period = source("sinusoids"), 0.01
    result = run(rise(MODEL, period, d.bounds), MODEL, d.value, 4.0)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    t = result.time[250:]
    middles = t[:, None] - period / 2 + nodes * period / 2
    mean = np.einsum("tkq,k->tq", d.value(middles), weights / 2)
    # Half a period of lag would be 3e-3, a whole one 9e-3.
    np.testing.assert_allclose(result.estimate[250:], mean, atol=1e-5)


def test_floor_at_1_khz():
    d = source("sinusoids")
    assert 0.55 < d.bounds.delta2 < 0.65
    observer = rise(MODEL, 1e-3, d.bounds)
    result = run(observer, MODEL, d.value, 4.0)
    late = result.time > 3.2
    assert result.error[late].max() < 1e-3
    assert observer.error_bound(30.0) == pytest.approx(d.bounds.delta2 * 1e-3 / 2)


def test_quadrature_is_far_below_the_floor():
    d, period = source("constant"), 0.01
    result = run(rise(MODEL, period, d.bounds), MODEL, d.value, 4.0)
    assert result.error[-50:].max() < 1e-8


@pytest.mark.parametrize("period", [1e-3, 1e-2])
def test_explicit_step_chatters_by_its_law(period):
    d = source("constant")
    observer = rise(MODEL, period, d.bounds, step="explicit")
    result = run(observer, MODEL, d.value, 3.0)
    law = math.sqrt(2) * 6.0 * math.sqrt(3 * period / 9.0)  # (E27)
    peak = result.error[result.time > 1.5].max()
    assert 0.75 * law < peak < 1.2 * law
    assert observer.error_bound(99.0) == pytest.approx(1.2 * law)


def test_saturated_step_does_not_chatter_and_follows_by_its_law():
    d = DisturbanceSource([Sinusoid([0.3, 0.4], frequency=0.5)], 20.0)
    observer = rise(MODEL, 0.01, d.bounds, step="saturated", boundary_layer=0.05)
    result = run(observer, MODEL, d.value, 16.0)
    law = 5.0 * d.bounds.delta2 / (5.0 * 4.0 + 1.0 + 6.0 / 0.05)  # (E26)
    floor = law + d.bounds.delta2 * 0.01 / 2
    assert result.error[result.time > 3.0].max() == pytest.approx(floor, rel=0.15)
    assert np.abs(np.diff(result.estimate[300:], axis=0)).max() < 0.003


@pytest.mark.parametrize("step", STEPS)
def test_estimate_rate_and_gain_explain_how_the_estimate_moves(step):
    d, period = source("sinusoids"), 1e-3
    observer = rise(MODEL, period, d.bounds, step=step)
    result = run(observer, MODEL, d.value, 0.5)
    mean = (d.value(result.time[1:]) + d.value(result.time[:-1])) / 2
    move = np.diff(result.estimate, axis=0) / period
    # (E60), taken at the end of an interval by the implicit steps, else at its start.
    end = slice(None, -1) if step == "explicit" else slice(1, None)
    predicted = result.rate[end] + 4.0 * (mean - result.estimate[end])
    np.testing.assert_allclose(move, predicted, atol=1e-5)
    assert observer.estimate_gain == 4.0


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("floor", [True, False])
def test_bound_rate_is_the_derivative_of_the_bound(step, floor):
    observer = rise(FREE, 0.01, BOUNDS, step=step, floor=floor)
    bench, h = Bench(observer), 1e-5
    bench.update()
    for t in (0.1, 0.7, 2.0):
        bench.measure(t, np.zeros(4))
        numeric = (observer.error_bound(t + h) - observer.error_bound(t - h)) / (2 * h)
        assert bench.estimate().error_bound_rate == pytest.approx(numeric, rel=1e-6)
        assert bench.estimate().error_bound == observer.error_bound(t)


def test_certified_bound_in_numbers():
    implicit = rise(MODEL, 0.01, BOUNDS)
    saturated = rise(MODEL, 0.01, BOUNDS, step="saturated", boundary_layer=0.05)
    # alpha, beta, gamma = 5, 6, 4: kappa = 4, alpha - kappa = 1, 2 alpha - kappa = 6.
    c = 0.6 + 1.04 * 0.9
    layer = math.sqrt(0.05 / 6.0 * (0.6**2 + c**2 / (4.0 * 6.0)))
    for k in (0, 1, 30):
        bound = (0.5 + 0.006) * 1.04 ** (-k / 2) + 0.003
        assert implicit.error_bound(0.01 * k) == pytest.approx(bound)
        assert saturated.error_bound(0.01 * k) == pytest.approx(bound + layer)


@pytest.mark.parametrize("step", STEPS)
def test_without_floor_the_bound_is_the_published_one(step):
    observer = rise(MODEL, 0.01, BOUNDS, step=step, noise=0.01, floor=False)
    for t in (0.0, 1.0, 3.0):
        assert observer.error_bound(t) == pytest.approx(0.5 * math.exp(-4.0 * t / 2))


def test_published_bound_is_broken_in_sampled_time():
    d = source("sinusoids")
    observer = rise(MODEL, 0.01, d.bounds, floor=False)
    result = run(observer, MODEL, d.value, 4.5)
    assert np.any(result.error > result.bound)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(
    ("period", "noise"), [(1e-3, 1e-3), (1e-2, 1e-3), (1e-2, 1e-2)]
)
def test_bound_with_noise_is_rarely_exceeded(step, period, noise):
    d = source("sinusoids")
    observer = rise(MODEL, period, d.bounds, step=step, noise=noise)
    result = run(observer, MODEL, d.value, 1000 * period, noise=noise)
    assert np.mean(result.error > result.bound) < 1e-3
    without = rise(MODEL, period, d.bounds, step=step)
    assert observer.error_bound(2.0) > without.error_bound(2.0)


@pytest.mark.parametrize(
    ("step", "layer"), [("implicit", 0.05), ("saturated", 0.01), ("saturated", 0.1)]
)
def test_noise_term_is_the_deviation_of_the_estimate(step, layer):
    model = DragModel(1, linear=0.0, cubic=0.0)
    still = DisturbanceBounds(0.0, 0.0, 0.0)
    period, noise = 0.01, 1e-3
    observer = rise(model, period, still, step=step, boundary_layer=layer, noise=noise)
    bench, generator = Bench(observer), np.random.default_rng(2)
    estimates = []
    for k in range(4000):
        bench.measure(k * period, np.array([0.0, noise * generator.normal()]))
        estimates.append(bench.output("disturbance_estimate")[0])
        bench.update()
    predicted = observer.error_bound(0.0) / 4.0  # Four deviations for one channel.
    assert np.std(estimates[200:]) == pytest.approx(predicted, rel=0.1)


def test_gain_conditions():
    observer = rise(MODEL, 0.01, BOUNDS, RiseGains(4.6, 5.0, 4.4))
    alpha, gamma, beta = observer.gain_conditions()
    assert (alpha.left, alpha.right, alpha.holds) == (4.6, 1.0, True)
    assert (gamma.left, gamma.right, gamma.holds) == (4.4, 0.0, True)
    assert beta.left == 5.0
    assert beta.right == pytest.approx(0.6 + (1 + 3.6 * 0.01) * 0.9)
    assert beta.holds
    assert observer.gains.decay_rate == pytest.approx(3.6)


def test_first_tick_takes_the_state_and_starts_the_clock():
    observer = rise(FREE, 0.01, BOUNDS)
    bench = Bench(observer)
    bench.measure(7.0, np.array([5.0, -3.0, 2.0, 1.0]))
    bench.update()
    np.testing.assert_array_equal(bench.output("disturbance_estimate"), np.zeros(2))
    np.testing.assert_array_equal(bench.estimate().rate, np.zeros(2))
    assert bench.estimate().error_bound == observer.error_bound(0.0)
    bench.measure(7.3, np.array([5.0, -3.0, 2.0, 1.0]))
    assert bench.estimate().error_bound == pytest.approx(observer.error_bound(0.3))


def test_wrong_start_time_does_not_matter():
    d = source("sinusoids")
    early = run(rise(MODEL, 0.01, d.bounds), MODEL, d.value, 1.0)
    late = run(
        rise(MODEL, 0.01, d.bounds),
        MODEL,
        lambda t: d.value(t - 40.0),
        1.0,
        start=40.0,
    )
    np.testing.assert_allclose(late.estimate, early.estimate, atol=1e-9)
    np.testing.assert_allclose(late.bound, early.bound, atol=1e-12)


def outputs(bench):
    names = ("estimate", "disturbance_estimate")
    return np.concatenate([bench.output(name) for name in names])


@pytest.mark.parametrize("step", STEPS)
def test_update_does_not_change_the_outputs(step):
    bench = Bench(rise(MODEL, 0.01, BOUNDS, step=step))
    generator = np.random.default_rng(1)
    for k in range(5):
        bench.measure(0.01 * k, 0.01 * generator.normal(size=4))
        before = outputs(bench)
        bench.update()
        np.testing.assert_array_equal(outputs(bench), before)


def test_clone_gives_the_same_outputs_in_any_order():
    bench = Bench(rise(MODEL, 0.01, BOUNDS))
    for k in range(3):
        bench.measure(0.01 * k, np.full(4, 0.01 * k))
        bench.update()
    bench.measure(0.027, np.full(4, 0.027))
    clone = Bench(bench.observer)
    clone.context = bench.context.Clone()
    rate = clone.estimate().rate
    np.testing.assert_array_equal(outputs(bench), outputs(clone))
    np.testing.assert_array_equal(bench.estimate().rate, rate)


def test_outputs_between_ticks_are_continuous():
    d = source("sinusoids")
    model = DragModel(2, linear=0.0, cubic=0.0)
    bench, velocity = Bench(rise(model, 0.1, d.bounds)), np.zeros(2)
    estimates, t = [], 0.0
    for k in range(301):
        t = k * 0.01
        velocity = velocity + 0.01 * d.value(t - 0.005) * (k > 0)
        bench.measure(t, np.concatenate((np.zeros(2), velocity)))
        estimates.append(bench.output("disturbance_estimate"))
        if k % 10 == 0:
            bench.update()
    jumps = np.linalg.norm(np.diff(estimates, axis=0), axis=1)
    assert jumps[200:].max() < 0.02


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_outputs_stay_finite_and_recover_when_measurements_fail(bad):
    d = source("constant")
    model = DragModel(2, linear=0.0, cubic=0.0)
    bench = Bench(rise(model, 0.01, d.bounds))
    errors = []
    for k in range(200):
        t = 0.01 * k
        velocity = t * d.value(t)
        if k in (0, 60, 61, 62):
            velocity = np.array([velocity[0], bad])
        before = bench.output("disturbance_estimate")
        bench.measure(t, np.concatenate((np.zeros(2), velocity)))
        if k == 60:
            np.testing.assert_array_equal(bench.output("disturbance_estimate"), before)
        bench.update()
        assert np.isfinite(outputs(bench)).all()
        errors.append(np.linalg.norm(d.value(t) - bench.output("disturbance_estimate")))
        assert errors[-1] <= bench.estimate().error_bound
    assert errors[63] == errors[60]  # The interval that began badly tells nothing.
    assert errors[199] < 1e-9
    assert bench.estimate().refused_intervals == 4.0
    # The bound decays from the last refused interval, for an estimate of that size.
    kept = d.value(0.0) * (1.0 - errors[63] / np.linalg.norm(d.value(0.0)))
    excess = np.linalg.norm(kept) * 1.04 ** (-(199 - 63) / 2)
    assert bench.estimate().error_bound == pytest.approx(
        bench.observer.error_bound(1.99 - 0.63) + excess
    )


def test_input_that_is_not_finite_is_left_out():
    bench = Bench(rise(MODEL, 0.01, BOUNDS))
    bench.update()
    bench.measure(0.01, np.zeros(4))
    bench.hold(np.array([np.nan, 0.0]))
    np.testing.assert_array_equal(bench.output("disturbance_estimate"), np.zeros(2))


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"period": 0.0}, "period: 0; it must be finite and above 0"),
        ({"step": "euler"}, "step: .euler.; it must be one of implicit"),
        ({"boundary_layer": 0.0}, "boundary_layer: 0;"),
        ({"noise": -1.0}, "noise: -1;"),
    ],
)
def test_bad_arguments_are_refused(arguments, problem):
    with pytest.raises(ValueError, match=problem):
        rise(MODEL, **{"period": 0.01, "bounds": BOUNDS, **arguments})


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="beta: -1"):
        RiseGains(beta=-1.0)
    with pytest.raises(ValueError, match="delta2: nan"):
        DisturbanceBounds(1.0, float("nan"), 1.0)


def test_blimp_in_a_drake_simulation():
    d = DisturbanceSource(
        [
            Constant([0.0, 0.0, 0.15]),
            Sinusoid([0.3, 0.0, 0.1], frequency=1.0, phase=0.4),
            Sinusoid([0.0, 0.2, 0.0], frequency=0.8),
        ],
        5.0,
    )
    period, builder = 0.01, DiagramBuilder()
    plant = builder.AddSystem(Blimp())
    model = ControlAffineModel.from_system(plant)
    observer = builder.AddSystem(rise(model, period, d.bounds))
    builder.AddSystem(d)
    command = builder.AddSystem(ConstantVectorSource([0.05, 0.02, 0.002]))
    hold = builder.AddSystem(ZeroOrderHold(period, 3))
    builder.Connect(command.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.GetInputPort("input"))
    builder.Connect(hold.get_output_port(), observer.GetInputPort("input"))
    builder.Connect(d.get_output_port(), plant.GetInputPort("disturbance"))
    builder.Connect(plant.GetOutputPort("state"), observer.GetInputPort("state"))
    logs = [
        LogVectorOutput(port, builder, period)
        for port in (
            d.get_output_port(),
            observer.GetOutputPort("estimate"),
        )
    ]
    simulator = Simulator(builder.Build())
    ResetIntegratorFromFlags(simulator, "runge_kutta3", period / 4)
    simulator.AdvanceTo(4.0)
    context = simulator.get_context()
    truth, packed = (log.FindLog(context).data() for log in logs)
    estimate, _, bound, *_ = DisturbanceEstimate.unpack(packed.T)
    estimate = estimate.T
    error = np.linalg.norm(truth - estimate, axis=0)
    assert error.shape == (401,)
    np.testing.assert_array_equal(estimate[:, 0], np.zeros(3))
    assert np.all(error <= bound + 1e-6)
    assert error[-50:].max() < d.bounds.delta2 * period / 2 + 1e-6
