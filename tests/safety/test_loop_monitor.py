"""What a filter knows of its loop is told: at the start, and when nothing is safe."""

import logging

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LinearSystem
import pytest

from vcbf_drake import (
    AddSafetyFilter,
    Car,
    ControlAffineModel,
    DisturbanceBounds,
    FilterSettings,
    HalfSpace,
    InputSet,
    ObserverSettings,
    RiseObserver,
    SafetyFilter,
    SphereObstacle,
    StateLimit,
    VolumeBarrier,
    load_scenario,
    simulate,
)
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.simulation import make_loop

CALM = DisturbanceBounds(0.0, 0.0, 0.0)
LIMITS = InputSet.box([-1.0, -0.5], [1.0, 0.5])


def car_loop(barriers, start, volume=None, wind=0.0, **settings):
    """A simulator of a car that is left alone, at its start, declared to be calm."""
    builder = DiagramBuilder()
    car = builder.AddSystem(Car())
    idle = builder.AddSystem(ConstantVectorSource([0.0, 0.0]))
    calm = builder.AddSystem(ConstantVectorSource([wind]))
    builder.Connect(calm.get_output_port(), car.GetInputPort("disturbance"))
    AddSafetyFilter(
        builder,
        plant=car,
        reference=idle.get_output_port(),
        barriers=barriers,
        input_set=LIMITS,
        bounds=CALM,
        settings=FilterSettings(volume=volume or VolumeBarrier(), **settings),
    )
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    car.GetMyMutableContextFromRoot(context).SetContinuousState(start)
    return simulator


def warned(caplog, simulator, time=0.0):
    with caplog.at_level(logging.WARNING, logger="vcbf_drake"):
        status = simulator.AdvanceTo(time)
    return [each.getMessage() for each in caplog.records], status


AHEAD = SphereObstacle([5.0, 0.0], 1.0).barrier([4.0, 3.0], name="post")
BESIDE = HalfSpace([0.0, -1.0], -5.0).barrier([4.0, 3.0], name="kerb")


def test_a_sound_loop_says_nothing(caplog):
    lines, _ = warned(caplog, car_loop([AHEAD], [0.0, 0.0, 0.5, 0.0]), 0.1)
    assert lines == []


@pytest.mark.parametrize(
    ("barrier", "start", "words"),
    [
        (AHEAD, [5.5, 0.0, 0.0, 0.0], ("start inside: post", "= -0.5", "outside it")),
        (AHEAD, [3.5, 0.0, 2.0, 0.0], ("start inside: post", "phi_1", "slower")),
        # At rest nothing moves a car sideways.
        (BESIDE, [0.0, 0.0, 0.0, 0.0], ("input authority", "= 0)", "(kerb)")),
    ],
)
def test_what_fails_at_the_start_is_said_once_in_one_line(
    caplog, barrier, start, words
):
    lines, _ = warned(caplog, car_loop([barrier], start, method="cbf-qp"), 0.1)
    about_start = [line for line in lines if "does not hold" in line.split(":", 2)[1]]
    found = [line for line in lines if all(word in line for word in words)]
    assert len(found) == 1 and found[0].startswith("filter: ")
    assert all("\n" not in line for line in lines)
    assert len(about_start) <= 2


def test_a_threshold_that_the_start_does_not_have_is_said_with_one_to_take(caplog):
    """The rows of speed leave a share of the box: V_v(0) < 0 at threshold 0.9."""
    slow = StateLimit(2, -0.2, 0.2).barriers([1.0], "speed")
    limit = VolumeBarrier(threshold=0.9, widening=1.0)
    loop = car_loop(slow, [0.0] * 4, limit, method="vcbf-qp")
    (line,), _ = warned(caplog, loop)
    # abs(u_0) <= 2 kg * 0.2 of 1 N: det B = 0.4.
    assert "volume at the start does not hold (V_v(0) = -0.5, threshold = 0.9)" in line
    assert "take a threshold below 0.4" in line


def test_a_volume_that_falls_below_its_threshold_is_said_once(caplog):
    """At 0.5 m/s the rows ask for -1 <= u_0 <= -0.6 of 1 N: det B = 0.2 - 0.3 < 0."""
    slow = StateLimit(2, -0.2, 0.2).barriers([1.0], "speed")
    barrier = VolumeBarrier(threshold=0.3, gain=100.0, widening=1.0)
    loop = car_loop(slow, [0.0] * 4, barrier, method="vcbf-qp")
    lines, _ = warned(caplog, loop, 0.05)
    assert lines == []
    loop.get_mutable_context().SetContinuousState([0.0, 0.0, 0.5, 0.0])
    lines, _ = warned(caplog, loop, 0.2)
    (line,) = [each for each in lines if "V_v" in each]
    assert "V_v is below 0 at 0.06 s" in line and "RELAXED" in line


@pytest.mark.parametrize(
    ("speed", "widening", "determinant", "threshold"),
    [
        (0.2, 1.0, 0.4, 0.02),
        (0.01, 1.0, 0.02, 0.002),
        (1e-4, 1.0, 2e-4, 2e-5),
        (0.2, 8.0, 0.05, 0.005),
    ],
)
def test_a_threshold_left_out_is_a_tenth_of_the_start(
    caplog, speed, widening, determinant, threshold
):
    """abs(u_0) <= 2 kg * speed of 1 N, and it stays when the set changes later.

    Rows on both sides leave the width of a widened set as it is, so the share of it is
    a `widening`-th.
    """
    slow = StateLimit(2, -speed, speed).barriers([1.0], "speed")
    barrier = VolumeBarrier(widening=widening)
    loop = car_loop(slow, [0.0] * 4, barrier, method="vcbf-qp")
    lines, _ = warned(caplog, loop, 0.05)
    assert lines == []
    safety_filter = loop.get_system().GetSubsystemByName("filter")
    context = safety_filter.GetMyContextFromRoot(loop.get_context())
    assert safety_filter.threshold(context) == pytest.approx(threshold)
    volume = safety_filter.GetOutputPort("volume").Eval(context)[0]
    assert volume == pytest.approx(determinant - threshold)
    root = loop.get_mutable_context()
    root.SetContinuousState([0.0, 0.0, 0.9 * speed, 0.0])
    found = safety_filter.threshold(safety_filter.GetMyContextFromRoot(root))
    assert found == pytest.approx(threshold)


@pytest.mark.parametrize("policy", ["stop", "least_violation"])
def test_an_infeasible_tick_names_its_rows_and_what_failed_at_the_start(caplog, policy):
    fast = [2.0, 0.0, 7.0, 0.0]
    loop = car_loop([AHEAD], fast, method="cbf-qp", infeasible=policy)
    lines, status = warned(caplog, loop, 0.5)
    about = [line for line in lines if "no feasible input at" in line]
    if policy == "stop":
        assert status.return_time() < 0.5
        (about,) = [status.FormatMessage()] if not about else [about]
    else:
        assert status.return_time() == 0.5
        (about,) = about  # Once, however many ticks there are.
    assert "lower limit of input 0" in about and "post" in about
    assert "at the start: start inside: post does not hold" in about


def test_stop_stops_at_a_failed_tick_too():
    centre = car_loop([AHEAD], [5.0, 0.0, 0.0, 0.0], infeasible="stop")
    status = centre.AdvanceTo(1.0)
    assert status.return_time() == 0.0
    assert "FAILED at 0 s: data are not finite" in status.FormatMessage()


def test_a_scenario_that_stops_at_a_failed_tick_is_not_called_infeasible():
    overrides = "{duration: 2.0, faults: {solver_failure: 0.5}}"
    summary = simulate(load_scenario("car-avoidance", overrides)).summary
    assert summary["outcome"] == "failed" and summary["conflict"] is None
    assert summary["failed_ticks"] == 1 and summary["running_time"] < 1.0


def test_uncertified_gains_are_said_at_the_start(caplog):
    """Beta > delta2 + (1 + lambda_V T) delta3 / max(1, alpha - gamma): 1 > 9 + .."""
    builder = DiagramBuilder()
    car = builder.AddSystem(Car())
    model = ControlAffineModel.from_system(car)
    bounds = DisturbanceBounds(1.0, 9.0, 9.0)
    with pytest.raises(ValueError, match="uncertified"):
        RiseObserver(model, 0.02, bounds, ObserverSettings(beta=1.0))
    weak = ObserverSettings(beta=1.0, uncertified=True)
    idle = builder.AddSystem(ConstantVectorSource([0.0, 0.0]))
    calm = builder.AddSystem(ConstantVectorSource([0.0]))
    builder.Connect(calm.get_output_port(), car.GetInputPort("disturbance"))
    AddSafetyFilter(
        builder,
        plant=car,
        reference=idle.get_output_port(),
        barriers=[AHEAD],
        input_set=LIMITS,
        bounds=bounds,
        observer=RiseObserver(model, 0.02, bounds, weak),
    )
    lines, _ = warned(caplog, Simulator(builder.Build()))
    (line,) = [line for line in lines if "observer gain: beta >" in line]
    assert "left = 1, right = 18.7" in line and "leave the gains out" in line


def test_a_scenarios_log_is_its_summary(caplog):
    with caplog.at_level(logging.WARNING, logger="vcbf_drake"):
        scenario = load_scenario("car-avoidance", {"infeasible": "hold"})
        loop = make_loop(scenario)
        Simulator(loop).Initialize()
    assert not loop.HasSubsystemNamed("filter_loop_monitor")
    assert caplog.records == []


def free_mass():
    return LinearSystem(
        [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1))
    )


def add(builder, plant, **options):
    push = builder.AddSystem(ConstantVectorSource([1.0]))
    return AddSafetyFilter(
        builder,
        plant=plant,
        reference=push.get_output_port(),
        barriers=StateLimit(0, upper=1.0).barriers([4.0, 3.0]),
        input_set=InputSet.box([-2.0], [2.0]),
        **options,
    )


def test_a_plant_without_a_disturbance_needs_no_bounds():
    builder = DiagramBuilder()
    plant = builder.AddSystem(free_mass())
    add(builder, plant)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(5.0)
    assert 0.9 < simulator.get_context().get_continuous_state_vector()[0] <= 1.0
    builder = DiagramBuilder()
    car = builder.AddSystem(Car())
    for wrong, words in (
        (None, "for the plant has a disturbance"),
        ([0.1, 0.1, 0.1], "a DisturbanceBounds"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            add(builder, car, bounds=wrong)


def test_a_second_filter_has_a_name_of_its_own():
    builder = DiagramBuilder()
    loops = [add(builder, builder.AddSystem(free_mass())) for _ in range(3)]
    names = [each.filter.get_name() for each in loops]
    assert names == ["filter", "filter_2", "filter_3"]
    builder.Build()
    builder = DiagramBuilder()
    add(builder, builder.AddSystem(free_mass()), name="guard")
    with pytest.raises(InvalidValueError, match="name: 'guard'; it must be new"):
        add(builder, builder.AddSystem(free_mass()), name="guard")


def test_a_scenario_runs_by_its_name():
    overrides = load_scenario("car-avoidance", {"duration": 0.2})
    by_name = simulate("car-avoidance", progress=None, step_time=False)
    assert by_name.scenario == load_scenario("car-avoidance")
    assert overrides.duration < by_name.log["time"][-1]


@pytest.mark.parametrize(("drag", "is_told"), [(5.0, False), (10.0, True)])
def test_a_plant_too_fast_for_a_certified_hold_is_told(caplog, drag, is_told):
    """Where the period times the slope of dx/dt is 1, the option has no effect."""
    builder = DiagramBuilder()
    matrices = [[0.0, 1.0], [0.0, -drag]], [[0.0], [1.0]]
    plant = builder.AddSystem(LinearSystem(*matrices, np.eye(2), np.zeros((2, 1))))
    idle = builder.AddSystem(ConstantVectorSource([0.0]))
    AddSafetyFilter(
        builder,
        plant=plant,
        reference=idle.get_output_port(),
        barriers=StateLimit(0, upper=5.0).barriers([4.0, 3.0]),
        input_set=InputSet.box([-1.0], [1.0]),
        bounds=CALM,
        settings=FilterSettings(method="cbf-qp", period=0.1, between_ticks="certified"),
    )
    lines, _ = warned(caplog, Simulator(builder.Build()))
    assert any("certified does nothing" in line for line in lines) is is_told


def test_an_observer_that_refuses_what_is_measured_is_told_once(caplog):
    """A wind of 0.4 m/s^2 where none was declared: no interval is believed."""
    loop = car_loop([BESIDE], [0.0, 0.0, 0.5, 0.0], wind=0.4)
    lines, _ = warned(caplog, loop, 1.0)
    (line,) = [each for each in lines if "refuses most intervals" in each]
    assert "by 0.2 s" in line or "by 0.22 s" in line
    assert "check the bounds" in line


def test_a_state_that_is_not_finite_is_said_and_nothing_misleading(caplog):
    loop = car_loop([AHEAD], [np.nan, 0.0, 0.5, 0.0], method="vcbf-qp")
    with caplog.at_level(logging.WARNING, logger="vcbf_drake"):
        loop.Initialize()  # Drake's integrator would never get anywhere.
    about_start, about_tick = [each.getMessage() for each in caplog.records]
    assert "is the measured state finite" in about_start
    assert "FAILED at 0 s: data are not finite" in about_tick


def test_the_first_tick_is_decided_once(monkeypatch):
    """Its threshold is known before its decision: a certified one takes its time."""
    decided = []
    calc = SafetyFilter._calc_decision

    def counted(self, context):
        decided.append(context.get_time())
        return calc(self, context)

    monkeypatch.setattr(SafetyFilter, "_calc_decision", counted)
    loop = car_loop([AHEAD], [0.0, 0.0, 0.5, 0.0], between_ticks="certified")
    loop.AdvanceTo(0.05)
    assert decided == pytest.approx([0.0, 0.02, 0.04])


def test_a_plan_that_is_lost_is_told_once(caplog):
    """A wind of 0.2 m/s^2, where none was declared, pushes a car at a wall."""
    # The brakes give 0.5 m/s^2: 1 m to rest from 1 m/s in a calm.
    wall = SphereObstacle((1.6, 0.0), 0.5).barrier([400.0, 40.0])
    loop = car_loop([wall], [0.0, 0.0, 1.0, 0.0], wind=0.2, infeasible="backup")
    lines, _ = warned(caplog, loop, 1.5)
    about = [line for line in lines if "no certified plan at" in line]
    assert len(about) == 1
    assert not [line for line in lines if "certified plan does not hold" in line]


def test_a_plan_that_is_missing_from_the_start_is_told_there_alone(caplog):
    wall = SphereObstacle((1.0, 0.0), 0.5).barrier([4.0, 3.0])
    loop = car_loop([wall], [0.0, 0.0, 1.5, 0.0], infeasible="backup")
    lines, _ = warned(caplog, loop, 0.1)
    assert [line for line in lines if "certified plan does not hold" in line]
    assert not [line for line in lines if "no certified plan at" in line]
