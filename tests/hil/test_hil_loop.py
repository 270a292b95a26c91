"""Both halves over memq://: the same run bit for bit, and that of a simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    ZeroOrderHold,
)
import pytest

from vcbf_drake import (
    AddSafetyFilter,
    BlimpController,
    Car,
    InputSet,
    SphereObstacle,
    load_scenario,
    simulate,
)
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.errors import InvalidValueError, ModelError, ScenarioError
from vcbf_drake.hil import (
    Bus,
    ControllerProcess,
    InProcess,
    SimulatedClock,
    VehicleLink,
    make_hardware_loop,
    make_vehicle,
)
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.simulation import barriers
from vcbf_drake.simulation.loop import add_simulated_plant, make_observer
from vcbf_drake.simulation.run import make_simulator

EXAMPLES = Path(__file__).parents[2] / "examples"
CASES = [("blimp-multiple-obstacles", 6.0), ("car-avoidance", 4.0)]
OTHERS = [(EXAMPLES / "arm.yaml", 1.0), (EXAMPLES / "quadrotor_slalom.py", 1.0)]


def scenario(name: str, **overrides):
    """A shipped scenario whose observer and margins are those of a simulation."""
    loaded = load_scenario(name, overrides)
    loaded.hardware.longest_interval = loaded.period
    return loaded


def path(plant) -> tuple[np.ndarray, np.ndarray]:
    """Times and states at every integrator step."""
    log = plant.diagram.GetSubsystemByName("log_path").FindLog(plant.context)
    return log.sample_times().copy(), log.data().T.copy()


def in_process(loaded, duration: float) -> tuple[np.ndarray, np.ndarray]:
    run = InProcess(loaded)
    run.advance_to(duration)
    return path(run.plant)


@pytest.mark.parametrize(("name", "duration"), CASES + OTHERS)
def test_lockstep_is_the_simulation(name: str, duration: float) -> None:
    times, states = in_process(scenario(name, duration=duration), duration)
    log = simulate(scenario(name, duration=duration), step_time=False).log
    # The observer is told an integral, whose difference rounds; all else is the same.
    for k in range(states.shape[1]):
        found = np.interp(log["time"], times, states[:, k])
        np.testing.assert_allclose(found, log["state"][:, k], rtol=0, atol=1e-9)


def test_a_vehicle_arrives_within_a_tenth_of_its_way_where_nothing_is_said() -> None:
    early = {"target": [0.4, -0.4], "volume": {"widening": 1.0, "gain": 3.0}}
    loaded = load_scenario(EXAMPLES / "own_robot.py", early)
    assert loaded.arrival_tolerance is None
    run = InProcess(loaded)
    run.advance_to(1.0)
    assert run.plant.report()["reached_at"] is None
    run.advance_to(8.0)
    found = run.plant.report()
    times, states = path(run.plant)
    away = np.hypot(states[:, 0] - 0.4, states[:, 1] + 0.4)
    first = times[np.argmax(away <= 0.1 * np.hypot(0.4, 0.4))]
    assert found["reached_at"] == first > 1.0
    assert found["outcome"] == "reached"


def test_lockstep_repeats_bit_for_bit() -> None:
    (times, first), (again, second) = (
        in_process(scenario("blimp-multiple-obstacles"), 2.0) for _ in range(2)
    )
    assert times.tobytes() == again.tobytes()
    assert first.tobytes() == second.tobytes()
    assert np.ptp(first[:, 0]) > 0.5


def both_halves_in_one_diagram(name: str, duration: float) -> np.ndarray:
    """The states at the ticks when a simulator drives both halves."""
    loaded, clock, lcm = scenario(name), SimulatedClock(), DrakeLcm("memq://")
    builder, bus = DiagramBuilder(), Bus(lcm, clock)
    builder.AddNamedSystem("controller", make_hardware_loop(loaded, bus))
    vehicle = builder.AddNamedSystem("vehicle", make_vehicle(loaded, bus))
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    fixed = SimulatorConfig(max_step_size=min(loaded.period, 0.01))
    fixed.use_error_control = False
    ApplySimulatorConfig(fixed, simulator)
    context.SetAccuracy(1e-4)
    plant = vehicle.GetSubsystemByName("plant")
    end = vehicle.GetSubsystemByName("vehicle_end")
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant_context.SetContinuousState(loaded.initial_state)
    states = []
    for tick in range(round(duration / loaded.period) + 1):
        clock.now = end.utime(tick * loaded.period)
        simulator.AdvanceTo(tick * loaded.period)
        bus.poll()  # Messages arrive at the tick, not when the next step begins.
        states.append(plant_context.get_continuous_state_vector().CopyToVector())
    return np.array(states)


def simulation_with_a_second_hold(name: str, duration: float) -> np.ndarray:
    """The states at the ticks when every command comes one control period late."""
    loaded = scenario(name)
    builder = DiagramBuilder()
    simulated = add_simulated_plant(builder, loaded)
    plant, bounds = simulated.plant, simulated.source.bounds
    model = ControlAffineModel.from_system(plant)
    late = builder.AddSystem(ZeroOrderHold(loaded.period, model.num_inputs))
    pilot = builder.AddSystem(loaded.vehicle.make_controller(loaded.target))
    builder.Connect(simulated.state, pilot.GetInputPort("state"))
    added = AddSafetyFilter(
        builder,
        plant=None,
        model=model,
        state=simulated.state,
        applied_input=late.get_output_port(),
        reference=pilot.GetOutputPort("reference"),
        barriers=barriers(loaded),
        input_set=loaded.input_set.input_set(),
        bounds=bounds,
        settings=loaded,
        observer=make_observer(loaded, model, bounds, period=loaded.period),
    )
    builder.Connect(added.hold.get_output_port(), late.get_input_port())
    builder.Connect(late.get_output_port(), plant.GetInputPort("input"))
    builder.Connect(
        added.observer.GetOutputPort("disturbance_estimate"),
        pilot.GetInputPort("disturbance_estimate"),
    )
    log = LogVectorOutput(simulated.state, builder, loaded.period)
    diagram = builder.Build()
    simulator = make_simulator(diagram, loaded)
    simulator.AdvanceTo(duration)
    return log.FindLog(simulator.get_context()).data().T


@pytest.mark.parametrize(("name", "duration"), CASES)
def test_one_diagram_is_the_simulation_one_period_late(name, duration) -> None:
    found = both_halves_in_one_diagram(name, duration)
    expected = simulation_with_a_second_hold(name, duration)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    again = both_halves_in_one_diagram(name, 1.0)
    assert found[: len(again)].tobytes() == again.tobytes()
    on_time = simulate(scenario(name, duration=duration), step_time=False).log["state"]
    assert np.abs(found - on_time).max() > 1e-4


@pytest.mark.parametrize(
    "faults",
    [
        {"mass": 1.3, "measurement_bias": [0.05, 0.0, 0.02, 0.0]},
        {"disturbance": 1.5, "actuator_lag": 0.1, "actuator_limit": 0.5},
        {"measurement_delay": 0.05},
        {"measurement_loss": 0.2, "seed": 3},
        {"solver_failure": 0.3, "seed": 1},
        {"outage": 0.02, "outage_duration": 0.2, "seed": 2},
    ],
    ids=lambda faults: next(iter(faults)),
)
def test_faults_do_to_two_processes_what_they_do_to_a_simulation(faults) -> None:
    """Whichever half each is in: the vehicle, its sensors, or the filter."""
    chosen = {
        "faults": faults,
        "duration": 1.0,
        "infeasible": "least_violation",
        "hardware": {"audit": "report"},
    }
    times, states = in_process(scenario("car-avoidance", **chosen), 1.0)
    log = simulate(scenario("car-avoidance", **chosen), step_time=False).log
    for k in range(states.shape[1]):
        found = np.interp(log["time"], times, states[:, k])
        np.testing.assert_allclose(found, log["state"][:, k], rtol=0, atol=1e-9)


def test_a_tick_whose_solvers_fail_asks_for_the_fallback_where_it_stops() -> None:
    run = InProcess(scenario("car-avoidance", faults={"solver_failure": 0.3}))
    run.advance_to(1.0)
    report = run.controller.report()
    reasons = {c["reason"] for c in report["changes"] if c["mode"] == "fallback"}
    assert report["failed_ticks"] > 5
    assert reasons == {"the filter's tick FAILED"}
    assert not report["findings"]


def test_a_fault_that_only_a_simulation_has_is_refused() -> None:
    with pytest.raises(
        InvalidValueError, match=r"^faults\.sight: 2\.5; it must be 0 on"
    ):
        InProcess(scenario("car-avoidance", faults={"sight": 2.5}))


def test_time_limits_below_the_period_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"hardware\.command_timeout: 0\.001; it"):
        load_scenario("car-avoidance", {"hardware": {"command_timeout": 1e-3}})


def test_a_low_rate_is_simulated_and_asks_a_bus_for_longer_time_limits() -> None:
    loaded = load_scenario("car-avoidance", {"period": 0.1})
    with pytest.raises(
        InvalidValueError, match=r"^hardware\.command_timeout: 0\.1; .*0\.1 s"
    ):
        InProcess(loaded)


def test_a_rate_that_no_inbox_believes_is_refused() -> None:
    loaded = load_scenario("car-avoidance")
    loaded.period = 1e-7  # As --rate does.
    with pytest.raises(
        InvalidValueError, match=r"^period: 1e-07; .* at least 0\.0001 s"
    ):
        InProcess(loaded)


def test_a_plant_elsewhere_needs_its_model_and_a_state() -> None:
    builder = DiagramBuilder()
    pilot = builder.AddSystem(BlimpController([1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="model and state must be given"):
        AddSafetyFilter(
            builder,
            plant=None,
            reference=pilot.GetOutputPort("reference"),
            barriers=[],
            input_set=InputSet.box([-1.0] * 3, [1.0] * 3),
            bounds=DisturbanceBounds(0.0, 0.0, 0.0),
        )


def test_a_link_without_an_answer_or_with_two_is_named() -> None:
    """Each by a line of its own, not by one of Drake's."""
    model = ControlAffineModel.from_system(Car())
    bus, builder = Bus(DrakeLcm("memq://"), SimulatedClock()), DiagramBuilder()
    link = VehicleLink(builder, bus, model, period=0.02)
    with pytest.raises(ModelError, match="VehicleLink: a diagram has one"):
        VehicleLink(builder, bus, model, period=0.02)
    pilot = builder.AddSystem(ConstantVectorSource([0.0, 0.0]))
    safety = AddSafetyFilter(
        builder,
        plant=None,
        model=model,
        state=link.state,
        applied_input=link.applied_input,
        reference=pilot.get_output_port(),
        barriers=[SphereObstacle([5.0, 0.0], 1.0).barrier([3.0, 2.0])],
        input_set=InputSet.box([-9.0, -3.0], [9.0, 3.0]),
        bounds=DisturbanceBounds(0.1, 0.1, 0.1),
    )
    link.answer(safety, pilot.get_output_port())
    with pytest.raises(ModelError, match=r"VehicleLink\.answer: one filter answers"):
        link.answer(safety, pilot.get_output_port())
    half = DiagramBuilder()
    VehicleLink(half, bus, model, period=0.02)
    half.AddSystem(ConstantVectorSource([0.0]))
    with pytest.raises(
        ModelError, match=r"no command_sender: VehicleLink\.answer adds"
    ):
        ControllerProcess(half.Build(), bus)
