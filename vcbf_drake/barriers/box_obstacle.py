"""A box to stay clear of, standing or moving."""

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
from vcbf_drake.barriers.rotation import rotation_matrix
from vcbf_drake.barriers.smooth_excess import smooth_excess
from vcbf_drake.checks import Array, check_parameter
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class BoxObstacle:
    """A box, or in the plane a rectangle, that moves at a constant velocity.

    With z = R' (p - c(t)), the position along the box's own axes, the half-widths a
    and how far s(z_i) the position is beyond each of them, rounded over the length e::

        h = |s| - gap - margin                                            [m]
        s(z_i) = (sqrt((z_i - a_i)^2 + e^2) + sqrt((z_i + a_i)^2 + e^2)) / 2 - a_i

    h is smooth everywhere and conservative: it never exceeds the exact distance to the
    box less the margin, and is less by at most the gap, sqrt(k) e / 2 for a box much
    wider than e. Inside the box h is negative but flat, so a position deep inside is
    hardly pushed out. Relative degree 2 for a position that forces accelerate (`Blimp`,
    `Car`). Source: ours.

    Attributes:
        center: The centre at t = 0, shape (k,) with k = 2 or 3 [m].
        half_widths: a, shape (k,); 0 for a plate [m].
        rotation: R, whose columns are the box's own axes, shape (k, k); None: they are
            the coordinate axes.
        velocity: The centre's velocity, shape (k,) [m/s]; None or empty: it stands.
        margin: The distance to keep from the surface [m].
        smoothing: The length e [m].
    """

    center: Sequence[float] | Array
    half_widths: Sequence[float] | Array
    rotation: Sequence[Sequence[float]] | Array | None = None
    velocity: Sequence[float] | Array | None = None
    margin: float = 0.0
    smoothing: float = 0.05

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: Shapes that do not fit, a negative half-width or margin, axes
                that are not orthonormal, a smoothing that is not positive, or a number
                that is not finite.
        """
        size = self._center.size
        check_parameter(
            "box: half_widths", self.half_widths, size=size, zero_allowed=True
        )
        rotation_matrix(self.rotation, size, "box")
        check_parameter("box: margin", self.margin, zero_allowed=True)
        check_parameter("box: smoothing", self.smoothing)

    @property
    def gap(self) -> float:
        """How much less than the exact distance h is, at most [m]."""
        a = np.asarray(self.half_widths, dtype=float)
        return float(np.linalg.norm(smooth_excess(a, a, self.smoothing)))

    def center_at(self, t: float | Array) -> Array:
        """Returns the centre at time t [s], shape (k,); for times (T,), (T, k) [m]."""
        return self._center.at(t)

    def barrier(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "box",
    ) -> Barrier:
        """Returns the barrier that keeps clear of the box.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: Which states are the position, or a function from the symbolic
                state x to it; by default the first k states.
            name: What error messages and logs call it.

        Raises:
            ValueError: `position` has not one index a dimension, or bad gains.
        """
        center, R = self._center, self.rotation
        axes = None if R is None else rotation_matrix(R, center.size, "box").T
        frame = LocalFrame(center, axes)
        at = position_function(position, center.size, name)
        parameters = [
            *frame.parameters,
            *self.half_widths,
            self.smoothing,
            self.gap + self.margin,
        ]
        return Barrier(_box(at, frame), gains, parameters, name)

    @property
    def _center(self) -> MovingPoint:
        return MovingPoint.of(self.center, self.velocity, "box")


def _box(position: PositionFunction, frame: LocalFrame) -> BarrierFunction:
    """Returns h(x, t, p) with p = (frame, a, e, gap + margin)."""
    k = frame.center.size

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        z, p = frame.coordinates(position(x), t, p)
        half_widths, (smoothing, clear) = p[:k], p[k:]
        s = smooth_excess(z, half_widths, smoothing)
        return (s @ s) ** 0.5 - clear

    return h
