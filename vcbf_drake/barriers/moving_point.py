"""A point that moves at a constant velocity: where an obstacle is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vcbf_drake.checks import Array, finite_vector


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
        if len(point) not in (2, 3):
            raise ValueError(
                f"{name}: center must have 2 or 3 numbers, got {len(point)}"
            )
        given = () if velocity is None else velocity
        speed = finite_vector(
            given if len(given) else np.zeros(len(point)), f"{name}: velocity"
        )
        if len(speed) != len(point):
            raise ValueError(
                f"{name}: velocity must have {len(point)} numbers like center,"
                f" got {len(speed)}"
            )
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
