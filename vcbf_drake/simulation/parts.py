"""The parts of a loop as a scenario describes them: plant, barriers, observer."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from vcbf_drake.barriers import (
    Barrier,
    PerceivedSpheres,
    SphereObstacle,
    StateInputLimit,
    ackermann_limit,
)
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    DisturbanceSource,
)
from vcbf_drake.errors import below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import (
    Blimp,
    BlimpController,
    BlimpParameters,
    Car,
    CarController,
)
from vcbf_drake.simulation.scenario import Scenario


def barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns a barrier per obstacle, then the steering limits if there are any."""
    found: list[Barrier | StateInputLimit] = [
        SphereObstacle(
            obstacle.center,
            obstacle.radius,
            velocity=obstacle.velocity or None,
            form=scenario.barrier.form,
            margin=obstacle.margin,
        ).barrier(
            scenario.barrier.gains,
            position=plant_class(scenario).position_indices,
            name=f"obstacle {i + 1}",
        )
        for i, obstacle in enumerate(scenario.obstacles)
    ]
    return found + turn_limits(scenario)


def seen_barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the same barriers for obstacles that have to be seen first."""
    found: list[Barrier | StateInputLimit] = [
        *perceived_spheres(scenario).barriers(
            scenario.barrier.gains,
            position=plant_class(scenario).position_indices,
            name="seen obstacle",
        )
    ]
    return found + turn_limits(scenario)


def perceived_spheres(scenario: Scenario) -> PerceivedSpheres:
    """Returns what describes the obstacles; their margins are in the radii."""
    capacity = len(scenario.obstacles)
    if scenario.hardware.obstacles == "perceived":
        capacity = scenario.hardware.most_obstacles
    return PerceivedSpheres(capacity, len(scenario.target), form=scenario.barrier.form)


def turn_limits(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the limits of a steered car's turn rate; none where there are none."""
    limit = scenario.turn_limit
    if limit is None:
        return []
    return [*ackermann_limit(limit.curvature, limit.smoothing_speed)]


def plant_class(scenario: Scenario) -> Any:
    """Returns the class of a scenario's plant."""
    return Blimp if isinstance(scenario.plant, BlimpParameters) else Car


def make_plant(scenario: Scenario) -> LeafSystem:
    """Returns a scenario's plant."""
    return plant_class(scenario)(scenario.plant)


def make_source(scenario: Scenario) -> DisturbanceSource:
    """Returns a scenario's disturbance."""
    return DisturbanceSource(
        scenario.disturbance,
        horizon=scenario.duration,
        num_disturbances=make_plant(scenario).GetInputPort("disturbance").size(),
    )


def make_controller(scenario: Scenario) -> LeafSystem:
    """Returns a scenario's own controller, which knows nothing of obstacles."""
    controller: Any = (
        BlimpController if plant_class(scenario) is Blimp else CarController
    )
    return controller(scenario.target, scenario.controller, scenario.plant)


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
        bounds: Of the disturbance.
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
