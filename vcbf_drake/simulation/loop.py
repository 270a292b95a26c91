"""make_loop: the one place where the systems of a scenario are wired."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
    System,
    TriggerType,
)
from pydrake.systems.primitives import LogVectorOutput, PassThrough

from vcbf_drake.add_safety_filter import AddedSafetyFilter, AddSafetyFilter
from vcbf_drake.barriers import BarrierSet
from vcbf_drake.checks import require
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    DisturbanceSource,
)
from vcbf_drake.errors import below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.interface import find_input_port, state_port_of
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.simulation.collision_monitor import CollisionMonitor
from vcbf_drake.simulation.fault_systems import (
    faulty_actuator,
    faulty_measurement,
    lose_answers,
    true_disturbance,
)
from vcbf_drake.simulation.obstacles import (
    barriers,
    other_vehicles,
    perceived_spheres,
    seen_barriers,
    separation_barriers,
)
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.sensors import MeasurementNoise, ObstaclesInSight
from vcbf_drake.typed import typed

LOG_PREFIX = "log_"
COLLISION_MONITOR = "collision_monitor"


@typed
def make_loop(
    scenario: Scenario,
    controller: System | None = None,
    others: Sequence[str] = (),
) -> Diagram:
    """Returns the whole closed loop of a scenario as a Drake diagram.

    The systems are named plant, disturbance, controller, filter, filter_hold and
    filter_observer; a log system ``log_NAME`` records each quantity once per control
    tick, and ``log_path`` the true state at every integrator step. The diagram ends a
    simulation at a collision and, with the policy ``stop``, at an infeasible tick.
    The controller compensates the estimate only for the methods that have one; the
    observer runs, and is logged, with every method. The scenario's faults are further
    systems, named after them.

    Args:
        scenario: A validated scenario.
        controller: In the place of the vehicle's own, with its ports.
        others: The names of the other vehicles, if any: the diagram then has the port
            ``others``, for their description, and the ports ``state`` and
            ``held_input``.
    """
    builder = DiagramBuilder()
    simulated = add_simulated_plant(builder, scenario)
    plant, source = simulated.plant, simulated.source
    # The filter knows the scenario's plant, not the faults of the true one.
    model = scenario.make_model()
    if not others:
        seen = obstacles_in_sight(builder, scenario, plant)
    else:
        size = other_vehicles(scenario, others).size
        told = builder.AddNamedSystem("other_vehicles", PassThrough(size))
        builder.ExportInput(told.get_input_port(), "others")
        builder.ExportOutput(state_port_of(plant), "state")
        seen = told.get_output_port()
    added, loop = add_controller_and_filter(
        builder,
        scenario,
        model,
        source.bounds,
        controller=controller,
        state=simulated.state,
        observer=make_observer(
            scenario,
            model,
            source.bounds,
            period=scenario.observer.period or scenario.period,
        ),
        plant_input=simulated.input,
        obstacles=seen,
        others=others,
    )
    if others:
        builder.ExportOutput(loop.hold.get_output_port(), "held_input")
    truth = loop.filter.barrier_set
    if scenario.faults.sight > 0.0:
        truth = BarrierSet(model, barriers(scenario))
    elif others and scenario.separation.margin > 0.0:
        apart = separation_barriers(scenario, others)
        truth = BarrierSet(model, [*barriers(scenario), *apart])
    add_collision_monitor(builder, plant, truth, seen)
    _add_logs(builder, scenario, simulated, added, loop, seen, truth)
    lose_answers(builder, scenario, loop)
    diagram = builder.Build()
    diagram.set_name(scenario.name)
    return diagram


class SimulatedPlant(NamedTuple):
    """A plant in its disturbance.

    Attributes:
        plant: The plant.
        input: The port of the actuators' input; still to be connected.
        source: The disturbance as it is declared.
        disturbance: The disturbance that acts.
        state: The measured state.
    """

    plant: LeafSystem
    input: InputPort
    source: DisturbanceSource
    disturbance: OutputPort
    state: OutputPort


def add_simulated_plant(builder: DiagramBuilder, scenario: Scenario) -> SimulatedPlant:
    """Adds a scenario's plant and disturbance, with its noise and faults."""
    faults = scenario.faults
    plant = builder.AddNamedSystem(
        "plant", scenario.vehicle.altered(faults.mass, faults.drag).make_plant()
    )
    source = builder.AddNamedSystem("disturbance", scenario.make_source())
    disturbance = true_disturbance(builder, faults, source.get_output_port())
    if plant.HasInputPort("disturbance"):
        builder.Connect(disturbance, plant.GetInputPort("disturbance"))
    applied = faulty_actuator(builder, scenario, find_input_port(plant))
    state = _measured_state(builder, scenario, plant)
    state = faulty_measurement(builder, scenario, state)
    return SimulatedPlant(plant, applied, source, disturbance, state)


def add_controller_and_filter(
    builder: DiagramBuilder,
    scenario: Scenario,
    model: ControlAffineModel,
    bounds: DisturbanceBounds,
    *,
    controller: System | None = None,
    state: OutputPort,
    observer: DisturbanceObserver,
    plant_input: InputPort | None = None,
    applied_input: OutputPort | None = None,
    obstacles: OutputPort | None = None,
    others: Sequence[str] = (),
) -> tuple[LeafSystem, AddedSafetyFilter]:
    """Adds a scenario's controller, and its filter with hold and observer.

    Args:
        builder: Holds what measures the state.
        scenario: A validated scenario.
        model: The plant's.
        bounds: The bounds of the disturbance.
        controller: In the place of the vehicle's own, with its ports.
        state: The measured state.
        observer: Estimates the disturbance; see `AddSafetyFilter`.
        plant_input: Takes the held input; None leaves that to be connected.
        applied_input: The input that the plant really applied; the held input by
            default.
        obstacles: The port of the obstacles in sight; without it they are known.
        others: Or what the other vehicles are called: then these alone are seen.
    """
    if controller is None:
        controller = scenario.vehicle.make_controller(scenario.target)
    controller = builder.AddNamedSystem("controller", controller)
    builder.Connect(state, controller.GetInputPort("state"))
    if others:
        apart = separation_barriers(scenario, others, scenario.separation.margin)
        guarded = [*barriers(scenario), *apart]
    else:
        guarded = barriers(scenario) if obstacles is None else seen_barriers(scenario)
    loop = AddSafetyFilter(
        builder,
        plant=plant_input,
        reference=controller.GetOutputPort("reference"),
        barriers=guarded,
        input_set=scenario.input_set.input_set(),
        bounds=bounds,
        settings=scenario,
        observer=observer,
        state=state,
        applied_input=applied_input,
        obstacles=obstacles,
        model=model,
    )
    compensates = controller.HasInputPort("disturbance_estimate")
    if compensates and loop.filter.method.disturbance == "estimated":
        builder.Connect(
            loop.observer.GetOutputPort("disturbance_estimate"),
            controller.GetInputPort("disturbance_estimate"),
        )
    return controller, loop


def measurement_noise(scenario: Scenario, model: ControlAffineModel) -> float:
    """Returns the largest deviation of a disturbed channel E^+ x; 0 without noise."""
    if not any(scenario.noise.std):
        return 0.0
    channels = np.linalg.pinv(model.disturbance_matrix)
    deviations = np.linalg.norm(channels * scenario.noise.std, axis=1)
    return float(np.max(deviations, initial=0.0))


def make_observer(
    scenario: Scenario,
    model: ControlAffineModel,
    bounds: DisturbanceBounds,
    *,
    period: float,
    longest_interval: float | None = None,
) -> DisturbanceObserver:
    """Returns a scenario's observer.

    Args:
        scenario: A validated scenario.
        model: The plant's.
        bounds: The bounds of the disturbance.
        period: Time between measurements [s].
        longest_interval: See `DisturbanceObserver`.
    """
    with below("observer"):
        return scenario.make_observer(
            model,
            bounds,
            noise=measurement_noise(scenario, model),
            period=period,
            longest_interval=longest_interval,
        )


def obstacles_in_sight(
    builder: DiagramBuilder, scenario: Scenario, plant: LeafSystem
) -> OutputPort | None:
    """Returns the port of what is seen; None where all obstacles are known."""
    if scenario.faults.sight == 0.0 or not scenario.spheres:
        return None
    slots = perceived_spheres(scenario)
    rule = f"at least {len(scenario.spheres)}, the number of spheres"
    where = ("hardware", "most_obstacles")
    require(slots.capacity >= len(scenario.spheres), where, slots.capacity, rule)
    state = state_port_of(plant)
    seeing = builder.AddNamedSystem(
        "obstacles_in_sight",
        ObstaclesInSight(
            scenario.spheres,
            slots,
            state.size(),
            scenario.vehicle.positions,
            scenario.faults.sight,
        ),
    )
    builder.Connect(state, seeing.get_input_port())
    return seeing.get_output_port()


def _measured_state(
    builder: DiagramBuilder, scenario: Scenario, plant: LeafSystem
) -> OutputPort:
    state = state_port_of(plant)
    if not any(scenario.noise.std):
        return state
    noise = builder.AddNamedSystem(
        "measurement_noise",
        MeasurementNoise(
            np.array(scenario.noise.std), scenario.period, scenario.noise.seed
        ),
    )
    builder.Connect(state, noise.GetInputPort("state"))
    return noise.GetOutputPort("measured_state")


def add_collision_monitor(
    builder: DiagramBuilder,
    plant: LeafSystem,
    barrier_set: BarrierSet,
    seen: OutputPort | None = None,
) -> None:
    """Adds the monitor that ends a simulation when a barrier becomes negative.

    Args:
        builder: Holds the plant.
        plant: The plant.
        barrier_set: With what.
        seen: The port of the perceived obstacles.
    """
    state = state_port_of(plant)
    monitor = builder.AddNamedSystem(
        COLLISION_MONITOR, CollisionMonitor(barrier_set, state.size())
    )
    builder.Connect(state, monitor.GetInputPort("state"))
    if seen is not None and monitor.HasInputPort("obstacles"):
        builder.Connect(seen, monitor.GetInputPort("obstacles"))


def logged_ports(
    controller: LeafSystem, safety_filter: SafetyFilter, observer: DisturbanceObserver
) -> dict[str, OutputPort]:
    """Returns the ports that a log of a run has, beside those of the plant, by name."""
    names = ["slack", "volume", "barriers", "status", "decay", "feasible_set"]
    ports = {name: safety_filter.GetOutputPort(name) for name in names}
    ports["input"] = safety_filter.GetOutputPort("command")
    if safety_filter.certified_hold:
        ports["least_chi"] = safety_filter.GetOutputPort("row_margin")
    if safety_filter.gate is not None:
        ports["backup"] = safety_filter.GetOutputPort("backup")
    ports["reference"] = controller.GetOutputPort("reference")
    ports["estimate"] = observer.GetOutputPort("estimate")
    return ports


def _add_logs(
    builder: DiagramBuilder,
    scenario: Scenario,
    simulated: SimulatedPlant,
    controller: LeafSystem,
    loop: AddedSafetyFilter,
    seen: OutputPort | None,
    truth: BarrierSet,
) -> None:
    state = state_port_of(simulated.plant)
    ports = {
        "state": state,
        "disturbance": simulated.disturbance,
        **logged_ports(controller, loop.filter, loop.observer),
    }
    steps = {"path": state}
    if seen is not None:
        ports["obstacles"] = seen
        if truth.obstacles_size:
            steps["path_obstacles"] = seen
    for name, port in ports.items():
        log = LogVectorOutput(port, builder, scenario.period)
        log.set_name(LOG_PREFIX + name)
    for name, port in steps.items():
        log = LogVectorOutput(port, builder, {TriggerType.kPerStep})
        log.set_name(LOG_PREFIX + name)
