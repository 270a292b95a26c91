"""Obstacles that move along waypoints, or as perception reports at every tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.obstacles import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    SphereForm,
    SphereObstacle,
)
from vcbf_drake.barriers.polygons import PolygonObstacle
from vcbf_drake.barriers.shapes import Shape, SmoothShape
from vcbf_drake.checks import Array, finite_array, require
from vcbf_drake.model.position import Position
from vcbf_drake.typed import NotNegative, check_fields, typed

CarriedShape: TypeAlias = (
    SphereObstacle | EllipsoidObstacle | CapsuleObstacle | BoxObstacle | PolygonObstacle
)


@dataclass
class MovingObstacle(Shape):
    """A shape that moves along waypoints, on a cubic spline.

    It is at rest before the first and after the last of them. Its velocity is
    continuous everywhere, its acceleration in between.

    Attributes:
        shape: The shape, without a velocity of its own.
        times: Increasing arrival times at the waypoints, at least two [s].
        waypoints: Displacements from the shape's own position, (T, k) [m]: the
            positions themselves if its center is 0.
    """

    shape: CarriedShape
    times: list[float]
    waypoints: list[list[float]]

    def __post_init__(self) -> None:
        check_fields(self)
        own = getattr(self.shape, "velocity", None)
        rule = "left out: waypoints move it"
        require(not self.shape.moves, ("shape", "velocity"), own, rule)
        times = finite_array(self.times, "times", 1, "a list of finite numbers")
        rises = len(times) >= 2 and bool(np.all(np.diff(times) > 0.0))
        require(rises, "times", self.times, "two at least, increasing")
        size = self.dimensions
        rule = f"{len(times)} rows, one a time, of {size} finite numbers each"
        places = finite_array(self.waypoints, "waypoints", 2, rule)
        fits = places.shape == (len(times), size)
        require(fits, "waypoints", self.waypoints, rule)

    @property
    def kind(self) -> str:  # type: ignore[override]
        """The name of its barriers."""
        return self.shape.kind

    @property
    def moves(self) -> bool:
        """True: it moves."""
        return True

    def parts(self) -> Mapping[str, SmoothShape]:
        """Returns the shape's parts at their own positions."""
        return self.shape.parts()

    def grown(self, distance: float) -> MovingObstacle:
        """Returns the same with a margin that is larger by a distance [m]."""
        return replace(self, shape=self.shape.grown(distance))

    def height(self, position: Sequence[float] | Array, t: float = 0.0) -> float:
        """Returns the least h of its barriers at a position and a time [s]."""
        place, offset = np.array(position, dtype=float), self.offset_at(t)
        place[: len(offset)] -= offset  # A polygon is a pillar in space.
        return self.shape.height(place)

    def _barrier_of(self, part: SmoothShape, *arguments: Any) -> Barrier:
        return part.barrier_along(self.trajectory(), *arguments)

    def trajectory(self) -> PiecewisePolynomial:
        """Returns its displacement as a trajectory, (k, 1) [m], with ends at rest."""
        rest = np.zeros(self.dimensions)
        return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            self.times, np.transpose(self.waypoints), rest, rest
        )

    def offset_at(self, time: float) -> Array:
        """Returns its displacement at a time [s], shape (k,) [m]."""
        start, end = self.times[0], self.times[-1]
        offset: Array = self.trajectory().value(min(max(time, start), end)).ravel()
        return offset


@dataclass(frozen=True)
class PerceivedSpheres:
    """Spheres, or in the plane discs, that an input port describes at every tick.

    The filter's port ``obstacles`` has `capacity` slots, one after the other, each::

        centre (k,) [m], velocity (k,) [m/s], radius [m], valid

    * valid = 1: a sphere. Its barrier is that of a `SphereObstacle` which is there now
      and keeps its velocity; rows and volume row include that motion (E2).
    * valid = 0: an empty slot, whatever its other numbers. It has no part in the tick.
    * Any other `valid`, a negative radius, or a number of a valid slot that is not
      finite: the slot's row is nan, and the filter answers with `FilterStatus.FAILED`.

    Source: ours.

    Attributes:
        capacity: The number of slots.
        dimensions: The number k of dimensions, 2 or 3.
        form: "distance" or "squared", as in `SphereObstacle`.
        margin: The distance to keep from every surface [m].
    """

    capacity: int
    dimensions: int = 3
    form: SphereForm = "distance"
    margin: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "perceived: ")
        if self.capacity < 1:
            raise ValueError(f"perceived: capacity must be >= 1, got {self.capacity}")
        self._example()

    @property
    def slot_size(self) -> int:
        """The number of numbers in a slot."""
        return 2 * self.dimensions + 2

    @property
    def size(self) -> int:
        """The size of the port ``obstacles``."""
        return self.capacity * self.slot_size

    @typed
    def barriers(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "perceived",
    ) -> list[Barrier]:
        """Returns one barrier per slot.

        Args:
            gains: As for `Shape.barriers`, like position.
            position: Likewise.
            name: Their name, before the slot's number.
        """
        barriers = [
            self._example().barrier(gains, position, f"{name} {i}")
            for i in range(self.capacity)
        ]
        for i, barrier in enumerate(barriers):
            barrier.changes = Slot(self, i)
        return barriers

    @typed
    def pack(
        self, centers: ArrayLike, velocities: ArrayLike, radii: ArrayLike
    ) -> Array:
        """Returns the value of the port for n obstacles, shape (size,).

        Args:
            centers: Shape (n, k) [m].
            velocities: Shape (n, k) [m/s].
            radii: Shape (n,) [m].

        Raises:
            ValueError: More obstacles than slots, or shapes that do not fit.
        """
        c, v, r = (np.asarray(part, float) for part in (centers, velocities, radii))
        n, k = r.size, self.dimensions
        if n > self.capacity:
            raise ValueError(f"perceived: {n} obstacles, but {self.capacity} slots")
        if r.shape != (n,) or (n and not c.shape == v.shape == (n, k)):
            raise ValueError(
                f"perceived: got centers {c.shape}, velocities {v.shape} and radii"
                f" {r.shape}; they must be (n, {k}), (n, {k}) and (n,)"
            )
        slots = np.zeros((self.capacity, self.slot_size))
        slots[:n, :k], slots[:n, k:-2] = c.reshape(n, k), v.reshape(n, k)
        slots[:n, -2], slots[:n, -1] = r, 1.0
        return slots.ravel()

    def _example(self) -> SphereObstacle:
        """An example of a slot's sphere, with a velocity, since the sphere may move."""
        zero, one = np.zeros(self.dimensions), np.ones(self.dimensions)
        return SphereObstacle(zero, 1.0, one, self.margin, self.form)


@dataclass(frozen=True)
class Slot:
    """The parameters of the barrier of one slot.

    Attributes:
        spheres: The spheres that the slot belongs to.
        number: The slot's number, from 0.
    """

    spheres: PerceivedSpheres
    number: int

    def parameters_at(
        self, t: float, obstacles: Array | None
    ) -> tuple[float, ...] | None:
        """Returns the parameters, nan if the slot is malformed; None if it is empty."""
        size, each = self.spheres.size, self.spheres.slot_size
        if obstacles is None or obstacles.shape != (size,):
            raise ValueError(
                f"obstacles: expected shape ({size},), got"
                f" {None if obstacles is None else obstacles.shape}"
            )
        start = self.number * each
        *motion, radius, valid = obstacles[start : start + each].tolist()
        if valid == 0.0:
            return None
        parameters = (radius + self.spheres.margin, t, *motion)
        if valid == 1.0 and radius >= 0.0 and all(map(math.isfinite, parameters)):
            return parameters
        return (math.nan,) * len(parameters)
