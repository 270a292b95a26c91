"""Obstacles as pictures show them: convex solids of Drake's shapes, and walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from vcbf_drake.barriers import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    Geofence,
    HalfSpace,
    MovingObstacle,
    PolygonObstacle,
    SphereObstacle,
)
from vcbf_drake.barriers.obstacles import Obstacle
from vcbf_drake.checks import Array
from vcbf_drake.plants.shapes import CIRCLE, Part, surface
from vcbf_drake.viz.style import OBSTACLE, SHELL

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario

Thing: TypeAlias = (
    SphereObstacle | EllipsoidObstacle | CapsuleObstacle | BoxObstacle | PolygonObstacle
)

_KEY_TIMES = 100  # Of a path.
_KEEP_OUT_HEIGHT = 0.4  # Of the obstacle's, in the plane, so that this stands out.


@dataclass(frozen=True)
class Solid:
    """A convex obstacle; in the plane it stands on z = 0.

    Attributes:
        body: The obstacle.
        keep_out: The obstacle with its margin around it; None without a margin.
        obstacle: The obstacle that it is a solid of, and moves with.
    """

    body: Part
    keep_out: Part | None
    obstacle: Thing | MovingObstacle

    @property
    def moves(self) -> bool:
        """Whether it moves at all."""
        on_a_path = isinstance(self.obstacle, MovingObstacle)
        return on_a_path or bool(self.offset_at(1.0).any())

    @property
    def surface(self) -> Array:
        """Points whose hull it is at time 0, with its margin, shape (k, 3) [m]."""
        return surface(self.keep_out or self.body)

    def offset_at(self, time: float) -> Array:
        """The displacement at a time [s], shape (3,) [m]."""
        return place_at(self.obstacle, time) - place_at(self.obstacle, 0.0)

    def key_times(self, end: float) -> Array:
        """Times up to an end [s] between which it goes straight on, or nearly."""
        on_a_path = isinstance(self.obstacle, MovingObstacle)
        return np.linspace(0.0, end, _KEY_TIMES if on_a_path else 2)


@dataclass(frozen=True)
class Wall:
    """A plane that is not crossed, ``normal . p = offset``.

    Attributes:
        normal: Points to the safe side, of length 1, shape (3,).
        offset: Its distance from the origin [m].
        margin: The distance to keep from it [m].
    """

    normal: Array
    offset: float
    margin: float

    def slab(
        self, middle: Array, size: float, height: float, thick: float
    ) -> tuple[Box, RigidTransform]:
        """A slab one of whose faces is the wall, and where it is.

        Args:
            middle: The point that it is centred on, shape (3,) [m].
            size: The length [m].
            height: The height, if it is upright [m].
            thick: The thickness, on the safe side; negative for the other side [m].
        """
        is_upright = abs(self.normal[2]) < 0.5
        across = np.cross(np.eye(3)[2 if is_upright else 0], self.normal)
        across /= np.linalg.norm(across)
        up = np.cross(self.normal, across)
        place = middle + (self.offset - self.normal @ middle) * self.normal
        if is_upright:  # It stands on z = 0.
            place = place + (0.5 * height * up[2] - place[2]) / up[2] * up
        place = place + 0.5 * thick * self.normal
        turn = RotationMatrix(np.column_stack([self.normal, across, up]))
        tall = height if is_upright else size
        return Box(abs(thick), size, tall), RigidTransform(turn, place)


def solids_of(scenario: Scenario, height: float = 0.1) -> list[Solid]:
    """The convex obstacles of a scenario.

    Args:
        scenario: The scenario.
        height: The height of obstacles in the plane [m].
    """
    return [
        solid
        for each in scenario.obstacles
        if not isinstance(each, HalfSpace | Geofence)
        for solid in solids(each, height)
    ]


def solids(obstacle: object, height: float) -> Iterator[Solid]:
    """The convex solids that make up an obstacle; none where it is none of these.

    Args:
        obstacle: An obstacle of `vcbf_drake.barriers`.
        height: The height of an obstacle in the plane [m].
    """
    if isinstance(obstacle, MovingObstacle):
        start = RigidTransform(place_at(obstacle, 0.0))
        for each in solids(obstacle.shape, height):
            body, shell = each.body, each.keep_out
            shell = shell and replace(shell, pose=start @ shell.pose)
            yield Solid(replace(body, pose=start @ body.pose), shell, obstacle)
    if not isinstance(obstacle, Thing):
        return
    bodies = _parts("body", OBSTACLE, obstacle, 0.0, height)
    shells: Sequence[Part | None] = [None] * len(bodies)
    if margin := obstacle.margin:
        low = _KEEP_OUT_HEIGHT * height
        shells = _parts("keep_out", SHELL + "33", obstacle, margin, low)
    for body, shell in zip(bodies, shells, strict=True):
        yield Solid(body, shell, obstacle)


def place_at(obstacle: object, time: float) -> Array:
    """The position of an obstacle's centre at a time [s], (3,) [m]; 0 without one."""
    if isinstance(obstacle, MovingObstacle):
        return in_space(obstacle.offset_at(time))
    if isinstance(obstacle, Obstacle):
        return in_space(obstacle.center_at(time))
    return np.zeros(3)


def walls_of(scenario: Scenario) -> list[Wall]:
    """The half-spaces of a scenario, and the sides of its fences."""
    sides: list[HalfSpace] = []
    for each in scenario.obstacles:
        if isinstance(each, HalfSpace):
            sides.append(each)
        elif isinstance(each, Geofence):
            sides += each.parts().values()
    walls = []
    for each in sides:
        normal, length = in_space(each.normal), float(np.linalg.norm(each.normal))
        walls.append(Wall(normal / length, each.offset / length, each.margin))
    return walls


def hull(points: Array) -> Array:
    """The corners of points' convex hull in the plane, counter-clockwise, (c, 2)."""

    def chain(ordered: Array) -> list[Array]:
        kept: list[Array] = []
        for point in ordered:
            while len(kept) > 1:
                a, b = kept[-1] - kept[-2], point - kept[-1]
                if a[0] * b[1] - a[1] * b[0] > 0.0:
                    break
                kept.pop()
            kept.append(point)
        return kept[:-1]

    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    if len(ordered) < 3:
        return ordered
    return np.array(chain(ordered) + chain(ordered[::-1]))


def in_space(point: ArrayLike) -> Array:
    """A point, or points (..., k), of one to three coordinates, the missing ones 0."""
    numbers = np.asarray(point, dtype=float)
    missing = np.zeros((*numbers.shape[:-1], 3 - numbers.shape[-1]))
    return np.concatenate([numbers, missing], axis=-1)


def _parts(
    name: str, color: str, obstacle: Thing, margin: float, height: float
) -> list[Part]:
    """An obstacle and what is nearer to it than a margin."""
    return [
        Part(name, shape, color, pose)
        for shape, pose in _placed_shapes(obstacle, margin, height)
    ]


def _placed_shapes(
    obstacle: Thing, margin: float, height: float
) -> list[tuple[Shape, RigidTransform]]:
    """The shapes that make up an obstacle grown by a margin, with their poses."""
    if isinstance(obstacle, PolygonObstacle):
        return [_pillar(piece, margin, height) for piece in obstacle.pieces]
    plane, place = obstacle.dimensions == 2, in_space(obstacle.center_at(0.0))
    lifted = place + np.array([0.0, 0.0, 0.5 * height if plane else 0.0])
    if isinstance(obstacle, SphereObstacle):
        radius = obstacle.radius + margin
        ball = Cylinder(radius, height) if plane else Sphere(radius)
        return [(ball, RigidTransform(lifted))]
    if isinstance(obstacle, CapsuleObstacle):
        along = in_space(np.subtract(obstacle.end, obstacle.start))
        turn = RotationMatrix.MakeFromOneVector(along, 2)
        capsule = Capsule(obstacle.radius + margin, float(np.linalg.norm(along)))
        return [(capsule, RigidTransform(turn, place))]
    matrix = np.eye(3)
    if obstacle.rotation is not None and len(obstacle.rotation):
        size = len(obstacle.rotation)
        matrix[:size, :size] = obstacle.rotation
    pose = RigidTransform(RotationMatrix(matrix), lifted)
    tall = [0.5 * height] if plane else []
    if isinstance(obstacle, EllipsoidObstacle):
        grown = 1.0 + margin / min(obstacle.semi_axes)
        half = np.array([*np.multiply(obstacle.semi_axes, grown), *tall])
        return [(Ellipsoid(*half), pose)]
    box = Box(*(2.0 * np.array([*obstacle.half_widths, *tall])))
    if margin == 0.0:
        return [(box, pose)]
    corners = surface(Part("", box, pose=pose))
    if plane:
        return [_pillar(hull(corners[:, :2]), margin, height)]
    ball = surface(Part("", Sphere(margin)))
    return [_convex((corners[:, None] + ball).reshape(-1, 3))]


def _pillar(
    corners: Array, margin: float, height: float
) -> tuple[Shape, RigidTransform]:
    """A pillar on z = 0 over a convex polygon, shape (c, 2), grown by a margin."""
    rounded = (corners[:, None] + margin * CIRCLE[:, :2]).reshape(-1, 2)
    foot = in_space(hull(rounded) if margin > 0.0 else corners)
    return _convex(np.vstack([foot, foot + np.array([0.0, 0.0, height])]))


def _convex(corners: Array) -> tuple[Shape, RigidTransform]:
    """The hull of points, shape (k, 3)."""
    middle = corners.mean(axis=0)
    return Convex((corners - middle).T, "obstacle"), RigidTransform(middle)
