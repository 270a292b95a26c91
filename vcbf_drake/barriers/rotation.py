"""Which way an obstacle is turned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vcbf_drake.checks import Array

_TOLERANCE = 1e-9


def rotation_matrix(
    rotation: Sequence[Sequence[float]] | Array | None, size: int, name: str
) -> Array:
    """Returns R, whose columns are the obstacle's own axes, shape (k, k).

    Args:
        rotation: R, or None for the identity.
        size: The number k of dimensions.
        name: What it turns, for the error message.

    Raises:
        ValueError: It has another shape, or its columns are not orthonormal.
    """
    if rotation is None:
        return np.eye(size)
    matrix = np.array(rotation, dtype=float)
    if matrix.shape != (size, size):
        raise ValueError(
            f"{name}: rotation must have shape ({size}, {size}), got {matrix.shape}"
        )
    if not np.abs(matrix.T @ matrix - np.eye(size)).max() <= _TOLERANCE:
        raise ValueError(
            f"{name}: rotation must have orthonormal columns, got {matrix.tolist()}"
        )
    return matrix
