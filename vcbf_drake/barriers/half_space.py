"""One side of a plane to stay on: a floor, a wall, a fence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier, BarrierFunction
from vcbf_drake.barriers.position import (
    Position,
    PositionFunction,
    position_function,
)
from vcbf_drake.checks import Array, check_parameter, finite_vector
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class HalfSpace:
    """The half-space ``normal . p >= offset`` that the position p must stay in.

    With the unit normal n = normal / |normal| its barrier is the distance::

        h = n . p - offset / |normal| - margin    [m]

    Smooth everywhere. Relative degree 2 for a position that forces accelerate (`Blimp`,
    `Car`), 1 for one whose velocity is an input. Source: ours.

    Attributes:
        normal: Points to the safe side; of any length, shape (k,) with k = 2 or 3.
        offset: ``normal . p`` on the plane [m, if the normal is a unit vector].
        margin: The distance to keep from the plane [m].
    """

    normal: Sequence[float] | Array
    offset: float = 0.0
    margin: float = 0.0

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: Not 2 or 3 dimensions, a normal of no length, a negative margin,
                or a number that is not finite.
        """
        normal = finite_vector(self.normal, "half-space: normal")
        if len(normal) not in (2, 3) or not normal.any():
            raise ValueError(
                "half-space: normal must have 2 or 3 numbers, not all 0,"
                f" got {normal.tolist()}"
            )
        finite_vector([self.offset], "half-space: offset")
        check_parameter("half-space: margin", self.margin, zero_allowed=True)

    def barrier(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "half-space",
    ) -> Barrier:
        """Returns the barrier that keeps the position in the half-space.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: Which states are the position, or a function from the symbolic
                state x to it; by default the first k states.
            name: What error messages and logs call it.

        Raises:
            ValueError: `position` has not one index a dimension, or bad gains.
        """
        normal = np.asarray(self.normal, dtype=float)
        length = np.linalg.norm(normal)
        parameters = [*(normal / length), self.offset / length + self.margin]
        at = position_function(position, len(normal), name)
        return Barrier(_half_space(at), gains, parameters, name)


def _half_space(position: PositionFunction) -> BarrierFunction:
    """Returns h(x, t, p) with p = (n, offset + margin)."""

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        return p[:-1] @ position(x) - p[-1]

    return h
