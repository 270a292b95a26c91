"""A flat array of finite floats, checked where a user hands it in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vcbf_drake.checks import Array


def finite_vector(values: Sequence[float] | Array, name: str) -> Array:
    """Returns a read-only copy of the values as floats, shape (k,).

    Args:
        values: The numbers.
        name: What they are, for the error message.

    Raises:
        ValueError: Not one-dimensional, or not finite.
    """
    vector = np.array(values, dtype=float)
    if vector.ndim != 1:
        raise ValueError(f"{name}: expected a flat list, got shape {vector.shape}")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name}: every number must be finite, got {vector.tolist()}")
    vector.flags.writeable = False
    return vector
