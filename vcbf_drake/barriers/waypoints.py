"""Obstacles that move along waypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.obstacles import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    SphereObstacle,
)
from vcbf_drake.barriers.polygons import PolygonObstacle
from vcbf_drake.barriers.shapes import Shape, SmoothShape
from vcbf_drake.checks import Array, finite_array, require
from vcbf_drake.model.position import Position
from vcbf_drake.typed import check_fields

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

    def barriers(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str | None = None,
    ) -> list[Barrier]:
        """Returns the barriers of its parts; see `Shape`."""
        path = self.trajectory()
        return [
            part.barrier_along(path, gains, position, f"{name or self.kind}{end}")
            for end, part in self.parts().items()
        ]

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
