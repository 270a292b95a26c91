"""Where an obstacle is, which way it is turned, and how far a point is beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.checks import (
    Array,
    check_finite,
    finite_array,
    finite_vector,
    require,
)
from vcbf_drake.model.compiled import Expressions

_TOLERANCE = 1e-9


@dataclass(frozen=True)
class MovingPoint:
    """The point start + velocity t, in the plane or in space.

    Attributes:
        start: Where it is at t = 0, shape (k,) with k = 2 or 3 [m].
        velocity: Shape (k,) [m/s].
    """

    start: Array
    velocity: Array

    @staticmethod
    def of(
        start: Sequence[float] | Array,
        velocity: Sequence[float] | Array | None,
        name: str,
    ) -> MovingPoint:
        """Returns the point, checked.

        Args:
            start: Shape (k,) with k = 2 or 3 [m].
            velocity: Shape (k,) [m/s]; None or empty: it stands.
            name: What it is the centre of, for the error message.

        Raises:
            ValueError: Not 2 or 3 dimensions, a velocity of another size, or a number
                that is not finite.
        """
        point = finite_vector(start, f"{name}: center")
        is_place = len(point) in (2, 3)
        require(is_place, f"{name}: center", start, "2 or 3 numbers")
        if velocity is None or not len(velocity):
            return MovingPoint(point, np.zeros(len(point)))
        check_finite(f"{name}: velocity", velocity, size=len(point))
        speed = finite_vector(velocity, f"{name}: velocity")
        return MovingPoint(point, speed)

    @property
    def size(self) -> int:
        """The number k of dimensions."""
        return len(self.start)

    @property
    def moves(self) -> bool:
        """Whether its velocity is not zero."""
        return bool(self.velocity.any())

    def at(self, t: float | Array) -> Array:
        """Returns the point at time t [s], shape (k,); for times (T,), (T, k) [m]."""
        return self.start + np.multiply.outer(t, self.velocity)


@dataclass(frozen=True)
class LocalFrame:
    """The coordinates z = M (p - c(t)) of a position p, as parameters of a barrier.

    They are linear in p and t, z = M p - M c - M v t, with M c and M v computed
    beforehand: that keeps the rows' expressions short.

    Attributes:
        center: c(t) = c + v t, in k dimensions.
        matrix: M, shape (k, k); None for the identity.
    """

    center: MovingPoint
    matrix: Array | None = None

    @property
    def parameters(self) -> list[float]:
        """The numbers of M c, of M v if it moves, and of M if there is one."""
        c, v, M = self.center.start, self.center.velocity, self.matrix
        return [
            *(c if M is None else M @ c),
            *((v if M is None else M @ v) if self.center.moves else ()),
            *(() if M is None else M.flat),
        ]

    def coordinates(
        self, position: Expressions, t: Expression, p: Expressions
    ) -> tuple[Expressions, Expressions]:
        """Returns the symbolic z, and what follows `parameters` in p.

        Args:
            position: The symbolic position, shape (k,).
            t: The symbolic time.
            p: A barrier's symbolic parameters, which begin with `parameters`.
        """
        k = self.center.size
        origin, p = p[:k], p[k:]
        if self.center.moves:
            origin, p = origin + p[:k] * t, p[k:]
        if self.matrix is None:
            return position - origin, p
        return p[: k * k].reshape(k, k) @ position - origin, p[k * k :]


def rotation_matrix(
    rotation: Sequence[Sequence[float]] | Array | None, size: int, name: str
) -> Array:
    """Returns R, whose columns are a shape's own axes, shape (k, k).

    Args:
        rotation: R, or None for the identity.
        size: The number k of dimensions.
        name: What it turns, for the error message.

    Raises:
        ValueError: It has another shape, or its columns are not orthonormal.
    """
    if rotation is None:
        return np.eye(size)
    rule = f"{size} rows of {size} finite numbers each"
    matrix = finite_array(rotation, f"{name}: rotation", 2, rule)
    require(matrix.shape == (size, size), f"{name}: rotation", rotation, rule)
    if not np.abs(matrix.T @ matrix - np.eye(size)).max() <= _TOLERANCE:
        raise ValueError(
            f"{name}: rotation must have orthonormal columns, got {matrix.tolist()}"
        )
    return matrix


def smooth_excess(z: Any, half: Any, smoothing: Any) -> Any:
    """Returns a smooth bound from above on how far z is beyond [-half, half].

    The sum of a smooth positive part at either end, with the smoothing length e::

        s(z) = (sqrt((z - a)^2 + e^2) + sqrt((z + a)^2 + e^2)) / 2 - a

    It is positive and has all derivatives. It exceeds max(|z| - a, 0) everywhere, most
    at the ends, by s(a), which is between e/2 and e. Source: ours.

    Args:
        z: The coordinate, a number, an expression or an array of either [m].
        half: The half-width a [m].
        smoothing: The length e over which an end is rounded [m].
    """
    below = ((z + half) ** 2 + smoothing**2) ** 0.5
    above = ((z - half) ** 2 + smoothing**2) ** 0.5
    return (below + above) / 2 - half
