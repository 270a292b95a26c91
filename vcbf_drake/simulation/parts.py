"""The parts of a loop as a scenario describes them: plant, barriers, observer."""

from __future__ import annotations

import numpy as np

from vcbf_drake.barriers import (
    Barrier,
    PerceivedSpheres,
    SphereObstacle,
    StateInputLimit,
)
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    DisturbanceSource,
)
from vcbf_drake.errors import below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants.channels import channels_of
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
            position=scenario.vehicle.position,
            name=f"obstacle {i + 1}",
        )
        for i, obstacle in enumerate(scenario.obstacles)
    ]
    return found + scenario.vehicle.barriers()


def seen_barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the same barriers for obstacles that have to be seen first."""
    found: list[Barrier | StateInputLimit] = [
        *perceived_spheres(scenario).barriers(
            scenario.barrier.gains,
            position=scenario.vehicle.position,
            name="seen obstacle",
        )
    ]
    return found + scenario.vehicle.barriers()


def perceived_spheres(scenario: Scenario) -> PerceivedSpheres:
    """Returns what describes the obstacles; their margins are in the radii."""
    capacity = len(scenario.obstacles)
    if scenario.hardware.obstacles == "perceived":
        capacity = scenario.hardware.most_obstacles
    return PerceivedSpheres(capacity, len(scenario.target), form=scenario.barrier.form)


def make_source(scenario: Scenario) -> DisturbanceSource:
    """Returns a scenario's disturbance."""
    return DisturbanceSource(
        scenario.disturbance,
        horizon=scenario.duration,
        num_disturbances=len(channels_of(scenario.vehicle.make_plant()).disturbances),
    )


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
