"""An ellipsoid to stay clear of, standing or moving."""

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
from vcbf_drake.checks import Array, check_parameter
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class EllipsoidObstacle:
    """An ellipsoid, or in the plane an ellipse, that moves at a constant velocity.

    With the semi-axes a_i along the columns of R, Q = R diag(1 / a_i^2) R' and the
    centre c(t), its barrier is::

        h = min(a) (sqrt((p - c(t))' Q (p - c(t))) - 1) - margin    [m]

    The factor min(a) makes h a length: outside it never exceeds the distance to the
    surface less the margin, and equals it along the shortest axis. The set h = 0 is the
    ellipsoid scaled by 1 + margin / min(a). Smooth except at the centre. Relative
    degree 2 for a position that forces accelerate (`Blimp`, `Car`). Source: ours.

    Attributes:
        center: The centre at t = 0, shape (k,) with k = 2 or 3 [m].
        semi_axes: a, shape (k,) [m].
        rotation: R, whose columns are the axes' directions, shape (k, k); None: they
            are the coordinate axes.
        velocity: The centre's velocity, shape (k,) [m/s]; None or empty: it stands.
        margin: The distance to keep from the surface, at least [m].
    """

    center: Sequence[float] | Array
    semi_axes: Sequence[float] | Array
    rotation: Sequence[Sequence[float]] | Array | None = None
    velocity: Sequence[float] | Array | None = None
    margin: float = 0.0

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: Shapes that do not fit, a semi-axis that is not positive, axes
                that are not orthonormal, a negative margin, or a number that is not
                finite.
        """
        size = self._center.size
        check_parameter("ellipsoid: semi_axes", self.semi_axes, size=size)
        rotation_matrix(self.rotation, size, "ellipsoid")
        check_parameter("ellipsoid: margin", self.margin, zero_allowed=True)

    @property
    def shape(self) -> Array:
        """The matrix Q, shape (k, k) [1/m^2]."""
        return (self._axes / np.square(self.semi_axes)) @ self._axes.T

    def center_at(self, t: float | Array) -> Array:
        """Returns the centre at time t [s], shape (k,); for times (T,), (T, k) [m]."""
        return self._center.at(t)

    def barrier(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "ellipsoid",
    ) -> Barrier:
        """Returns the barrier that keeps clear of the ellipsoid.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: Which states are the position, or a function from the symbolic
                state x to it; by default the first k states.
            name: What error messages and logs call it.

        Raises:
            ValueError: `position` has not one index a dimension, or bad gains.
        """
        frame = LocalFrame(self._center, (self._axes / self.semi_axes).T)
        at = position_function(position, frame.center.size, name)
        parameters = [*frame.parameters, min(self.semi_axes), self.margin]
        return Barrier(_ellipsoid(at, frame), gains, parameters, name)

    @property
    def _center(self) -> MovingPoint:
        return MovingPoint.of(self.center, self.velocity, "ellipsoid")

    @property
    def _axes(self) -> Array:
        return rotation_matrix(self.rotation, self._center.size, "ellipsoid")


def _ellipsoid(position: PositionFunction, frame: LocalFrame) -> BarrierFunction:
    """Returns h(x, t, p) with p = (frame, min(a), margin)."""

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        # The frame is scaled by the semi-axes, so |z|^2 = (p - c)' Q (p - c).
        z, (shortest, margin) = frame.coordinates(position(x), t, p)
        return shortest * ((z @ z) ** 0.5 - 1.0) - margin

    return h
