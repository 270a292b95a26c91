"""A box to stay inside of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.half_space import HalfSpace
from vcbf_drake.barriers.position import Position
from vcbf_drake.checks import Array, check_parameter

_AXES = "xyz"


@dataclass(frozen=True)
class Geofence:
    """The box ``lower <= p <= upper`` that the position p must stay in.

    One `HalfSpace` a side, so one smooth barrier a side::

        h = p_i - lower_i - margin,    h = upper_i - p_i - margin    [m]

    Relative degree as for `HalfSpace`. Source: ours.

    Attributes:
        lower: Shape (k,) with k = 2 or 3; -inf where a side is open [m].
        upper: Shape (k,); inf where a side is open [m].
        margin: The distance to keep from every side [m].
    """

    lower: Sequence[float] | Array
    upper: Sequence[float] | Array
    margin: float = 0.0

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: Not 2 or 3 dimensions, no room inside, every side open, a
                negative margin, or a number that is nan.
        """
        check_parameter("geofence: margin", self.margin, zero_allowed=True)
        lower, upper = (np.asarray(v, dtype=float) for v in (self.lower, self.upper))
        if lower.shape not in ((2,), (3,)) or upper.shape != lower.shape:
            raise ValueError(
                "geofence: lower and upper must have 2 or 3 numbers each, got shapes"
                f" {lower.shape} and {upper.shape}"
            )
        if not (upper - lower > 2.0 * self.margin).all():
            raise ValueError(
                "geofence: upper must be above lower by more than twice the margin,"
                f" got {lower.tolist()} and {upper.tolist()}"
            )
        if not np.isfinite([lower, upper]).any():
            raise ValueError("geofence: at least one side must be finite")

    @property
    def half_spaces(self) -> dict[str, HalfSpace]:
        """Its sides: "x low", "x high", "y low" and so on; open ones are left out."""
        axes = np.eye(len(self.lower))
        sides = {}
        for letter, axis, low, high in zip(
            _AXES[: len(axes)], axes, self.lower, self.upper, strict=True
        ):
            if np.isfinite(low):
                sides[f"{letter} low"] = HalfSpace(axis, low, self.margin)
            if np.isfinite(high):
                sides[f"{letter} high"] = HalfSpace(-axis, -high, self.margin)
        return sides

    def barriers(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str = "geofence",
    ) -> list[Barrier]:
        """Returns one barrier a side.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: Which states are the position, or a function from the symbolic
                state x to it; by default the first k states.
            name: What error messages and logs call it; the side is added.

        Raises:
            ValueError: `position` has not one index a dimension, or bad gains.
        """
        return [
            half_space.barrier(gains, position, f"{name} ({side})")
            for side, half_space in self.half_spaces.items()
        ]
