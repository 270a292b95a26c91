"""Which states are a position."""

from __future__ import annotations

from collections.abc import Sequence


def position_states(states: Sequence[int] | None, size: int, name: str) -> list[int]:
    """Returns the indices of a position's states, by default the first.

    Args:
        states: The indices, or None.
        size: How many dimensions the position has.
        name: The barrier's name, for the error message.

    Raises:
        ValueError: Not one index per dimension, or one of them twice.
    """
    indices = list(range(size) if states is None else states)
    if len(indices) != size or len(set(indices)) != size:
        raise ValueError(
            f"barrier '{name}': position must name {size} states, got {indices}"
        )
    return indices
