"""The ``feasible_set`` port's value: arrays in one vector, so that it can be logged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vcbf_drake.errors import Array


class PackedFeasibleSet(NamedTuple):
    """The ``feasible_set`` port's value, taken apart; leading axes are kept.

    Attributes:
        A: Rows in physical inputs, (..., rows, m).
        b: Right-hand sides, (..., rows).
        shape: The largest ellipsoid's symmetric B, (..., m, m); nan when empty.
        center: Its center, (..., m); nan when empty.
    """

    A: Array
    b: Array
    shape: Array
    center: Array


def pack_feasible_set(parts: PackedFeasibleSet) -> Array:
    """Returns the parts as one vector."""
    return np.concatenate([part.ravel() for part in parts])


def unpack_feasible_set(
    packed: Array, num_rows: int, num_inputs: int
) -> PackedFeasibleSet:
    """Takes apart one value, or an array of values, of the ``feasible_set`` port.

    Args:
        packed: Shape (..., size of the port).
        num_rows: Rows of the set.
        num_inputs: m.
    """
    rows, m, lead = num_rows, num_inputs, packed.shape[:-1]
    A, b, shape, center = np.split(packed, np.cumsum([rows * m, rows, m * m]), axis=-1)
    return PackedFeasibleSet(
        A.reshape(*lead, rows, m), b, shape.reshape(*lead, m, m), center
    )
