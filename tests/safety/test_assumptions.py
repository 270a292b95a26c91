"""Each hypothesis at one start, against numbers worked out by hand."""

import numpy as np
from pydrake.systems.primitives import LinearSystem
import pytest

from vcbf_drake import (
    Car,
    ControlAffineModel,
    InputSet,
    LinearDisturbanceObserver,
    RiseObserver,
    SafetyFilter,
)
from vcbf_drake.barriers import HalfSpace, StateInputLimit, StateLimit
from vcbf_drake.between_ticks import HeldRows
from vcbf_drake.disturbances import DisturbanceBounds, ObserverSettings
from vcbf_drake.safety import (
    METHODS,
    Corrections,
    FilterSettings,
    VolumeBarrier,
    assumptions,
)

PERIOD = 0.02
INPUTS = InputSet.box([-4.0, -0.5], [4.0, 1.0])
BOUNDS = DisturbanceBounds(0.3, 0.2, 0.1)
# A wall 5 m ahead of a car that drives towards it: x <= 5, x' = v cos(heading).
AHEAD = HalfSpace([-1.0, 0.0], -5.0)
STEERING = StateInputLimit(
    lambda x, t, p: (np.array([0.0, 1.0]), 1.0 + x[2] * x[2]), name="steering"
)


@pytest.fixture(scope="module")
def car():
    return ControlAffineModel.from_system(Car())


def at(car, method, speed=1.0, observer=RiseObserver, barriers=(AHEAD,), **options):
    """The hypotheses by name, of a car at the origin."""
    noise = [options.pop("noise")] if "noise" in options else []
    observer = observer(car, PERIOD, options.pop("bounds", BOUNDS))
    walls = [b.barrier([4.0, 3.0]) if b is AHEAD else b for b in barriers]
    inputs = options.pop("inputs", INPUTS)
    safety_filter = SafetyFilter(
        car,
        walls,
        inputs,
        FilterSettings(method=method, **{"period": PERIOD, **options}),
        make_row_holder=HeldRows,
    )
    context = safety_filter.CreateDefaultContext()
    values = {"state": [0.0, 0.0, speed, 0.0], "reference": np.zeros(2)}
    if METHODS[method].disturbance == "estimated":
        values["estimate"] = [0.0, 0.0, 0.3, 0.0, 0.0, 0.0]
    for name, value in values.items():
        safety_filter.GetInputPort(name).FixValue(context, np.array(value, float))
    found = assumptions(safety_filter, context, observer, *noise)
    return {a.name: a for a in found}


def test_the_inputs_are_bounded(car):
    bounded = at(car, "cbf-qp")["bounded input set"]
    assert bounded.holds
    assert bounded.numbers == {"smallest half-width": 0.75}


@pytest.mark.parametrize(
    ("upper", "holds", "least"),
    [([3.0, 0.0], True, 3.0), ([0.0, 0.0], None, np.inf), ([3.0, np.inf], None, 3.0)],
)
def test_inputs_without_room_or_limits_have_no_half_width(car, upper, holds, least):
    """Of an input that is fixed it says nothing, and is infinite without limits."""
    inputs = InputSet.box(np.negative(upper), upper)
    bounded = at(car, "cbf-qp", inputs=inputs)["bounded input set"]
    assert bounded.holds is holds
    assert bounded.numbers == {"smallest half-width": least}


@pytest.mark.parametrize("method", METHODS)
def test_each_method_is_asked_what_its_proof_needs(car, method):
    found = at(car, method)
    disturbance, volume = METHODS[method].disturbance, METHODS[method].has_volume_row
    estimated = disturbance == "estimated"
    assert ("no disturbance" in found) == (disturbance == "ignored")
    assert ("known start" in found) == estimated
    assert any(n.startswith("observer gain") for n in found) == estimated
    assert ("lambda_V >= lambda_r" in found) == estimated
    assert ("lambda_V >= lambda_Vv" in found) == (estimated and volume)
    # Of a method without a volume row the volume is information.
    assert found["volume at the start"].holds == (True if volume else None)
    assert found["sampled input"].holds is None
    assert found["sampled input"].numbers == {"period": PERIOD}


def test_a_method_that_ignores_the_disturbance_needs_it_to_be_zero(car):
    assert at(car, "cbf-qp")["no disturbance"].holds is False
    assert at(car, "cbf-qp")["no disturbance"].numbers == {"delta1": 0.3}
    calm = at(car, "cbf-qp", bounds=DisturbanceBounds(0.0, 0.0, 0.0))
    assert calm["no disturbance"].holds is True


def test_noise_is_not_covered_by_the_proof(car):
    assert at(car, "dob-cbf-qp")["known start"].holds is True
    noisy = at(car, "dob-cbf-qp", noise=0.01)["known start"]
    assert noisy.holds is False and noisy.numbers == {"measurement noise": 0.01}


def test_what_the_printed_equations_leave_out_is_named(car):
    printed = at(car, "dob-vcbf-qp", fidelity="paper")
    assert printed["floor of the error bound"].holds is False
    assert printed["total derivative of the volume"].holds is False
    proven = at(car, "dob-vcbf-qp")
    assert "floor of the error bound" not in proven
    assert "total derivative of the volume" not in proven
    floor = Corrections(error_floor=True)
    partly = at(car, "dob-vcbf-qp", fidelity=floor)
    assert "floor of the error bound" not in partly
    assert "total derivative of the volume" in partly
    # Without a volume row there is no derivative to be wrong.
    assert "total derivative of the volume" not in at(
        car, "dob-cbf-qp", fidelity="paper"
    )
    assert "floor of the error bound" not in at(car, "vcbf-qp", fidelity="paper")


@pytest.mark.parametrize(("speed", "holds"), [(1.0, True), (15.0, True), (25.0, False)])
def test_the_start_lies_inside_every_phi(car, speed, holds):
    """The gains (4, 3) are rates of 3 and 1: phi_1 = h' + 3 h = 15 - v at x = 0."""
    found = at(car, "dob-cbf-qp", speed)
    start = next(a for n, a in found.items() if n.startswith("start inside"))
    assert start.numbers == pytest.approx({"phi_0": 5.0, "phi_1": 15.0 - speed})
    assert start.holds is holds


def test_a_limit_on_the_input_has_no_phi_to_start_in(car):
    found = at(car, "dob-cbf-qp", barriers=(STEERING, AHEAD))
    starts = [name for name in found if name.startswith("start inside")]
    assert len(starts) == 1 and "steering" not in starts[0]
    assert found["disturbance relative degree"].numbers == {"barriers": 2.0}


def test_input_authority_is_that_of_the_weakest_row(car):
    """The wall's row is [1/2, 0] u <= .. (2 kg), and the force's half-width 4 N."""
    authority = at(car, "dob-cbf-qp")["input authority"]
    assert authority.holds
    assert authority.numbers["least authority"] == pytest.approx(2.0)
    blocked = StateInputLimit(lambda x, t, p: (0.0 * x[:2], 1.0 + 0.0 * x[0]))
    powerless = at(car, "dob-cbf-qp", barriers=(AHEAD, blocked))["input authority"]
    assert powerless.holds is False
    assert powerless.numbers["least authority"] == pytest.approx(0.0, abs=1e-15)


def test_a_barrier_that_no_input_moves_is_no_empty_slot(car):
    """A wall to the left: at rest neither force nor turning moves the car sideways."""
    side = HalfSpace([0.0, -1.0], -5.0).barrier([4.0, 3.0])
    found = at(car, "dob-cbf-qp", speed=0.0, barriers=(side,))
    assert found["input authority"].holds is False
    assert found["input authority"].numbers == {"least authority": 0.0}
    (start,) = (a for name, a in found.items() if name.startswith("start inside"))
    assert start.numbers == pytest.approx({"phi_0": 5.0, "phi_1": 15.0})


def test_the_volume_at_the_start_is_compared_with_the_threshold(car):
    free = at(car, "dob-vcbf-qp", volume=VolumeBarrier(0.1, widening=1.0))
    assert free["volume at the start"].holds is True
    assert free["volume at the start"].numbers["threshold"] == 0.1
    assert free["volume at the start"].numbers["V_v(0)"] == pytest.approx(0.9)
    # At 4 m/s the force is left [-4, 2 (3 * 5 - 4 * 4 - 0.3)] = [-4, -2.6] N.
    fast = at(car, "dob-vcbf-qp", 4.0, volume=VolumeBarrier(0.2, widening=1.0))
    start = fast["volume at the start"]
    assert start.holds is False
    assert start.numbers["V_v(0)"] == pytest.approx(0.7 / 4.0 - 0.2, abs=1e-9)


def test_the_printed_weights_are_information(car):
    """delta1 = 0.3; phi_1(0) = -1 + 3 * 5 and V_v(0) = 1 - 0.1."""
    found = at(car, "dob-vcbf-qp", volume=VolumeBarrier(0.1, widening=1.0))
    assert found["beta_1"].holds is None and found["beta_2"].holds is None
    assert found["beta_1"].numbers == {"least beta_1": pytest.approx(0.09 / 28.0)}
    assert found["beta_2"].numbers == {"least beta_2": pytest.approx(0.09 / 1.8)}
    assert "beta_2" not in at(car, "dob-cbf-qp")
    outside = at(car, "dob-cbf-qp", speed=20.0)
    assert outside["beta_1"].numbers == {"least beta_1": np.inf}


def test_the_printed_orders_of_rates_are_information(car):
    found = at(car, "dob-vcbf-qp", volume=VolumeBarrier(gain=2.5))
    first, second = found["lambda_V >= lambda_r"], found["lambda_V >= lambda_Vv"]
    assert first.holds is None and second.holds is None
    # alpha = 5, gamma = 4 by default: lambda_V = min(alpha - 1, gamma).
    assert first.numbers == {"lambda_V": 4.0, "lambda_r": 1.0}
    assert second.numbers == {"lambda_V": 4.0, "lambda_Vv": 2.5}
    [slow] = StateLimit(2, upper=30.0).barriers([0.5])
    with_slow = at(car, "dob-vcbf-qp", barriers=(AHEAD, slow, STEERING))
    assert with_slow["lambda_V >= lambda_r"].numbers["lambda_r"] == 0.5
    without = at(car, "dob-vcbf-qp", barriers=(STEERING,))
    assert np.isnan(without["lambda_V >= lambda_r"].numbers["lambda_r"])
    linear = at(car, "wang-xu-dob-cbf-qp", observer=LinearDisturbanceObserver)
    assert "lambda_V >= lambda_r" not in linear


def test_gains_that_are_too_small_are_named_with_both_sides(car):
    def weak(model, period, bounds):
        settings = ObserverSettings(beta=0.1, uncertified=True)
        return RiseObserver(model, period, bounds, settings)

    found = at(car, "dob-cbf-qp", observer=weak)
    conditions = [a for n, a in found.items() if n.startswith("observer gain: ")]
    assert [a.holds for a in conditions] == [True, True, False]
    beta = conditions[-1]
    # (E32): delta2 + (1 + lambda_V T) delta3 / max(1, alpha - gamma).
    assert beta.numbers == pytest.approx({"left": 0.1, "right": 0.2 + 1.08 * 0.1})


def test_a_slow_plant_has_a_certified_hold(car):
    sampled = at(car, "dob-cbf-qp", between_ticks="certified")["sampled input"]
    assert sampled.holds is True
    assert sampled.numbers["period"] == PERIOD
    assert sampled.numbers["T abs(df/dx)"] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("drag", "period", "holds"),
    [(5.0, 0.1, True), (10.0, 0.1, False), (10.0, 0.05, True)],
)
def test_a_plant_too_fast_for_its_period_has_no_certified_hold(drag, period, holds):
    """V' = -10 v + u at 10 Hz: the run's least margin was minus infinity, unsaid."""
    plant = LinearSystem(
        [[0.0, 1.0], [0.0, -drag]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1))
    )
    model = ControlAffineModel.from_system(plant)
    wall = StateLimit(0, upper=5.0).barriers([4.0, 3.0])
    settings = FilterSettings(method="cbf-qp", period=period, between_ticks="certified")
    box = InputSet.box([-4.0], [4.0])
    bounds = DisturbanceBounds(0.0, 0.0, 0.0)
    safety_filter = SafetyFilter(
        model, wall, box, settings, bounds=bounds, make_row_holder=HeldRows
    )
    context = safety_filter.CreateDefaultContext()
    safety_filter.GetInputPort("state").FixValue(context, [0.0, 1.0])
    safety_filter.GetInputPort("reference").FixValue(context, [0.0])
    observer = RiseObserver(model, period, bounds)
    found = {each.name: each for each in assumptions(safety_filter, context, observer)}[
        "sampled input"
    ]
    assert found.holds is holds
    assert found.numbers["T abs(df/dx)"] == pytest.approx(drag * period, rel=1e-4)
    assert np.isinf(safety_filter.decision(context).row_margin) is np.bool_(not holds)


def test_the_volume_barrier_says_its_settings_and_whose_choice_they_are(car):
    """A tenth of det B is more than 0.02 at the start, 5 m before the wall."""
    default = at(car, "dob-vcbf-qp")["volume barrier"]
    assert default.holds is None
    assert default.numbers == {"widening": 8.0, "gain": 0.1, "threshold": 0.02}
    assert "are the default" in default.statement
    assert "a tenth of det B at the start" in default.statement
    given = at(car, "vcbf-qp", volume=VolumeBarrier(0.1, gain=3.0, widening=1.0))
    paper = given["volume barrier"]
    assert paper.numbers == {"widening": 1.0, "gain": 3.0, "threshold": 0.1}
    assert paper.statement == "widening and gain are given; the threshold is given"
    assert "volume barrier" not in at(car, "dob-cbf-qp")
