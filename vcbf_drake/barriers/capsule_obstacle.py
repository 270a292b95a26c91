"""A capsule to stay clear of, standing or moving: a pole, a pipe, a limb."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
from vcbf_drake.barriers.smooth_excess import smooth_excess
from vcbf_drake.checks import Array, check_parameter, finite_vector
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class CapsuleObstacle:
    """All points within a radius of a segment that moves at a constant velocity.

    With the segment's middle c(t) and half-length a, the position z along the segment
    and y across it, both from c(t), and how far s(z) the position is beyond the ends,
    rounded over the length e::

        h = sqrt(|y|^2 + s(z)^2) - gap - radius - margin                  [m]
        s(z) = (sqrt((z - a)^2 + e^2) + sqrt((z + a)^2 + e^2)) / 2 - a

    h is smooth everywhere and conservative: it never exceeds the exact signed distance
    to the capsule less the margin, and is less by at most the gap, e / 2 for a capsule
    much longer than e. Relative degree 2 for a position that forces accelerate
    (`Blimp`, `Car`). Source: ours.

    Attributes:
        start: One end of the segment at t = 0, shape (k,) with k = 2 or 3 [m].
        end: The other end at t = 0, shape (k,) [m].
        radius: [m].
        velocity: The segment's velocity, shape (k,) [m/s]; None or empty: it stands.
        margin: The distance to keep from the surface [m].
        smoothing: The length e [m].
    """

    start: Sequence[float] | Array
    end: Sequence[float] | Array
    radius: float
    velocity: Sequence[float] | Array | None = None
    margin: float = 0.0
    smoothing: float = 0.05

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: Shapes that do not fit, a segment of no length, a negative
                radius or margin, a smoothing that is not positive, or a number that is
                not finite.
        """
        start = finite_vector(self.start, "capsule: start")
        end = finite_vector(self.end, "capsule: end")
        if start.shape != end.shape or (start == end).all():
            raise ValueError(
                "capsule: start and end must be two different points of one size,"
                f" got {start.tolist()} and {end.tolist()}"
            )
        MovingPoint.of(start, self.velocity, "capsule")
        check_parameter("capsule: radius", self.radius, zero_allowed=True)
        check_parameter("capsule: margin", self.margin, zero_allowed=True)
        check_parameter("capsule: smoothing", self.smoothing)

    @property
    def half_length(self) -> float:
        """Half the length of the segment [m]."""
        return float(np.linalg.norm(np.subtract(self.end, self.start))) / 2.0

    @property
    def gap(self) -> float:
        """How much less than the exact distance h is, at most [m]."""
        a = self.half_length
        return float(smooth_excess(a, a, self.smoothing))

    def center_at(self, t: float | Array) -> Array:
        """Returns the middle at time t [s], shape (k,); for times (T,), (T, k) [m]."""
        return self._center.at(t)

    def barrier(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "capsule",
    ) -> Barrier:
        """Returns the barrier that keeps clear of the capsule.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: Which states are the position, or a function from the symbolic
                state x to it; by default the first k states.
            name: What error messages and logs call it.

        Raises:
            ValueError: `position` has not one index a dimension, or bad gains.
        """
        frame = LocalFrame(self._center, _axes_along(np.subtract(self.end, self.start)))
        at = position_function(position, frame.center.size, name)
        parameters = [
            *frame.parameters,
            self.half_length,
            self.smoothing,
            self.gap + self.radius + self.margin,
        ]
        return Barrier(_capsule(at, frame), gains, parameters, name)

    @property
    def _center(self) -> MovingPoint:
        middle = np.add(self.start, self.end) / 2.0
        return MovingPoint.of(middle, self.velocity, "capsule")


def _axes_along(direction: Array) -> Array:
    """Returns orthonormal rows, shape (k, k), the first along the direction."""
    _, _, rows = np.linalg.svd(direction[np.newaxis])
    return rows


def _capsule(position: PositionFunction, frame: LocalFrame) -> BarrierFunction:
    """Returns h(x, t, p) with p = (frame, a, e, gap + radius + margin)."""

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        (z, *y), (half_length, smoothing, clear) = frame.coordinates(position(x), t, p)
        s = smooth_excess(z, half_length, smoothing)
        return (np.dot(y, y) + s**2) ** 0.5 - clear

    return h
