# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.systems.analysis import Simulator
import pytest
from scipy.interpolate import CubicSpline

from vcbf_drake.disturbances import (
    BandLimitedNoise,
    Constant,
    DisturbanceSource,
    Recorded,
    Sinusoid,
    SmoothStep,
)
from vcbf_drake.errors import ModelError

HORIZON = 6.0
SAMPLES = np.random.default_rng(3).normal(size=(9, 2))
SIGNALS = {
    "constant": [Constant([0.3, -0.4])],
    "sinusoid": [Sinusoid([0.3, 0.1], frequency=2.0, phase=0.4)],
    "step": [SmoothStep([0.2, -0.5], start=1.0, duration=0.8)],
    "noise": [BandLimitedNoise([0.2, 0.1], bandwidth=5.0, seed=7)],
    "recorded": [Recorded(np.linspace(-0.5, 6.5, 9).tolist(), SAMPLES.tolist())],
    "sum": [
        Constant([0.2, 0.0]),
        Sinusoid([0.1, 0.2], frequency=1.3),
        Sinusoid([0.0, 0.1], frequency=3.1, phase=1.0),
        SmoothStep([0.1, 0.1], start=2.0, duration=1.0),
        BandLimitedNoise([0.05, 0.05], bandwidth=3.0),
    ],
}


@pytest.fixture(params=SIGNALS)
def signals(request):
    return SIGNALS[request.param]


def numeric_derivatives(source, t):
    """d, d' and d'' by central differences of the value alone."""
    h = 1e-4
    before, now, after = (source.value(t + k * h) for k in (-1, 0, 1))
    return now, (after - before) / (2 * h), (after - 2 * now + before) / h**2


def test_bounds_are_from_above_and_tight(signals):
    source = DisturbanceSource(signals, HORIZON)
    t = np.linspace(0.001, HORIZON - 0.001, 40001)
    bounds = source.bounds
    for values, bound, noise in zip(
        numeric_derivatives(source, t),
        (bounds.delta1, bounds.delta2, bounds.delta3),
        (0.0, 1e-9, 1e-6),  # Rounding of the central differences.
        strict=True,
    ):
        largest = np.linalg.norm(values, axis=1).max()
        assert largest - noise <= bound * (1 + 1e-6)
        assert bound <= 1.011 * largest + 1e-6


def test_analytic_derivatives_match_central_differences(signals):
    t = np.linspace(0.01, HORIZON - 0.01, 997)
    h = 1e-5
    for signal in signals:
        curve = signal.curve(HORIZON)
        for order in (1, 2, 3):
            numeric = (
                curve.derivative(t + h, order - 1) - curve.derivative(t - h, order - 1)
            ) / (2 * h)
            exact = curve.derivative(t, order)
            scale = curve.derivative_bound(order)
            # A kink of the second derivative spoils the difference next to it.
            close = np.abs(numeric - exact).max(axis=1) <= 1e-4 * scale + 1e-9
            assert close.all() if order < 3 else close.mean() > 0.99


def test_second_derivative_is_continuous_everywhere(signals):
    t = np.linspace(0.0, HORIZON, 200001)
    for signal in signals:
        curve = signal.curve(HORIZON)
        jump = np.abs(np.diff(curve.derivative(t, 2), axis=0)).max()
        assert jump <= curve.derivative_bound(3) * (t[1] - t[0]) + 1e-12


def test_value_is_vectorised(signals):
    source = DisturbanceSource(signals, HORIZON)
    t = np.array([[0.0, 1.5], [2.0, 6.0]])
    values = source.value(t)
    assert values.shape == (2, 2, 2)
    # Which of NumPy's loops runs, and so the last bit, depends on the processor.
    np.testing.assert_allclose(values[1, 0], source.value(2.0), rtol=0.0, atol=1e-14)


def test_port_and_value_are_the_same(signals):
    source = DisturbanceSource(signals, HORIZON)
    context = source.CreateDefaultContext()
    for t in np.linspace(0.0, HORIZON, 61):
        context.SetTime(t)
        port = source.get_output_port().Eval(context)
        np.testing.assert_allclose(port, source.value(t), rtol=0.0, atol=1e-14)


def test_port_is_the_sum_of_the_signals():
    source = DisturbanceSource(SIGNALS["sum"], HORIZON)
    simulator = Simulator(source)
    simulator.AdvanceTo(2.5)
    t = simulator.get_context().get_time()
    s = (t - 2.0) / 1.0
    rise = s**3 * (10 - 15 * s + 6 * s**2)
    noise = SIGNALS["sum"][-1].curve(HORIZON).derivative(t)
    expected = [
        0.2 + 0.1 * np.sin(1.3 * t) + 0.1 * rise + noise[0],
        0.2 * np.sin(1.3 * t) + 0.1 * np.sin(3.1 * t + 1.0) + 0.1 * rise + noise[1],
    ]
    output = source.GetOutputPort("disturbance").Eval(simulator.get_context())
    np.testing.assert_allclose(output, expected, atol=1e-14)


def test_constant_is_exact():
    source = DisturbanceSource([Constant([3.0, 4.0])])
    np.testing.assert_array_equal(source.value(1.7), [3.0, 4.0])
    bounds = source.bounds
    assert (bounds.delta1, bounds.delta2, bounds.delta3) == (5.0, 0.0, 0.0)


def test_opposite_signals_cancel():
    signals = [Sinusoid([1.0], frequency=3.0), Sinusoid([-1.0], frequency=3.0)]
    assert DisturbanceSource(signals).bounds.delta1 < 1e-3


def test_no_signal_is_no_disturbance():
    source = DisturbanceSource([], num_disturbances=3)
    np.testing.assert_array_equal(source.value(1.0), np.zeros(3))
    assert source.bounds.delta1 == 0.0


def test_noise_has_its_deviation_and_bandwidth():
    t = np.linspace(0.0, 2000.0, 200001)
    curves = [
        BandLimitedNoise([0.2, 0.1], 4.0, seed).curve(1.0).derivative(t)
        for seed in range(4)
    ]
    deviation = np.sqrt(np.mean(np.square(curves), axis=(0, 1)))
    np.testing.assert_allclose(deviation, [0.2, 0.1], rtol=0.03)
    spectrum = np.abs(np.fft.rfft(curves[0][:, 0] * np.hanning(len(t)))) ** 2
    frequency = 2 * np.pi * np.fft.rfftfreq(len(t), t[1] - t[0])
    assert spectrum[frequency > 4.1].sum() < 1e-6 * spectrum.sum()
    correlation = np.corrcoef(curves[0].T)[0, 1]
    assert abs(correlation) < 0.2


def test_noise_repeats_with_its_seed():
    t = np.linspace(0.0, 5.0, 11)
    first, again, other = (
        BandLimitedNoise([1.0], 2.0, seed).curve(5.0).derivative(t)
        for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_recorded_is_the_not_a_knot_spline():
    times = np.cumsum(np.random.default_rng(5).uniform(0.2, 1.0, 12)) - 1.0
    values = np.random.default_rng(6).normal(size=(12, 3))
    curve = Recorded(times.tolist(), values.tolist()).curve(times[-1])
    oracle = CubicSpline(times, values)
    t = np.linspace(0.0, times[-1], 101)
    for order in range(3):
        np.testing.assert_allclose(
            curve.derivative(t, order), oracle(t, order), atol=1e-8
        )
    np.testing.assert_allclose(curve.derivative(times), values, atol=1e-12)


@dataclass
class Scenario:
    disturbance: list[
        Constant | Sinusoid | SmoothStep | BandLimitedNoise | Recorded
    ] = field(default_factory=list)


def test_signals_go_through_yaml():
    signals = [part for parts in SIGNALS.values() for part in parts]
    text = yaml_dump_typed(Scenario(signals))
    assert yaml_load_typed(schema=Scenario, data=text).disturbance == signals


@pytest.mark.parametrize(
    ("signal", "problem"),
    [
        (SmoothStep([1.0], 0.0, 0.0), "duration: 0; it must be finite and above 0"),
        (SmoothStep([1.0], float("inf"), 1.0), "start: inf"),
        (Constant([]), "value: .*; it must be a list of finite numbers"),
        (Constant([float("nan")]), "value: .*; it must be a list of finite numbers"),
        (Sinusoid([1.0], frequency=float("inf")), "frequency: inf"),
        (BandLimitedNoise([1.0], bandwidth=-1.0), "bandwidth: -1;"),
        (BandLimitedNoise([-1.0]), "std: .*not below 0"),
        (BandLimitedNoise([1.0], seed=-1), "seed: -1"),
        (BandLimitedNoise([1.0], tones=0), "tones: 0"),
        (Recorded([0.0, 9.0], [[1.0], [2.0]]), "three at least"),
        (Recorded([0.0, 2.0, 2.0, 9.0], [[1.0]] * 4), "increasing"),
        (Recorded([0.0, 2.0, 9.0], [[1.0]] * 4), "values: .*; it must be 3 rows"),
        (
            Recorded([0.0, 2.0, 9.0], [[1.0], [2.0, 3.0], [1.0]]),
            "values: .*must be",
        ),
        (
            Recorded([0.0, 2.0, 9.0], [[1.0], [float("nan")], [1.0]]),
            "values: .*must be",
        ),
        (Recorded([0.0, 2.0, 5.0], [[1.0]] * 3), r"times: from 0 to 5 s.*\[0, 6\] s"),
        (Recorded([1.0, 2.0, 9.0], [[1.0]] * 3), "not C2"),
    ],
)
def test_what_is_not_c2_is_refused_in_one_line(signal, problem):
    name = type(signal).__name__
    with pytest.raises(ModelError, match=rf"signal 1 \({name}\): .*{problem}") as error:
        DisturbanceSource([Constant([0.0]), signal], HORIZON)
    assert "\n" not in str(error.value)


def test_sizes_must_agree():
    with pytest.raises(ModelError, match="signal 1 has 2 channels; it must have 1"):
        DisturbanceSource([Constant([0.0]), Constant([0.0, 1.0])])
    with pytest.raises(ModelError, match="signal 0 has 1 channels; it must have 2"):
        DisturbanceSource([Constant([0.0])], num_disturbances=2)
    with pytest.raises(ModelError, match="one signal at least"):
        DisturbanceSource([])
    with pytest.raises(ModelError, match="horizon: 0"):
        DisturbanceSource([Constant([0.0])], horizon=0.0)
