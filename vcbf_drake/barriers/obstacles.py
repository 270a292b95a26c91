"""Obstacles to stay clear of, standing or moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier, BarrierFunction
from vcbf_drake.barriers.local_frame import LocalFrame
from vcbf_drake.barriers.moving_point import MovingPoint
from vcbf_drake.barriers.position import (
    Position,
    PositionFunction,
    position_function,
)
from vcbf_drake.checks import Array, require_choice
from vcbf_drake.model.compiled import Expressions

SphereForm = Literal["distance", "squared"]


@dataclass
class SphereObstacle:
    """A sphere, or in the plane a disc, that moves at a constant velocity.

    With the position p, the centre c(t) and the safety distance R = radius + margin,
    its barrier is one of::

        distance:  h = |p - c(t)| - R        [m]    (E31)
        squared:   h = |p - c(t)|^2 - R^2    [m^2]  (E35)

    Attributes:
        center: The centre at t = 0, shape (k,) with k = 2 or 3 [m].
        radius: The obstacle's own radius [m].
        velocity: The centre's velocity, shape (k,) [m/s]; None or empty: it stands.
        form: "distance" or "squared".
        margin: The distance to keep from the obstacle's surface [m].
    """

    center: Sequence[float] | Array
    radius: float
    velocity: Sequence[float] | Array | None = None
    form: SphereForm = "distance"
    margin: float = 0.0

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: Not 2 or 3 dimensions, a velocity of another size, a negative
                size, nothing to stay clear of (R = 0), an unknown form, or a number
                that is not finite.
        """
        MovingPoint.of(self.center, self.velocity, "obstacle")
        sizes = np.array([self.radius, self.margin], dtype=float)
        if not (np.isfinite(sizes).all() and sizes.min() >= 0.0 < sizes.sum()):
            raise ValueError(
                "obstacle: radius and margin must be >= 0 and not both 0,"
                f" got {self.radius} and {self.margin}"
            )
        require_choice("obstacle: form", self.form, get_args(SphereForm))

    @property
    def safety_distance(self) -> float:
        """The distance R = radius + margin to keep from the centre [m]."""
        return self.radius + self.margin

    def center_at(self, t: float | Array) -> Array:
        """Returns the centre at time t [s], shape (k,); for times (T,), (T, k) [m]."""
        return self._center.at(t)

    def clearance(self, position: Array, t: float | Array) -> float | Array:
        """Returns the signed distance from the obstacle's own surface [m].

        Args:
            position: Shape (k,) or (T, k) [m].
            t: The time [s], or the T times.
        """
        offset = np.asarray(position) - self.center_at(t)
        distance: float | Array = np.linalg.norm(offset, axis=-1) - self.radius
        return distance

    def barrier(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "obstacle",
    ) -> Barrier:
        """Returns the barrier that keeps R clear of the centre.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: Which states are the position, or a function from the symbolic
                state x to it; by default the first k states.
            name: What error messages and logs call it.

        Raises:
            ValueError: `position` has not one index a dimension, or bad gains.
        """
        frame = LocalFrame(self._center)
        at = position_function(position, frame.center.size, name)
        parameters = [*frame.parameters, self.safety_distance]
        return Barrier(_sphere(self.form, at, frame), gains, parameters, name)

    @property
    def _center(self) -> MovingPoint:
        return MovingPoint.of(self.center, self.velocity, "obstacle")


def _sphere(
    form: str, position: PositionFunction, frame: LocalFrame
) -> BarrierFunction:
    """Returns h(x, t, p) with p = (frame, R)."""

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        offset, (clear,) = frame.coordinates(position(x), t, p)
        if form == "squared":
            return offset @ offset - clear**2
        # A power differentiates to much shorter expressions than sqrt() does.
        return (offset @ offset) ** 0.5 - clear

    return h
