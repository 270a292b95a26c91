"""What of a state is a position: some of its entries, or a function of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from vcbf_drake.model.compiled import Expressions

PositionFunction: TypeAlias = Callable[[Expressions], Expressions]
Position: TypeAlias = Sequence[int] | PositionFunction
"""Indices of k states, or a function from the symbolic x (n,) to the position (k,)."""


def position_function(
    position: Position | None, size: int, name: str
) -> PositionFunction:
    """Returns the position as a function of the symbolic state.

    Args:
        position: Indices or a function; None for the first states.
        size: How many dimensions k the position has.
        name: The barrier's name, for the error message.

    Raises:
        ValueError: Not one index per dimension, or one of them twice.
    """
    if callable(position):
        return _checked(position, size)
    indices = list(range(size) if position is None else position)
    if len(indices) != size or len(set(indices)) != size:
        raise ValueError(
            f"barrier '{name}': position must name {size} states, got {indices}"
        )
    return lambda x: x[indices]


def _checked(position: PositionFunction, size: int) -> PositionFunction:
    def checked(x: Expressions) -> Expressions:
        point = position(x)
        if len(point) != size:
            raise ValueError(
                f"position(x) must return {size} numbers, not {len(point)}"
            )
        return point

    return checked
