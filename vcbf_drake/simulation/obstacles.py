"""The barriers of a scenario's obstacles, for every point of the robot's body."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
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
    MovingObstacle,
    PerceivedSpheres,
    PolygonObstacle,
    SphereObstacle,
    StateInputLimit,
    StateLimit,
)
from vcbf_drake.barriers.obstacles import SphereForm
from vcbf_drake.barriers.shapes import Shape
from vcbf_drake.checks import (
    Array,
    check_finite,
    require,
    require_choice,
)
from vcbf_drake.errors import below
from vcbf_drake.model.position import Position
from vcbf_drake.simulation.obstacle_files import PolygonMap, SpheresFile
from vcbf_drake.typed import Checked, Finite, NotNegative

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario

AnyObstacle: TypeAlias = (
    SphereObstacle
    | EllipsoidObstacle
    | CapsuleObstacle
    | BoxObstacle
    | PolygonObstacle
    | HalfSpace
    | Geofence
    | StateLimit
    | MovingObstacle
    | SpheresFile
    | PolygonMap
)


@dataclass
class BodyPoint(Checked):
    """A point of the robot that keeps clear of every obstacle, with a ball around it.

    Attributes:
        point: Coordinates of the point from the vehicle's position, forwards and to the
            left if it has a heading, or in the frame [m]. Empty for the position, or
            the frame's origin.
        frame: Frame of a robot from a file that carries the point; empty for that of
            its position.
        radius: Radius of the ball around the point [m].
    """

    point: list[Finite] = field(default_factory=list)
    frame: str = ""
    radius: NotNegative = 0.0


class Carrier(NamedTuple):
    """A point of the robot's body that keeps clear of obstacles.

    Attributes:
        position: The function from the state to its position.
        radius: The radius of the body around it [m].
        name: The suffix of a barrier's name.
    """

    position: Position
    radius: float
    name: str

    def place(self, state: Array) -> list[float]:
        """Returns where it is, from the state (n,) [m]."""
        at: Any = self.position
        found = at(state) if callable(at) else state[list(at)]
        return [*map(float, found)]

    def position_in(self, dimensions: int) -> Position:
        """Returns its first coordinates: a polygon is a pillar in space."""
        at = self.position
        return (lambda x: at(x)[:dimensions]) if callable(at) else at[:dimensions]


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


def barriers(scenario: Scenario, seen: bool = False) -> list[Barrier | StateInputLimit]:
    """Returns the barriers of the obstacles, then the vehicle's own limits.

    Args:
        scenario: The scenario.
        seen: Whether spheres have to be seen first: `PerceivedSpheres` are in their
            place then.
    """
    points, names, settings = body(scenario), scenario.state_names, scenario.barrier
    found: list[Barrier] = []
    for point in points if seen else ():
        spheres = replace(perceived_spheres(scenario), margin=point.radius)
        name = f"seen obstacle{point.name}"
        found += spheres.barriers(settings.gains, point.position, name)
    for number, obstacle in enumerate(scenario.obstacles, start=1):
        if isinstance(obstacle, StateLimit):
            at = names.index(str(obstacle.state))
            found += replace(obstacle, state=at).barriers(name=names[at])
        is_seen = seen and isinstance(obstacle, SphereObstacle)
        if is_seen or not isinstance(obstacle, Shape):
            continue
        shape = _in_form(obstacle, settings.form)
        for point in points:
            position = point.position_in(shape.dimensions)
            name = f"{shape.kind} {number}"
            made = shape.grown(point.radius).barriers(settings.gains, position, name)
            for each in made:
                each.name += point.name
            found += made
    if settings.robust:
        found = _robust(scenario, found)
    return [*found, *scenario.vehicle.barriers()]


def separation_barriers(
    scenario: Scenario, others: Sequence[str], margin: float = 0.0
) -> list[Barrier]:
    """Returns the barriers of the other vehicles, which are perceived spheres.

    Args:
        scenario: The scenario of the vehicle that keeps apart.
        others: The names of the others, in the order of their slots.
        margin: The distance to keep from each, beyond the given radius [m].
    """
    if not others:
        return []
    apart, size = scenario.separation, len(scenario.target)
    spheres = PerceivedSpheres(len(others), size, apart.form, margin)
    found = spheres.barriers(apart.gains, scenario.vehicle.position, "vehicle")
    for barrier, name in zip(found, others, strict=True):
        barrier.name = f"vehicle {name}"
    return _robust(scenario, found) if apart.robust else found


def _robust(scenario: Scenario, found: Sequence[Barrier]) -> list[Barrier]:
    """The barriers, made for a disturbance before the input."""
    bound = scenario.make_source().bounds.delta1
    return [barrier.robust_to(bound) for barrier in found]


def perceived_spheres(scenario: Scenario) -> PerceivedSpheres:
    """Returns the perceived spheres; their margins are included in the radii."""
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


def _in_form(obstacle: Shape, form: SphereForm) -> Shape:
    """Returns an obstacle; a sphere that says no form of its own with this one."""
    if isinstance(obstacle, MovingObstacle):
        shape: Any = _in_form(obstacle.shape, form)
        return replace(obstacle, shape=shape)
    if isinstance(obstacle, SphereObstacle) and obstacle.form is None:
        return replace(obstacle, form=form)
    return obstacle


def check_places(
    scenario: Scenario, numbered: Iterable[tuple[int, AnyObstacle]]
) -> None:
    """Checks that start and target are clear of the obstacles, with their margins.

    A moving obstacle may pass over the target.

    Raises:
        InvalidValueError: One is not, or a point of the body is not the vehicle's.
    """
    state, at_start = np.array(scenario.initial_state), []
    for i, each in enumerate(body(scenario)):
        with below("body", i):
            at_start.append((each.radius, each.place(state)))
    for i, obstacle in numbered:
        if not isinstance(obstacle, Shape):
            continue
        places = [("initial_state", *each) for each in at_start]
        if not obstacle.moves:
            places.append(("target", 0.0, scenario.target))
        for name, radius, place in places:
            height = obstacle.grown(radius).height(place)
            rule = f"outside obstacles[{i}], margin included; its signed distance is"
            require(height > 0.0, name, [*place], f"{rule} {height:.3g} m")


def check_limits(scenario: Scenario) -> None:
    """Checks that the start is inside the ranges of states and the robot's own limits.

    Raises:
        InvalidValueError: It is not.
    """
    state = np.array(scenario.initial_state, dtype=float)
    for obstacle in scenario.obstacles:
        if isinstance(obstacle, StateLimit):
            value = state[scenario.state_names.index(str(obstacle.state))]
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


def check_fits(
    obstacle: AnyObstacle, path: tuple[str | int, ...], names: Sequence[str], size: int
) -> None:
    """Checks that an obstacle has `size` dimensions, or names one of these states.

    Raises:
        InvalidValueError: It does not fit.
    """
    if isinstance(obstacle, MovingObstacle):
        check_fits(obstacle.shape, (*path, "shape"), names, size)
    elif isinstance(obstacle, StateLimit):
        require_choice((*path, "state"), obstacle.state, names)
    elif isinstance(obstacle, SphereObstacle):
        check_finite((*path, "center"), obstacle.center, size=size)
    elif isinstance(obstacle, Shape) and not isinstance(obstacle, PolygonObstacle):
        found = obstacle.dimensions
        rule = f"of {size} dimensions, like the target"
        require(found == size, path, f"{found} dimensions", rule)
