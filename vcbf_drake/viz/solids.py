"""Obstacles that are no spheres, as pictures show them: Drake's shapes, outlines."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import Box, Capsule, Ellipsoid, Shape
from pydrake.math import RigidTransform, RotationMatrix

from vcbf_drake.barriers import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    Geofence,
    HalfSpace,
)
from vcbf_drake.checks import Array

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario


@dataclass(frozen=True)
class Solid:
    """A convex obstacle.

    Attributes:
        shape: One of Drake's shapes.
        pose: Where it is at time 0; in the plane it stands on z = 0.
        velocity: How fast it moves, shape (3,) [m/s].
        surface: Points whose hull it is, shape (k, 3) [m].
    """

    shape: Shape
    pose: RigidTransform
    velocity: Array
    surface: Array

    def pose_at(self, time: float) -> RigidTransform:
        """Where it is at a time [s]."""
        offset = time * self.velocity
        return RigidTransform(self.pose.rotation(), self.pose.translation() + offset)

    def outline(self, pair: list[int], time: float) -> Array:
        """The corners of its shadow on two axes at a time [s], in order, (c, 2) [m]."""
        return hull(self.surface[:, pair] + time * self.velocity[pair])


@dataclass(frozen=True)
class Wall:
    """A plane that is not crossed, ``normal . p = offset``.

    Attributes:
        normal: Points to the safe side, of length 1, shape (3,).
        offset: Its distance from the origin [m].
    """

    normal: Array
    offset: float

    def slab(self, middle: Array, size: float, height: float) -> tuple[Box, Array]:
        """A thin slab on its unsafe side, and its pose's matrix (4, 4).

        Args:
            middle: What it is centred on, shape (3,) [m].
            size: How long it is [m].
            height: How high, where it is upright [m].
        """
        thin = 0.004 * size
        foot = middle + (self.offset - self.normal @ middle) * self.normal
        is_upright = abs(self.normal[2]) < 0.5
        tall = height if is_upright else size
        turn = RotationMatrix.MakeFromOneVector(self.normal, 0)
        if is_upright:
            up = np.array([0.0, 0.0, 1.0])
            columns = [self.normal, np.cross(up, self.normal), up]
            turn = RotationMatrix(np.column_stack(columns))
            foot = foot + 0.5 * (height - 2.0 * foot[2]) * up
        place = foot - 0.5 * thin * self.normal
        return Box(thin, size, tall), RigidTransform(turn, place).GetAsMatrix4()


def solids_of(scenario: Scenario, height: float) -> list[Solid]:
    """The convex obstacles of a scenario that are no spheres.

    Args:
        scenario: The scenario.
        height: How high they are in the plane [m].
    """
    kinds = (EllipsoidObstacle, BoxObstacle, CapsuleObstacle)
    found = (each for each in scenario.obstacles if isinstance(each, kinds))
    return [_solid(each, height) for each in found]


def walls_of(scenario: Scenario) -> list[Wall]:
    """The half-spaces of a scenario, and the sides of its fences."""
    walls: list[HalfSpace] = []
    for each in scenario.obstacles:
        if isinstance(each, HalfSpace):
            walls.append(each)
        elif isinstance(each, Geofence):
            walls += each.half_spaces.values()
    normals = [_in_space(each.normal) for each in walls]
    lengths = [float(np.linalg.norm(normal)) for normal in normals]
    return [
        Wall(normal / length, each.offset / length)
        for each, normal, length in zip(walls, normals, lengths, strict=True)
    ]


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
    return np.array(chain(ordered) + chain(ordered[::-1]))


def _solid(
    obstacle: EllipsoidObstacle | BoxObstacle | CapsuleObstacle, height: float
) -> Solid:
    plane = len(obstacle.center_at(0.0)) == 2
    lift = np.array([0.0, 0.0, 0.5 * height if plane else 0.0])
    place = _in_space(obstacle.center_at(0.0)) + lift
    velocity = _in_space(obstacle.moving_center.velocity)
    tall = [0.5 * height] if plane else []
    if isinstance(obstacle, CapsuleObstacle):
        along = _in_space(obstacle.end) - _in_space(obstacle.start)
        turn = RotationMatrix.MakeFromOneVector(along, 2)
        if plane:
            place = place - lift
        length = float(np.linalg.norm(along))
        ends = [0.5 * along, -0.5 * along]
        round_off = obstacle.radius * _ball()
        surface = np.vstack([place + end + round_off for end in ends])
        shape: Shape = Capsule(obstacle.radius, length)
        return Solid(shape, RigidTransform(turn, place), velocity, surface)
    matrix = np.eye(3)
    if obstacle.rotation is not None and len(obstacle.rotation):
        size = len(obstacle.rotation)
        matrix[:size, :size] = obstacle.rotation
    turn = RotationMatrix(matrix)
    if isinstance(obstacle, BoxObstacle):
        half = np.array([*obstacle.half_widths, *tall])
        shape = Box(*(2.0 * half))
        body = half * np.array(list(product((-1.0, 1.0), repeat=3)))
    else:
        half = np.array([*obstacle.semi_axes, *tall])
        shape = Ellipsoid(*half)
        body = half * _ball()
    return Solid(shape, RigidTransform(turn, place), velocity, place + body @ matrix.T)


def _ball() -> Array:
    """Points all over the unit sphere, its equator and meridians among them."""
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    rise = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
    turns, rises = (each.ravel() for each in np.meshgrid(turn, rise))
    around = [np.cos(turns) * np.cos(rises), np.sin(turns) * np.cos(rises)]
    return np.column_stack([*around, np.sin(rises)])


def _in_space(point: object) -> Array:
    numbers = np.asarray(point, dtype=float)
    return np.concatenate([numbers, np.zeros(3 - len(numbers))])
