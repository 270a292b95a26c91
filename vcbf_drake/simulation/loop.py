"""make_loop: the one place where the systems of a scenario are wired."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
    TriggerType,
)
from pydrake.systems.primitives import LogVectorOutput

from vcbf_drake.barriers import (
    Barrier,
    SphereObstacle,
    StateInputLimit,
    ackermann_limit,
)
from vcbf_drake.control import BlimpController, CarController
from vcbf_drake.disturbances import (
    DisturbanceObserver,
    DisturbanceSource,
    LinearDisturbanceObserver,
    RiseGains,
    RiseObserver,
    observer_ports,
)
from vcbf_drake.plants import Blimp, BlimpParameters, Car, ControlAffineModel
from vcbf_drake.safety import (
    METHODS,
    AddedSafetyFilter,
    AddSafetyFilter,
    InfeasiblePolicy,
)
from vcbf_drake.simulation.collision_monitor import CollisionMonitor
from vcbf_drake.simulation.measurement_noise import MeasurementNoise
from vcbf_drake.simulation.scenario import Scenario

LOG_PREFIX = "log_"
COLLISION_MONITOR = "collision_monitor"


def make_loop(scenario: Scenario) -> Diagram:
    """Returns the whole closed loop of a scenario as a Drake diagram.

    The systems are named plant, disturbance, controller, filter, filter_hold and
    filter_observer; a log system ``log_NAME`` records each quantity once per control
    tick, and ``log_path`` the true state at every integrator step. The diagram ends a
    simulation at a collision and, with the policy ``stop``, at an infeasible tick.
    The controller compensates the estimate only for the methods that have one; the
    observer runs, and is logged, with every method.

    Args:
        scenario: A validated scenario.
    """
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", _plant(scenario))
    source = builder.AddNamedSystem("disturbance", _source(scenario, plant))
    builder.Connect(source.get_output_port(), plant.GetInputPort("disturbance"))
    state = _measured_state(builder, scenario, plant)
    controller = builder.AddNamedSystem("controller", _controller(scenario))
    builder.Connect(state, controller.GetInputPort("state"))
    model = ControlAffineModel.from_system(plant)
    loop = AddSafetyFilter(
        builder,
        plant=plant,
        reference=controller.GetOutputPort("reference"),
        barriers=barriers(scenario),
        input_set=scenario.input_set.input_set(),
        period=scenario.period,
        bounds=source.bounds,
        method=scenario.method,
        corrections=scenario.applied_corrections,
        infeasible=cast(InfeasiblePolicy, scenario.infeasible),
        volume_barrier=scenario.volume,
        observer=_observer(scenario, model, source),
        state=state,
        model=model,
    )
    if loop.filter.method.disturbance == "estimated":
        builder.Connect(
            loop.observer.GetOutputPort("disturbance_estimate"),
            controller.GetInputPort("disturbance_estimate"),
        )
    _add_collision_monitor(builder, plant, loop)
    _add_logs(builder, scenario, plant, source, controller, loop)
    diagram = builder.Build()
    diagram.set_name(scenario.name)
    return diagram


def barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns a barrier per obstacle, then the steering limits if there are any."""
    plant = _plant_class(scenario)
    found: list[Barrier | StateInputLimit] = [
        SphereObstacle(
            obstacle.center,
            obstacle.radius,
            velocity=obstacle.velocity or None,
            form=scenario.barrier.form,
            margin=obstacle.margin,
        ).barrier(
            scenario.barrier.gains,
            position=plant.position_indices,
            name=f"obstacle {i + 1}",
        )
        for i, obstacle in enumerate(scenario.obstacles)
    ]
    if scenario.turn_limit is not None:
        limit = scenario.turn_limit
        found.extend(ackermann_limit(limit.curvature, limit.smoothing_speed))
    return found


def _plant_class(scenario: Scenario) -> Any:
    return Blimp if isinstance(scenario.plant, BlimpParameters) else Car


def _plant(scenario: Scenario) -> LeafSystem:
    return _plant_class(scenario)(scenario.plant)


def _source(scenario: Scenario, plant: LeafSystem) -> DisturbanceSource:
    return DisturbanceSource(
        scenario.disturbance,
        horizon=scenario.duration,
        num_disturbances=plant.GetInputPort("disturbance").size(),
    )


def _controller(scenario: Scenario) -> LeafSystem:
    controller: Any = (
        BlimpController if _plant_class(scenario) is Blimp else CarController
    )
    return controller(scenario.target, scenario.controller, scenario.plant)


def _measured_state(
    builder: DiagramBuilder, scenario: Scenario, plant: LeafSystem
) -> OutputPort:
    state = plant.GetOutputPort("state")
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


def measurement_noise(scenario: Scenario, model: ControlAffineModel) -> float:
    """Returns the largest noise on a disturbed state [m/s]; 0 without noise."""
    if not any(scenario.noise.std):
        return 0.0
    disturbed = np.any(model.disturbance_matrix != 0.0, axis=1)
    return float(np.max(np.array(scenario.noise.std)[disturbed], initial=0.0))


def _observer(
    scenario: Scenario, model: ControlAffineModel, source: DisturbanceSource
) -> DisturbanceObserver:
    settings, bounds = scenario.observer, source.bounds
    period = settings.period or scenario.period
    if METHODS[scenario.method].observer == "linear":
        return LinearDisturbanceObserver(
            model, period, bounds, rate=settings.linear_rate
        )
    return RiseObserver(
        model,
        period,
        bounds,
        gains=RiseGains(settings.alpha, settings.beta, settings.gamma),
        step=settings.step,
        boundary_layer=settings.boundary_layer,
        noise=measurement_noise(scenario, model),
        floor=scenario.applied_corrections.error_floor,
    )


def _add_collision_monitor(
    builder: DiagramBuilder, plant: LeafSystem, loop: AddedSafetyFilter
) -> None:
    monitor = builder.AddNamedSystem(
        COLLISION_MONITOR,
        CollisionMonitor(loop.filter.barrier_set, loop.filter.model.num_states),
    )
    builder.Connect(plant.GetOutputPort("state"), monitor.GetInputPort("state"))


def _add_logs(
    builder: DiagramBuilder,
    scenario: Scenario,
    plant: LeafSystem,
    source: DisturbanceSource,
    controller: LeafSystem,
    loop: AddedSafetyFilter,
) -> None:
    state = plant.GetOutputPort("state")
    ports = {
        "state": state,
        "disturbance": source.get_output_port(),
        "reference": controller.GetOutputPort("reference"),
    }
    for name, _ in observer_ports(loop.filter.model.num_disturbances):
        ports[name] = loop.observer.GetOutputPort(name)
    for name in (
        "input",
        "slack",
        "volume",
        "barriers",
        "authority",
        "status",
        "feasible_set",
    ):
        ports[name] = loop.filter.GetOutputPort(name)
    for name, port in ports.items():
        log = LogVectorOutput(port, builder, scenario.period)
        log.set_name(LOG_PREFIX + name)
    path = LogVectorOutput(state, builder, {TriggerType.kPerStep})
    path.set_name(LOG_PREFIX + "path")
