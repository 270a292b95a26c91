"""make_loop: the one place where the systems of a scenario are wired."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

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
    BarrierSet,
    SphereObstacle,
    StateInputLimit,
    ackermann_limit,
)
from vcbf_drake.control import BlimpController, CarController
from vcbf_drake.disturbances import (
    DisturbanceBounds,
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
    SafetyFilter,
)
from vcbf_drake.simulation.audit import Audit
from vcbf_drake.simulation.collision_monitor import CollisionMonitor
from vcbf_drake.simulation.measurement_noise import MeasurementNoise
from vcbf_drake.simulation.scenario import Scenario

if TYPE_CHECKING:
    from vcbf_drake.hil import Bus

LOG_PREFIX = "log_"
COLLISION_MONITOR = "collision_monitor"
AUDIT = "audit"


def make_loop(
    scenario: Scenario, *, hardware: bool = False, bus: Bus | None = None
) -> Diagram:
    """Returns the whole closed loop of a scenario as a Drake diagram.

    The systems are named plant, disturbance, controller, filter, filter_hold and
    filter_observer; a log system ``log_NAME`` records each quantity once per control
    tick, and ``log_path`` the true state at every integrator step. The diagram ends a
    simulation at a collision and, with the policy ``stop``, at an infeasible tick.
    The controller compensates the estimate only for the methods that have one; the
    observer runs, and is logged, with every method.

    Args:
        scenario: A validated scenario.
        hardware: Whether a vehicle on an LCM bus takes the place of plant and
            disturbance; see `vcbf_drake.hil.make_hardware_loop`.
        bus: That bus; LCM's default one if None.
    """
    if hardware:
        # This one import goes upwards: hardware in the loop knows simulations.
        from vcbf_drake.hil.hardware_loop import make_hardware_loop

        return make_hardware_loop(scenario, bus)
    builder = DiagramBuilder()
    simulated = add_simulated_plant(builder, scenario)
    plant, source = simulated.plant, simulated.source
    model = ControlAffineModel.from_system(plant)
    controller, loop = add_controller_and_filter(
        builder,
        scenario,
        model,
        source.bounds,
        state=simulated.state,
        observer=make_observer(
            scenario,
            model,
            source.bounds,
            period=scenario.observer.period or scenario.period,
        ),
        plant=plant,
    )
    add_collision_monitor(builder, plant, loop.filter.barrier_set)
    _add_audit(builder, plant, source, loop)
    _add_logs(builder, scenario, plant, source, controller, loop)
    diagram = builder.Build()
    diagram.set_name(scenario.name)
    return diagram


class SimulatedPlant(NamedTuple):
    """A plant in its disturbance.

    Attributes:
        plant: The plant; its input is still to be connected.
        source: The disturbance.
        state: The measured state.
    """

    plant: LeafSystem
    source: DisturbanceSource
    state: OutputPort


def add_simulated_plant(builder: DiagramBuilder, scenario: Scenario) -> SimulatedPlant:
    """Adds a scenario's plant, disturbance and, if any, measurement noise."""
    plant = builder.AddNamedSystem("plant", make_plant(scenario))
    source = builder.AddNamedSystem("disturbance", make_source(scenario))
    builder.Connect(source.get_output_port(), plant.GetInputPort("disturbance"))
    return SimulatedPlant(plant, source, _measured_state(builder, scenario, plant))


def add_controller_and_filter(
    builder: DiagramBuilder,
    scenario: Scenario,
    model: ControlAffineModel,
    bounds: DisturbanceBounds,
    *,
    state: OutputPort,
    observer: DisturbanceObserver,
    plant: LeafSystem | None = None,
    observed_state: OutputPort | None = None,
    applied_input: OutputPort | None = None,
) -> tuple[LeafSystem, AddedSafetyFilter]:
    """Adds a scenario's controller, and its filter with hold and observer.

    Args:
        builder: Holds what measures the state.
        scenario: A validated scenario.
        model: The plant's.
        bounds: Of the disturbance.
        state: The measured state.
        observer: Estimates the disturbance.
        observed_state: What the observer is told; `state` by default.
        plant: Gets the held input; None leaves that to be connected.
        applied_input: What the plant really applied; the held input by default.
    """
    controller = builder.AddNamedSystem("controller", _controller(scenario))
    builder.Connect(state, controller.GetInputPort("state"))
    loop = AddSafetyFilter(
        builder,
        plant=plant,
        reference=controller.GetOutputPort("reference"),
        barriers=barriers(scenario),
        input_set=scenario.input_set.input_set(),
        period=scenario.period,
        bounds=bounds,
        method=scenario.method,
        corrections=scenario.applied_corrections,
        infeasible=cast(InfeasiblePolicy, scenario.infeasible),
        volume_barrier=scenario.volume,
        observer=observer,
        state=state,
        observed_state=observed_state,
        applied_input=applied_input,
        model=model,
    )
    if loop.filter.method.disturbance == "estimated":
        builder.Connect(
            loop.observer.GetOutputPort("disturbance_estimate"),
            controller.GetInputPort("disturbance_estimate"),
        )
    return controller, loop


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


def make_plant(scenario: Scenario) -> LeafSystem:
    """Returns a scenario's plant."""
    return _plant_class(scenario)(scenario.plant)


def make_source(scenario: Scenario) -> DisturbanceSource:
    """Returns a scenario's disturbance."""
    return DisturbanceSource(
        scenario.disturbance,
        horizon=scenario.duration,
        num_disturbances=make_plant(scenario).GetInputPort("disturbance").size(),
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
        bounds: Of the disturbance.
        period: Time between measurements [s].
        longest_interval: See `DisturbanceObserver`.
    """
    settings = scenario.observer
    if METHODS[scenario.method].observer == "linear":
        return LinearDisturbanceObserver(
            model,
            period,
            bounds,
            rate=settings.linear_rate,
            longest_interval=longest_interval,
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
        longest_interval=longest_interval,
    )


def add_collision_monitor(
    builder: DiagramBuilder, plant: LeafSystem, barrier_set: BarrierSet
) -> None:
    """Adds what ends a simulation when a barrier becomes negative."""
    state = plant.GetOutputPort("state")
    monitor = builder.AddNamedSystem(
        COLLISION_MONITOR, CollisionMonitor(barrier_set, state.size())
    )
    builder.Connect(state, monitor.GetInputPort("state"))


def logged_ports(
    controller: LeafSystem, safety_filter: SafetyFilter, observer: DisturbanceObserver
) -> dict[str, OutputPort]:
    """Returns the ports that a log of a run has, beside those of the plant, by name."""
    names = ("input", "slack", "volume", "barriers", "authority", "status")
    observed = [
        name for name, _ in observer_ports(safety_filter.model.num_disturbances)
    ]
    return {
        "reference": controller.GetOutputPort("reference"),
        **{name: observer.GetOutputPort(name) for name in observed},
        **{name: safety_filter.GetOutputPort(name) for name in names},
        "feasible_set": safety_filter.GetOutputPort("feasible_set"),
    }


def _add_audit(
    builder: DiagramBuilder,
    plant: LeafSystem,
    source: DisturbanceSource,
    loop: AddedSafetyFilter,
) -> None:
    audit = builder.AddNamedSystem(
        AUDIT, Audit(loop.filter, loop.filter.barrier_set, source.bounds)
    )
    truth = {
        "state": plant.GetOutputPort("state"),
        "disturbance": source.get_output_port(),
    }
    for name in audit.inputs:
        port = truth.get(name)
        if port is None:
            owner = loop.filter if loop.filter.HasOutputPort(name) else loop.observer
            port = owner.GetOutputPort(name)
        builder.Connect(port, audit.GetInputPort(name))


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
        **logged_ports(controller, loop.filter, loop.observer),
    }
    ports["audit"] = builder.GetSubsystemByName(AUDIT).get_output_port()
    for name, port in ports.items():
        log = LogVectorOutput(port, builder, scenario.period)
        log.set_name(LOG_PREFIX + name)
    path = LogVectorOutput(state, builder, {TriggerType.kPerStep})
    path.set_name(LOG_PREFIX + "path")
