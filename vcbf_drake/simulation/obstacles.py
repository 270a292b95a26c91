"""Obstacles of a scenario, of every kind that has a barrier, and their barriers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers import (
    Barrier,
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    Geofence,
    HalfSpace,
    PerceivedSpheres,
    SphereObstacle,
    StateInputLimit,
    StateLimit,
)
from vcbf_drake.barriers.shapes import Shape
from vcbf_drake.checks import check_finite, check_parameter, require, require_choice
from vcbf_drake.typed import check_fields

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario


@dataclass
class Obstacle:
    """A sphere, or in the plane a disc, to keep out of, standing or moving.

    Attributes:
        center: Centre at time zero [m], one number a dimension.
        radius: Radius [m].
        velocity: Velocity of the centre [m/s]; empty for an obstacle that stands.
        margin: Distance to keep from the surface [m].
    """

    TAG: ClassVar[str] = "!Sphere"

    center: list[float]
    radius: float
    velocity: list[float] = field(default_factory=list)
    margin: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_finite("center", self.center, size=len(self.center))
        check_parameter("radius", self.radius)
        if len(self.velocity):
            check_finite("velocity", self.velocity, size=len(self.center))
        check_parameter("margin", self.margin, zero_allowed=True)


@dataclass
class StateRange:
    """A range that one state keeps to, such as a speed or a height.

    Attributes:
        state: The state's name.
        lower: Least value, in the state's unit; -.inf for none.
        upper: Greatest value; .inf for none.
        gains: K of (E4), one a derivative of the state until the input appears.
    """

    TAG: ClassVar[str] = "!StateLimit"

    state: str
    lower: float = -math.inf
    upper: float = math.inf
    gains: list[float] = field(default_factory=lambda: [1.0])

    def __post_init__(self) -> None:
        check_fields(self)
        StateLimit(0, self.lower, self.upper)
        check_parameter("gains", self.gains, size=len(self.gains))


AnyObstacle: TypeAlias = (
    Obstacle
    | EllipsoidObstacle
    | CapsuleObstacle
    | BoxObstacle
    | HalfSpace
    | Geofence
    | StateRange
)


def barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the barriers of the obstacles, then the vehicle's own limits."""
    found: list[Barrier] = []
    for i, obstacle in enumerate(scenario.obstacles):
        found += _barriers(scenario, obstacle, i + 1)
    return [*_robust(scenario, found), *scenario.vehicle.barriers()]


def seen_barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the same barriers where spheres have to be seen first."""
    found: list[Barrier] = [
        *perceived_spheres(scenario).barriers(
            scenario.barrier.gains,
            position=scenario.vehicle.position,
            name="seen obstacle",
        )
    ]
    for i, obstacle in enumerate(scenario.obstacles):
        if not isinstance(obstacle, Obstacle):
            found += _barriers(scenario, obstacle, i + 1)
    return [*_robust(scenario, found), *scenario.vehicle.barriers()]


def _robust(scenario: Scenario, found: Sequence[Barrier]) -> Sequence[Barrier]:
    """The barriers, made for a disturbance before the input where that is asked for."""
    if not scenario.barrier.robust:
        return found
    bound = scenario.make_source().bounds.delta1
    return [barrier.robust_to(bound) for barrier in found]


def perceived_spheres(scenario: Scenario) -> PerceivedSpheres:
    """Returns what describes the spheres; their margins are in the radii."""
    capacity = len(scenario.spheres)
    if scenario.hardware.obstacles == "perceived":
        capacity = scenario.hardware.most_obstacles
    return PerceivedSpheres(capacity, len(scenario.target), form=scenario.barrier.form)


def _barriers(scenario: Scenario, obstacle: AnyObstacle, number: int) -> list[Barrier]:
    gains, position = scenario.barrier.gains, scenario.vehicle.position
    if isinstance(obstacle, StateRange):
        index = scenario.state_names.index(obstacle.state)
        limit = StateLimit(index, obstacle.lower, obstacle.upper)
        return limit.barriers(obstacle.gains, obstacle.state)
    if isinstance(obstacle, Geofence):
        return obstacle.barriers(gains, position, f"geofence {number}")
    if isinstance(obstacle, Obstacle):
        sphere = SphereObstacle(
            obstacle.center,
            obstacle.radius,
            velocity=obstacle.velocity or None,
            form=scenario.barrier.form,
            margin=obstacle.margin,
        )
        return [sphere.barrier(gains, position, f"obstacle {number}")]
    return [obstacle.barrier(gains, position, f"{obstacle.kind} {number}")]


def check_place(
    obstacle: AnyObstacle, at: str, position: Sequence[float], what: str, target: bool
) -> None:
    """Checks that a place is one where an obstacle lets the vehicle be.

    Args:
        obstacle: What must let it.
        at: The field of the place.
        position: The place [m].
        what: What the obstacle is called in the scenario.
        target: Whether it is the target, over which a moving obstacle may pass.

    Raises:
        InvalidValueError: It is not.
    """
    if isinstance(obstacle, StateRange) or (target and moves(obstacle)):
        return
    if isinstance(obstacle, Obstacle):
        reach = obstacle.radius + obstacle.margin
        height = math.dist(position, obstacle.center) - reach
    else:
        height = min(_height(each, position) for each in _shapes(obstacle))
    rule = f"outside {what}, margin included; its signed distance is {height:.3g} m"
    require(height > 0.0, at, [*position], rule)


def moves(obstacle: AnyObstacle) -> bool:
    """Returns whether an obstacle moves at all."""
    velocity = getattr(obstacle, "velocity", None)
    return velocity is not None and bool(np.any(velocity))


def check_fits(
    obstacle: AnyObstacle, path: tuple[str | int, ...], names: Sequence[str], size: int
) -> None:
    """Checks that an obstacle has the vehicle's dimensions, or names one of its states.

    Args:
        obstacle: What must fit.
        path: Where it is in the scenario.
        names: What the vehicle's states are called.
        size: How many dimensions its position has.

    Raises:
        InvalidValueError: It does not fit.
    """
    if isinstance(obstacle, StateRange):
        require_choice((*path, "state"), obstacle.state, names)
    elif isinstance(obstacle, Obstacle):
        check_finite((*path, "center"), obstacle.center, size=size)
    else:
        (found, *_) = _shapes(obstacle)[0].formula()
        rule = f"of {size} dimensions, like the target"
        require(found == size, path, f"{found} dimensions", rule)


def _shapes(obstacle: Shape | Geofence) -> list[Shape]:
    if isinstance(obstacle, Geofence):
        return [*obstacle.half_spaces.values()]
    return [obstacle]


def _height(shape: Shape, position: Sequence[float]) -> float:
    """Returns a shape's h at a position, at time 0."""
    _, h, parameters = shape.formula()
    at_start: Any = h(np.array(position), Expression(0.0), np.array(parameters))
    return float(at_start.Evaluate() if isinstance(at_start, Expression) else at_start)
