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
from vcbf_drake.barriers import (
    Barrier,
    BarrierSet,
    PerceivedSpheres,
    StateInputLimit,
)
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    DisturbanceSource,
)
from vcbf_drake.errors import below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.interface import find_input_port, state_port_of
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.simulation.collision_monitor import add_collision_monitor
from vcbf_drake.simulation.faults import (
    faulty_actuator,
    lose_answers,
    true_disturbance,
)
from vcbf_drake.simulation.obstacles import (
    barriers,
    perceived_spheres,
    separation_barriers,
)
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.sensors import ObstaclesInSight, Sensor
from vcbf_drake.typed import typed

LOG_PREFIX = "log_"


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
    # The filter knows the scenario's plant, not the faults of the true one.
    model = scenario.make_model()
    known = barriers(scenario)
    apart, margin = separation_barriers(scenario, others), scenario.separation.margin
    if not others:
        seen = obstacles_in_sight(builder, scenario, simulated.plant)
        guarded = known if seen is None else barriers(scenario, seen=True)
    else:
        size = PerceivedSpheres(len(others), len(scenario.target)).size
        told = builder.AddNamedSystem("other_vehicles", PassThrough(size))
        builder.ExportInput(told.get_input_port(), "others")
        builder.ExportOutput(state_port_of(simulated.plant), "state")
        seen = told.get_output_port()
        guarded = [*known, *separation_barriers(scenario, others, margin)]
    added, loop = add_controller_and_filter(
        builder,
        scenario,
        guarded,
        model=model,
        observer=make_observer(scenario, model, simulated.source.bounds),
        controller=controller,
        state=simulated.state,
        plant_input=simulated.input,
        obstacles=seen,
    )
    if others:
        builder.ExportOutput(loop.hold.get_output_port(), "held_input")
    truth = loop.filter.barrier_set
    if scenario.faults.sight > 0.0 or (others and margin > 0.0):
        truth = BarrierSet(model, [*known, *apart])
    add_collision_monitor(builder, simulated.plant, truth, seen)
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
    return SimulatedPlant(plant, applied, source, disturbance, state)


def add_controller_and_filter(
    builder: DiagramBuilder,
    scenario: Scenario,
    guarded: Sequence[Barrier | StateInputLimit],
    *,
    model: ControlAffineModel,
    observer: DisturbanceObserver,
    controller: System | None = None,
    state: OutputPort,
    plant_input: InputPort | None = None,
    applied_input: OutputPort | None = None,
    obstacles: OutputPort | None = None,
) -> tuple[LeafSystem, AddedSafetyFilter]:
    """Adds a scenario's controller, and its filter with hold and observer.

    Args:
        builder: Holds what measures the state.
        scenario: A validated scenario.
        guarded: The barriers that the filter knows.
        model: See `AddSafetyFilter`.
        observer: See `AddSafetyFilter`.
        controller: In the place of the vehicle's own, with its ports.
        state: The measured state.
        plant_input: Takes the held input; None leaves that to be connected.
        applied_input: See `AddSafetyFilter`.
        obstacles: The port of the spheres that are perceived.
    """
    if controller is None:
        controller = scenario.vehicle.make_controller(scenario.target)
    controller = builder.AddNamedSystem("controller", controller)
    builder.Connect(state, controller.GetInputPort("state"))
    loop = AddSafetyFilter(
        builder,
        plant=plant_input,
        reference=controller.GetOutputPort("reference"),
        barriers=guarded,
        input_set=scenario.input_set.input_set(),
        bounds=observer.bounds,
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
    period: float | None = None,
    longest_interval: float | None = None,
) -> DisturbanceObserver:
    """Returns a scenario's observer; see `FilterSettings.make_observer`."""
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
    seeing = ObstaclesInSight(scenario, perceived_spheres(scenario))
    builder.AddNamedSystem("obstacles_in_sight", seeing)
    builder.Connect(state_port_of(plant), seeing.get_input_port())
    return seeing.get_output_port()


def _measured_state(
    builder: DiagramBuilder, scenario: Scenario, plant: LeafSystem
) -> OutputPort:
    """The state, behind a sensor where it has noise or faults."""
    state, noise, faults = state_port_of(plant), scenario.noise, scenario.faults
    wrong = [*noise.std, *faults.measurement_bias]
    if not any([*wrong, faults.measurement_delay, faults.measurement_loss]):
        return state
    sensor = Sensor(state.size(), scenario.period, noise, faults)
    builder.AddNamedSystem("sensor", sensor)
    builder.Connect(state, sensor.get_input_port())
    return sensor.get_output_port()


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
