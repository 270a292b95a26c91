"""Observer gains: computed from the bounds, refused where nothing is proven."""

from __future__ import annotations

import math

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
import pytest

from tests.helpers.observer_runs import DragModel, rise, run
from vcbf_drake import AddSafetyFilter, load_scenario
from vcbf_drake.barriers import StateLimit
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceEstimate,
    DisturbanceSource,
    LinearDisturbanceObserver,
    RiseGains,
    Sinusoid,
)
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.plants import Car, CarParameters
from vcbf_drake.safety import FilterSettings, InputSet
from vcbf_drake.simulation import check_assumptions

PAPER = RiseGains(5.0, 6.0, 4.0)
# The disturbance's amplitude and rate [rad/s], and what one unit of it does [m/s^2].
UNITS = {
    "newtons on 1500 kg": ([600.0, 200.0], 0.8, 1.0 / 1500.0),
    "degrees": ([20.0, 10.0], 1.0, math.pi / 180.0),
    "millimetres": ([400.0, 300.0], 1.0, 1e-3),
    "quick gusts": ([0.4, 0.0], 20.0, 1.0),
    "light winds": ([0.3, 0.1], 1.0, 1.0),
}
IN_ANY_UNIT = pytest.mark.parametrize(
    ("amplitude", "rate", "effect"), UNITS.values(), ids=UNITS
)


def setting(amplitude, rate, effect):
    model = DragModel()
    model.disturbance_matrix = effect * model.disturbance_matrix
    return model, DisturbanceSource([Sinusoid(amplitude, frequency=rate)], 10.0)


@IN_ANY_UNIT
@pytest.mark.parametrize("step", ["implicit", "saturated"])
def test_default_gains_keep_the_error_under_its_bound(amplitude, rate, effect, step):
    model, d = setting(amplitude, rate, effect)
    observer = rise(model, 0.02, d.bounds, step=step)
    least = d.bounds.delta2 + (1.0 + 4.0 * 0.02) * d.bounds.delta3
    assert (observer.gains.alpha, observer.gains.gamma) == (5.0, 4.0)
    assert observer.gains.beta == (6.0 if least < 6.0 else pytest.approx(1.1 * least))
    assert observer.basis == "proven"
    result = run(observer, model, d.value, 6.0)
    assert np.all(result.error <= result.bound * (1.0 + 1e-6))
    if step == "implicit":
        assert result.bound[-1] < 0.75 * d.bounds.delta1


@IN_ANY_UNIT
def test_the_paper_s_gains_are_kept_or_refused(amplitude, rate, effect):
    model, d = setting(amplitude, rate, effect)
    if max(amplitude) < 0.4:
        assert rise(model, 0.02, d.bounds, PAPER).gains == PAPER
        return
    with pytest.raises(ValueError, match=r"= 5, 6, 4: beta > .* needs 6 > \d"):
        rise(model, 0.02, d.bounds, PAPER)
    observer = rise(model, 0.02, d.bounds, PAPER, uncertified=True)
    assert observer.basis == "worst case"
    result = run(observer, model, d.value, 6.0)
    assert result.bound.tolist() == [2.0 * d.bounds.delta1] * len(result.bound)
    assert np.all(result.bound_rate == 0.0)
    assert np.all(np.linalg.norm(result.estimate, axis=1) <= d.bounds.delta1 + 1e-9)
    assert np.all(result.error <= result.bound)


@pytest.mark.parametrize(
    ("gains", "conditions"),
    [
        (RiseGains(0.9, 3.0, 4.0), [False, True, True]),
        (RiseGains(0.9, 0.5, 4.0), [False, True, False]),
        (RiseGains(5.0, 1.4, 4.0), [True, True, False]),
    ],
)
def test_gains_that_prove_nothing_are_refused_by_the_condition(gains, conditions):
    bounds = DisturbanceBounds(0.5, 0.6, 0.9)
    with pytest.raises(ValueError, match="beta, gamma =") as refusal:
        rise(DragModel(), 0.01, bounds, gains)
    assert "\n" not in str(refusal.value)
    assert ("alpha > 1" in str(refusal.value)) is not conditions[0]
    allowed = rise(DragModel(), 0.01, bounds, gains, uncertified=True)
    assert [each.holds for each in allowed.gain_conditions()] == conditions
    assert allowed.error_bound(0.0) == allowed.error_bound(9.0) == 1.0


def test_permission_changes_nothing_where_the_conditions_hold():
    bounds = DisturbanceBounds(0.5, 0.6, 0.9)
    allowed = rise(DragModel(), 0.01, bounds, PAPER, uncertified=True)
    certified = rise(DragModel(), 0.01, bounds)
    assert allowed.basis == "proven"
    assert allowed.error_bound(0.7) == certified.error_bound(0.7)


@pytest.mark.parametrize("period", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("delta3", [0.0, 3.0, 100.0])
def test_gains_for_bounds_satisfy_their_condition_at_every_period(period, delta3):
    bounds = DisturbanceBounds(1.0, 2.0, delta3)
    for alpha, gamma in [(5.0, 4.0), (1.5, 8.0), (9.0, 2.0)]:
        gains = RiseGains.for_bounds(bounds, period, alpha, gamma)
        kappa = min(alpha - 1.0, gamma)  # (E32), by hand.
        assert (alpha - kappa) * (gains.beta - 2.0) > delta3 * (1.0 + kappa * period)


@pytest.mark.parametrize("gains", [PAPER, RiseGains(9.0, 6.0, 1.0)])
def test_an_explicit_step_that_is_not_stable_is_refused(gains):
    bounds = DisturbanceBounds(0.5, 0.6, 0.9)
    linear = np.array(
        [[-gains.alpha - gains.gamma, -1.0], [gains.alpha * gains.gamma + 1.0, 0.0]]
    )
    rates = np.linalg.eigvals(linear)
    longest = np.min(-2.0 * rates.real / np.abs(rates) ** 2)
    inside = rise(DragModel(), 0.99 * longest, bounds, gains, step="explicit")
    assert inside.basis == "calibrated"
    with pytest.raises(ValueError, match="longest stable period > dt needs"):
        rise(DragModel(), 1.01 * longest, bounds, gains, step="explicit")


def test_what_an_error_bound_rests_on():
    bounds, model = DisturbanceBounds(0.5, 0.6, 0.9), DragModel()
    assert rise(model, 0.01, bounds, noise=1e-3).basis == "calibrated"
    assert rise(model, 0.01, bounds, floor=False).basis == "published"
    assert LinearDisturbanceObserver(model, 0.01, bounds).basis == "proven"
    noisy = LinearDisturbanceObserver(model, 0.01, bounds, noise=1e-3)
    assert noisy.basis == "calibrated"


@pytest.mark.parametrize("rate", [1.0, 30.0])
def test_the_linear_observer_s_noise_term_is_four_deviations(rate):
    model = DragModel(1, linear=0.0, cubic=0.0)
    still = DisturbanceBounds(0.0, 0.0, 0.0)
    observer = LinearDisturbanceObserver(model, 0.01, still, rate, noise=1e-3)
    result = run(observer, model, lambda t: np.zeros(1), 60.0, noise=1e-3)
    deviation = np.std(result.estimate[1000:])
    assert observer.error_bound(0.0) == pytest.approx(4.0 * deviation, rel=0.1)


def test_a_heavy_cart_s_filter_computes_its_gains():
    """1500 kg and 600 N: with beta = 6 the error was 24 times its bound."""
    plant = Car(CarParameters(mass=1500.0))
    wind = DisturbanceSource([Sinusoid([0.4], frequency=2.9)], 8.0)
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    builder.AddSystem(wind)
    reference = builder.AddSystem(ConstantVectorSource([4000.0, 0.0]))
    speed_limit = StateLimit(2, upper=1.0).barriers([3.0])
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=reference.get_output_port(),
        barriers=speed_limit,
        input_set=InputSet.box([-6000.0, -1.0], [6000.0, 1.0]),
        bounds=wind.bounds,
        settings=FilterSettings(method="dob-cbf-qp"),
    )
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    ports = (
        wind.get_output_port(),
        safety.observer.GetOutputPort("estimate"),
        plant.GetOutputPort("state"),
    )
    logs = [LogVectorOutput(port, builder, 0.02) for port in ports]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(8.0)
    assert simulator.get_context().get_time() == 8.0
    truth, packed, state = (log.FindLog(simulator.get_context()).data() for log in logs)
    estimate = DisturbanceEstimate.unpack(packed.T)
    error = np.linalg.norm(truth.T - estimate.disturbance, axis=1)
    assert np.all(error <= estimate.error_bound + 1e-6)
    assert 0.9 < state[2].max() <= 1.0


def test_a_scenario_s_gains_are_computed_or_refused():
    gusts = "{disturbance: [!Sinusoid {amplitude: [0.4, 0, 0], frequency: 20}]"
    failing = load_scenario("blimp-single-obstacle", gusts + "}")
    with pytest.raises(InvalidValueError, match=r"^observer: gains .* 6, 4: beta"):
        check_assumptions(failing)
    for change in ("beta: null", "uncertified: true"):
        scenario = load_scenario(
            "blimp-single-obstacle", f"{gusts}, observer: {{{change}}}}}"
        )
        found = {each.name: each for each in check_assumptions(scenario)}
        beta = next(each for name, each in found.items() if "beta" in name)
        assert beta.holds is (change == "beta: null")
