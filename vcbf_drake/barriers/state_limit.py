"""Limits of one state: a speed, a joint angle, an altitude band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier, BarrierFunction
from vcbf_drake.checks import Array
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class StateLimit:
    """The range ``lower <= x_i <= upper`` of one state.

    One smooth barrier a side, in the state's unit::

        h = x_i - lower,    h = upper - x_i

    The relative degree is the number of gains: 1 for a speed that a force changes, 2
    for a position or a joint angle. Source: ours.

    Attributes:
        state: The index i.
        lower: -inf: no lower limit.
        upper: inf: no upper limit.
    """

    state: int
    lower: float = -np.inf
    upper: float = np.inf

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: No room between the limits, no limit at all, or nan.
        """
        if not self.lower < self.upper:
            raise ValueError(
                "state limit: lower must be below upper,"
                f" got {self.lower} and {self.upper}"
            )
        if not np.isfinite([self.lower, self.upper]).any():
            raise ValueError("state limit: give lower, upper or both")

    def barriers(
        self, gains: Sequence[float] | Array, name: str = "state limit"
    ) -> list[Barrier]:
        """Returns one barrier a side.

        Args:
            gains: K of (E4); their number is the relative degree.
            name: What error messages and logs call it; "low" or "high" is added.

        Raises:
            ValueError: Bad gains.
        """
        sides = (("low", 1.0, self.lower), ("high", -1.0, self.upper))
        return [
            Barrier(_state_limit(self.state), gains, (sign, limit), f"{name} ({side})")
            for side, sign, limit in sides
            if np.isfinite(limit)
        ]


def _state_limit(state: int) -> BarrierFunction:
    """Returns h(x, t, p) with p = (sign, limit)."""

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        sign, limit = p
        return sign * (x[state] - limit)

    return h
