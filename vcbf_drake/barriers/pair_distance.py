"""Two robots that keep a distance from each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier, BarrierFunction
from vcbf_drake.barriers.position import PositionFunction, position_function
from vcbf_drake.checks import Array, check_parameter
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class PairDistance:
    """Two positions p and q of one stacked state that keep a distance D.

    Its barrier is::

        h = |p - q| - D    [m]

    Smooth where p and q differ. Relative degree 2 where forces accelerate both robots
    (`Blimp`, `Car`); one filter then moves both of them. Source: ours.

    Attributes:
        distance: The least distance D between the two positions [m].
    """

    distance: float

    def __post_init__(self) -> None:
        """Checks the distance.

        Raises:
            ValueError: It is not positive and finite.
        """
        check_parameter("pair: distance", self.distance)

    def barrier(
        self,
        gains: Sequence[float] | Array,
        first: Sequence[int],
        second: Sequence[int],
        name: str = "pair",
    ) -> Barrier:
        """Returns the barrier that keeps the two apart.

        Args:
            gains: K of (E4); their number is the relative degree.
            first: Which states are the position p.
            second: Which states are the position q, as many.
            name: What error messages and logs call it.

        Raises:
            ValueError: The two positions are not of one size, or the same, or bad
                gains.
        """
        p = position_function(first, len(first), name)
        q = position_function(second, len(first), name)
        if list(first) == list(second):
            raise ValueError(
                f"barrier '{name}': first and second are both {list(first)}"
            )
        return Barrier(_pair(p, q), gains, [self.distance], name)


def _pair(first: PositionFunction, second: PositionFunction) -> BarrierFunction:
    """Returns h(x, t, p) with p = (D,)."""

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        offset = first(x) - second(x)
        return (offset @ offset) ** 0.5 - p[0]

    return h
