"""The barriers of a scenario's obstacles, for every point of the robot's body."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import math
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

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
    PolygonObstacle,
    SphereObstacle,
    StateInputLimit,
    StateLimit,
)
from vcbf_drake.barriers.obstacles import SphereForm
from vcbf_drake.barriers.shapes import Shape
from vcbf_drake.checks import Array, check_finite, require, require_choice
from vcbf_drake.errors import below
from vcbf_drake.model.position import Position
from vcbf_drake.simulation.obstacle_files import PolygonMap, SpheresFile
from vcbf_drake.simulation.obstacle_kinds import (
    MovingObstacle,
    Obstacle,
    StateRange,
)

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario

AnyObstacle: TypeAlias = (
    Obstacle
    | EllipsoidObstacle
    | CapsuleObstacle
    | BoxObstacle
    | PolygonObstacle
    | HalfSpace
    | Geofence
    | StateRange
    | MovingObstacle
    | SpheresFile
    | PolygonMap
)


class Carrier(NamedTuple):
    """A point of the robot's body that keeps clear of obstacles.

    Attributes:
        position: Where it is, from the state.
        radius: How much of the body around it is meant [m].
        name: What is put behind a barrier's name.
    """

    position: Position
    radius: float
    name: str

    def place(self, state: Array) -> list[float]:
        """Returns where it is, from the state (n,) [m]."""
        at: Any = self.position
        found = at(state) if callable(at) else state[list(at)]
        return [*map(float, found)]


def with_files_read(
    obstacles: Sequence[AnyObstacle],
) -> Iterator[tuple[int, AnyObstacle]]:
    """Yields the obstacles, those of files one by one, with their numbers in the list.

    Raises:
        InvalidValueError: A file cannot be read.
    """
    for i, obstacle in enumerate(obstacles):
        if isinstance(obstacle, SpheresFile | PolygonMap):
            with below("obstacles", i):
                read = obstacle.obstacles()
            for each in read:
                yield i, each
        else:
            yield i, obstacle


def barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the barriers of the obstacles, then the vehicle's own limits."""
    found: list[Barrier] = []
    points = body(scenario)
    for i, obstacle in enumerate(scenario.obstacles):
        found += _barriers(scenario, points, obstacle, i + 1)
    return [*_robust(scenario, found), *scenario.vehicle.barriers()]


def seen_barriers(scenario: Scenario) -> list[Barrier | StateInputLimit]:
    """Returns the same barriers where spheres have to be seen first."""
    found: list[Barrier] = []
    points = body(scenario)
    for point in points:
        found += replace(perceived_spheres(scenario), margin=point.radius).barriers(
            scenario.barrier.gains, point.position, f"seen obstacle{point.name}"
        )
    for i, obstacle in enumerate(scenario.obstacles):
        if not isinstance(obstacle, Obstacle):
            found += _barriers(scenario, points, obstacle, i + 1)
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


def body(scenario: Scenario) -> list[Carrier]:
    """Returns the points that keep clear of obstacles: the position without others.

    Raises:
        InvalidValueError: A point is not one of the vehicle's.
    """
    if not scenario.body:
        return [Carrier(scenario.vehicle.position, 0.0, "")]
    found = []
    for i, each in enumerate(scenario.body):
        with below("body", i):
            position = scenario.vehicle.body_position(each.point, each.frame)
        name = f" (point {i + 1})" if len(scenario.body) > 1 else ""
        found.append(Carrier(position, each.radius, name))
    return found


def _barriers(
    scenario: Scenario, points: Sequence[Carrier], obstacle: AnyObstacle, number: int
) -> list[Barrier]:
    if isinstance(obstacle, StateRange):
        index = scenario.state_names.index(obstacle.state)
        limit = StateLimit(index, obstacle.lower, obstacle.upper)
        return limit.barriers(obstacle.gains, obstacle.state)
    gains, found = scenario.barrier.gains, list[Barrier]()
    path = obstacle.trajectory() if isinstance(obstacle, MovingObstacle) else None
    for point in points:
        for title, shape in _shapes(obstacle, scenario.barrier.form, point.radius):
            name, position = f"{title.format(number)}{point.name}", point.position
            if isinstance(shape, PolygonObstacle):
                position = _in_plane(position)
            if path is None:
                found.append(shape.barrier(gains, position, name))
            else:
                found.append(shape.barrier_along(path, gains, position, name))
    return found


def _in_plane(position: Position) -> Position:
    """The first two coordinates of a position: a polygon is a pillar in space."""
    if callable(position):
        return lambda x: position(x)[:2]
    return position[:2]


def _shapes(
    obstacle: AnyObstacle, form: SphereForm, radius: float = 0.0
) -> list[tuple[str, Shape]]:
    """The shapes of an obstacle, each for one barrier, and what they are called.

    Args:
        obstacle: The obstacle.
        form: Of a sphere's barrier.
        radius: What is added to the margins [m].
    """
    if isinstance(obstacle, MovingObstacle):
        return _shapes(obstacle.shape, form, radius)
    if isinstance(obstacle, Obstacle):
        sphere = SphereObstacle(
            obstacle.center,
            obstacle.radius,
            velocity=obstacle.velocity or None,
            form=form,
            margin=obstacle.margin + radius,
        )
        return [("obstacle {}", sphere)]
    given: Any = obstacle
    grown = replace(given, margin=given.margin + radius)
    if isinstance(grown, Geofence):
        sides = grown.half_spaces.items()
        return [(f"geofence {{}} ({side})", each) for side, each in sides]
    if isinstance(grown, PolygonObstacle):
        pieces = [replace(grown, vertices=piece.tolist()) for piece in grown.pieces]
        several = len(pieces) > 1
        return [
            ("polygon {}" + f".{i}" * several, piece)
            for i, piece in enumerate(pieces, start=1)
        ]
    return [(f"{grown.kind} {{}}", grown)]


def check_place(
    obstacle: AnyObstacle,
    at: str,
    position: Sequence[float],
    what: str,
    target: bool,
    radius: float = 0.0,
) -> None:
    """Checks that a place is one where an obstacle lets the vehicle be.

    Args:
        obstacle: What must let it.
        at: The field of the place.
        position: The place [m].
        what: What the obstacle is called in the scenario.
        target: Whether it is the target, over which a moving obstacle may pass.
        radius: How much of the body around the place is meant [m].

    Raises:
        InvalidValueError: It is not.
    """
    if isinstance(obstacle, StateRange) or (target and moves(obstacle)):
        return
    if isinstance(obstacle, MovingObstacle):
        place, offset = np.array(position, dtype=float), obstacle.offset_at(0.0)
        place[: len(offset)] -= offset  # A polygon is a pillar in space.
        check_place(obstacle.shape, at, place.tolist(), what, target, radius)
        return
    if isinstance(obstacle, Obstacle):
        reach = obstacle.radius + obstacle.margin + radius
        height = math.dist(position, obstacle.center) - reach
    else:
        shapes = _shapes(obstacle, "distance", radius)
        height = min(_height(each, position) for _, each in shapes)
    rule = f"outside {what}, margin included; its signed distance is {height:.3g} m"
    require(height > 0.0, at, [*position], rule)


def check_limits(scenario: Scenario) -> None:
    """Checks that the start is inside the ranges of states and the robot's own limits.

    Raises:
        InvalidValueError: It is not.
    """
    state = np.array(scenario.initial_state, dtype=float)
    for obstacle in scenario.obstacles:
        if isinstance(obstacle, StateRange):
            value = state[scenario.state_names.index(obstacle.state)]
            rule = f"from {obstacle.lower:g} to {obstacle.upper:g} in {obstacle.state}"
            is_inside = obstacle.lower <= value <= obstacle.upper
            require(is_inside, "initial_state", float(value), rule)
    for barrier in scenario.vehicle.barriers():
        if isinstance(barrier, Barrier) and barrier.of_position is None:
            try:
                function: Any = barrier.function
                found = function(state, Expression(0.0), barrier.parameters)
                h = float(getattr(found, "Evaluate", lambda found=found: found)())
            except Exception:  # A user's function may be for symbols alone.
                continue
            rule = f"inside the robot's limit {barrier.name}; its h is {h:.3g}"
            require(h >= 0.0, "initial_state", state.tolist(), rule)


def moves(obstacle: AnyObstacle) -> bool:
    """Returns whether an obstacle moves at all."""
    if isinstance(obstacle, MovingObstacle):
        return True
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
    if isinstance(obstacle, MovingObstacle):
        check_fits(obstacle.shape, (*path, "shape"), names, size)
    elif isinstance(obstacle, StateRange):
        require_choice((*path, "state"), obstacle.state, names)
    elif isinstance(obstacle, Obstacle):
        check_finite((*path, "center"), obstacle.center, size=size)
    elif not isinstance(obstacle, PolygonObstacle):
        found = _shapes(obstacle, "distance")[0][1].formula()[0]
        rule = f"of {size} dimensions, like the target"
        require(found == size, path, f"{found} dimensions", rule)


def _height(shape: Shape, position: Sequence[float]) -> float:
    """Returns a shape's h at a position, at time 0."""
    _, h, parameters = shape.formula()
    at_start: Any = h(np.array(position), Expression(0.0), np.array(parameters))
    return float(at_start.Evaluate() if isinstance(at_start, Expression) else at_start)
