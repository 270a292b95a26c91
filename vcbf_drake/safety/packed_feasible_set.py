"""The ``feasible_set`` port's value: arrays in one vector, so that it can be logged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vcbf_drake.checks import Array


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


def pack_feasible_set(A: Array, b: Array, frame: Array, center: Array) -> Array:
    """Returns a feasible set and an ellipsoid {frame v + center} as one vector.

    The frame need not be symmetric; `unpack_feasible_set` makes it so, of a whole log
    at once.
    """
    return np.concatenate([A.ravel(), b, frame.ravel(), center])


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
    A, b, frame, center = np.split(packed, np.cumsum([rows * m, rows, m * m]), axis=-1)
    shape = _symmetric(frame.reshape(*lead, m, m))
    return PackedFeasibleSet(A.reshape(*lead, rows, m), b, shape, center)


def _symmetric(frames: Array) -> Array:
    """Returns (F F')^(1/2) of every F, shape (..., m, m); nan where F is."""
    known = np.isfinite(frames).all(axis=(-2, -1))
    shapes = np.full_like(frames, np.nan)
    axes, lengths, _ = np.linalg.svd(frames[known])
    shapes[known] = (axes * lengths[..., None, :]) @ np.swapaxes(axes, -2, -1)
    return shapes
