from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput
import pytest

from vcbf_drake import ScenarioError, load_scenario, make_loop, simulate
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.safety import FilterStatus
from vcbf_drake.safety.assumptions import assumptions
from vcbf_drake.simulation import Faults, MeasurementNoise, check_assumptions
from vcbf_drake.simulation.sensors import Sensor

BLIMP, CAR = "blimp-multiple-obstacles", "car-avoidance"
ARM = Path(__file__).parents[2] / "examples" / "arm.yaml"
PERIOD = 0.02
FAULTS = {
    "bias": "measurement_bias: [0.05, -0.05, 0.05, 0.02, 0, 0, 0, 0]",
    "delay": "measurement_delay: 0.04",
    "loss": "measurement_loss: 0.3",
    "sight": "sight: 1.5",
    "lag": "actuator_lag: 0.2",
    "limit": "actuator_limit: 0.6",
    "mass": "mass: 1.3",
    "drag": "drag: 0.7",
    "disturbance": "disturbance: 2.5",
    "gust": "gusts: [{amplitude: [0.0, 0.5, 0.0], start: 1.0, duration: 0.5}]",
    "solver": "solver_failure: 0.2",
    "process": "outage: 0.03, outage_duration: 0.2",
}


def run(faults, scenario=BLIMP, duration=2.0):
    overrides = (
        f"{{infeasible: least_violation, duration: {duration}, faults: {{{faults}}}}}"
    )
    return simulate(load_scenario(scenario, overrides), step_time=False)


@pytest.fixture(scope="module")
def healthy():
    return run("")


@pytest.mark.parametrize("fault", FAULTS)
def test_under_every_fault_inputs_are_legal_and_the_run_is_not_guaranteed(fault):
    result = run(FAULTS[fault])
    limits = result.scenario.input_set.input_set()
    assert all(limits.contains(u) for u in result.log["input"])
    assert np.isfinite(result.log["disturbance_estimate"]).all()
    assert not result.summary["guaranteed"]
    reasons = result.summary["reasons_against"]
    assert any(reason.startswith("hypothesis: ") for reason in reasons)


def test_without_faults_no_system_is_added():
    def names(overrides):
        loop = make_loop(load_scenario(BLIMP, overrides))
        return {system.get_name() for system in loop.GetSystems()}

    added = {
        "bias": {"sensor"},
        "delay": {"sensor"},
        "loss": {"sensor"},
        "lag": {"actuator_lag"},
        "limit": {"actuator_limit"},
        "gust": {"gust_0", "with_gust_0"},
        "solver": {"lost_answers"},
        "process": {"lost_answers"},
        "mass": set(),
    }
    for fault, systems in added.items():
        assert names(f"{{faults: {{{FAULTS[fault]}}}}}") - names({}) == systems


class Ramp(LeafSystem):
    """x = (t + 1, -t), as a state would be."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("state", 2, self.calc)

    def calc(self, context, output: BasicVector):
        output.SetFromVector([context.get_time() + 1.0, -context.get_time()])


def sensor(size=2, **faults):
    return Sensor(size, PERIOD, MeasurementNoise(), Faults(**faults))


def sampled(system):
    builder = DiagramBuilder()
    source = builder.AddSystem(Ramp())
    builder.AddSystem(system)
    builder.Connect(source.get_output_port(), system.get_input_port())
    log = LogVectorOutput(system.get_output_port(), builder, PERIOD)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(2.0)
    found = log.FindLog(simulator.get_context())
    return found.sample_times(), found.data()


@pytest.mark.parametrize(("delay", "ticks"), [(0.04, 2), (0.05, 3), (PERIOD, 1)])
def test_a_measurement_arrives_as_late_as_asked(delay, ticks):
    time, data = sampled(sensor(measurement_delay=delay))
    sent = np.maximum(time - ticks * PERIOD, 0.0)
    np.testing.assert_allclose(data, [sent + 1.0, -sent], atol=1e-12)


def test_a_lost_measurement_is_the_last_one_that_arrived():
    time, data = sampled(sensor(measurement_loss=0.4, seed=3))
    arrived = np.isclose(data[0], time + 1.0)
    assert arrived[0] and 0.45 < arrived.mean() < 0.75
    last = np.maximum.accumulate(np.where(arrived, time, 0.0))
    np.testing.assert_allclose(data, [last + 1.0, -last], atol=1e-12)


def test_of_late_measurements_the_lost_ones_never_arrive():
    both = {"measurement_loss": 0.4, "measurement_delay": 2 * PERIOD}
    time, data = sampled(sensor(seed=3, **both))
    _, prompt = sampled(sensor(measurement_loss=0.4, seed=3))
    late = np.column_stack([prompt[:, :1], prompt[:, :1], prompt[:, :-2]])
    assert len(time) == late.shape[1]
    np.testing.assert_allclose(data, late, atol=1e-12)


def test_what_is_lost_is_the_same_for_everybody_at_a_tick():
    system = sensor(1, measurement_loss=0.5, seed=1)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, [7.0])
    for tick in range(20):
        context.SetTime(tick * PERIOD)
        before = system.get_output_port().Eval(context).copy()
        update = system.AllocateDiscreteVariables()
        system.CalcForcedDiscreteVariableUpdate(context, update)
        context.SetDiscreteState(update)
        np.testing.assert_array_equal(system.get_output_port().Eval(context), before)
        system.get_input_port().FixValue(context, [float(tick)])


def test_the_true_plant_is_heavier_and_the_model_is_not(healthy):
    heavy = run(FAULTS["mass"], duration=PERIOD)
    # At rest a force F accelerates by F / m: the speeds of the first tick tell.
    u, d = heavy.log["input"][0], heavy.log["disturbance"][0]
    np.testing.assert_array_equal(u, healthy.log["input"][0])
    vertical = 4 + 2
    speed = heavy.log["state"][1, vertical] - d[2] * PERIOD
    light = healthy.log["state"][1, vertical] - d[2] * PERIOD
    assert light / speed == pytest.approx(1.3, rel=0.02)


def test_the_true_disturbance_is_the_scaled_one_with_its_gust(healthy):
    faults = f"disturbance: 2.5, {FAULTS['gust']}"
    found = run(faults).log
    declared = healthy.log["disturbance"]
    during = (found["time"] >= 1.0 - 1e-9) & (found["time"] < 1.5 - 1e-9)
    gust = 0.5 * during[:, None] * np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(found["disturbance"], 2.5 * declared + gust, atol=1e-12)


def plant_inputs(faults):
    overrides = f"{{infeasible: least_violation, faults: {{{faults}}}}}"
    scenario = load_scenario(BLIMP, overrides)
    diagram = make_loop(scenario)
    plant = diagram.GetSubsystemByName("plant")
    hold = diagram.GetSubsystemByName("filter_hold")
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    applied = []
    for tick in range(1, 60):
        simulator.AdvanceTo(tick * PERIOD - 1e-6)
        held = hold.get_output_port().Eval(hold.GetMyContextFromRoot(context))
        port = plant.GetInputPort("input")
        applied.append((held, port.Eval(plant.GetMyContextFromRoot(context))))
    return np.array(applied).transpose(1, 0, 2), scenario.input_set


def test_actuators_reach_a_share_of_the_limits():
    (held, applied), limits = plant_inputs("actuator_limit: 0.6")
    low, high = 0.6 * np.array(limits.lower), 0.6 * np.array(limits.upper)
    np.testing.assert_allclose(applied, np.clip(held, low, high), atol=1e-12)
    assert np.abs(held - applied).max() > 0.01


def test_actuators_follow_with_their_time_constant():
    (held, applied), _ = plant_inputs("actuator_lag: 0.1")
    decay = np.exp(-PERIOD / 0.1)
    expected = np.zeros(3)
    for k in range(len(held)):
        expected = held[k] + (expected - held[k]) * decay
        np.testing.assert_allclose(applied[k], expected, rtol=1e-3, atol=1e-5)


def test_solvers_fail_at_the_share_asked_for_and_repeatably():
    first, again = run(FAULTS["solver"]), run(FAULTS["solver"])
    failed = first.log["status"] == FilterStatus.FAILED
    assert 0.1 < failed.mean() < 0.3
    np.testing.assert_array_equal(first.log["input"], again.log["input"])
    assert first.summary["failed_ticks"] == failed.sum()


def test_an_obstacle_has_no_row_until_it_is_near():
    result = run("sight: 1.0", CAR, duration=6.0)
    obstacle = result.scenario.obstacles[0]
    away = result.log["state"][:, :2] - np.array(obstacle.center)
    distance = np.linalg.norm(away, axis=1) - obstacle.radius
    seen = distance <= 1.0
    assert 0 < seen.sum() < len(seen)
    np.testing.assert_array_equal(~np.isnan(result.log["barriers"][:, 0]), seen)
    assert result.summary["rows_without_authority"] == []
    # The audit and the summary know of it all the same.
    assert result.summary["min_barrier"] > 0.0
    squared = np.sum(away**2, axis=1) - (obstacle.radius + obstacle.margin) ** 2
    assert result.summary["audit"]["barrier"]["worst"] == pytest.approx(squared.min())


def test_there_may_be_more_slots_than_obstacles_but_not_fewer():
    overrides = "{{duration: 1.0, faults: {{sight: 5.0}}, hardware: {}}}".format
    known = simulate(load_scenario(CAR, overrides("{obstacles: known}")))
    slots = "{obstacles: perceived, most_obstacles: 4}"
    more = simulate(load_scenario(CAR, overrides(slots)))
    np.testing.assert_array_equal(more.log["input"], known.log["input"])
    assert np.isnan(more.log["barriers"][:, 1:]).all()

    spheres = [{"center": [x, 0.5], "radius": 0.1} for x in (3.0, 4.0)]
    few = overrides("{obstacles: perceived, most_obstacles: 1}")
    scenario = load_scenario(CAR, few)
    scenario.obstacles = load_scenario(CAR, {"obstacles": spheres}).obstacles
    with pytest.raises(InvalidValueError, match=r"most_obstacles: 1; .* at least 2"):
        make_loop(scenario)


@pytest.mark.parametrize(
    ("faults", "problem"),
    [
        (
            "measurement_loss: 1.5",
            "faults.measurement_loss: 1.5; it must be from 0",
        ),
        (
            "measurement_delay: -1.0",
            "faults.measurement_delay: -1; it must",
        ),
        ("actuator_limit: 0.0", r"faults.actuator_limit: 0; it must be .* above 0"),
        ("mass: 0.0", "faults.mass: 0; it must be finite and above 0"),
        ("measurement_bias: [1.0]", r"faults.measurement_bias: \[1.0\]; it must be 8"),
        ("gusts: [{amplitude: [1.0]}]", r"faults.gusts\[0\].amplitude: \[1.0\]"),
        ("gust: 1", "faults.gust: unknown key; did you mean gusts"),
    ],
)
def test_bad_faults_are_refused_by_name(faults, problem):
    with pytest.raises(ScenarioError, match=problem):
        load_scenario(BLIMP, f"{{faults: {{{faults}}}}}")


def test_a_car_has_no_drag_to_be_wrong():
    with pytest.raises(ScenarioError, match=r"faults\.drag: 0\.7; it must be 1"):
        load_scenario(CAR, "{faults: {drag: 0.7}}")


def test_a_killed_process_asks_for_nothing_and_starts_anew():
    result = run("outage: 0.02, outage_duration: 0.2, seed: 3", duration=4.0)
    log, limits = result.log, result.scenario.input_set.input_set()
    down = log["status"] == FilterStatus.FAILED
    starts = np.flatnonzero(~down[:-1] & down[1:]) + 1
    assert 1 <= len(starts)
    for start in starts[:-1]:
        assert down[start : start + 10].all()  # 0.2 s at least
    nothing = limits.project(np.zeros(limits.num_inputs))
    assert (log["input"][down] == nothing).all()
    # The tick after an outage only takes the state: no disturbance is known.
    up = np.flatnonzero(down[:-1] & ~down[1:]) + 1
    assert len(up)
    assert not log["disturbance_estimate"][up].any()
    assert (log["error_bound"][up] == log["error_bound"][0]).all()
    assert log["disturbance_estimate"][up[0] + 20].any()
    assert "hypothesis: process at every tick" in result.summary["reasons_against"]


def test_an_outage_is_a_function_of_the_tick():
    loops = [run("outage: 0.02, seed: 3", duration=1.0).log for _ in range(2)]
    assert np.array_equal(loops[0]["input"], loops[1]["input"])


def test_an_empty_slot_starts_nowhere():
    overrides = "{obstacles: [{center: [9.0, 9.0], radius: 0.2}], faults: {sight: 0.5}}"
    loop = make_loop(load_scenario(CAR, overrides))
    safety_filter = loop.GetSubsystemByName("filter")
    context = loop.CreateDefaultContext()
    observer = loop.GetSubsystemByName("filter_observer")
    found = {
        each.name: each
        for each in assumptions(
            safety_filter, safety_filter.GetMyContextFromRoot(context), observer
        )
    }
    assert not any(name.startswith("start inside: seen obstacle") for name in found)
    assert found["input authority"].holds is not False


@pytest.mark.parametrize("method", ["cbf-qp", "dob-vcbf-qp"])
@pytest.mark.parametrize("scenario", [CAR, ARM])
def test_a_noisy_measurement_is_not_the_state(method, scenario):
    base = load_scenario(scenario, {"method": method})
    base.noise.std = [1e-3] * len(base.initial_state)
    broken = [each.name for each in check_assumptions(base) if each.holds is False]
    assert "true measurement" in broken


@pytest.mark.parametrize(
    "fault",
    ["disturbance: 2.0", "gusts: [{amplitude: [], start: 0.0, duration: 0.1}]"],
)
def test_a_robot_that_nothing_disturbs_has_no_faulty_disturbance(fault):
    result = run(fault, ARM, duration=0.1)
    assert result.log["disturbance"].shape[1] == 0
