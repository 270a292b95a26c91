"""Rows ``A u <= b``, checked and scaled to unit length, however long or short."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array

# A row further away than this holds everywhere, or nowhere [units of u].
_FARTHEST = 1e20


class UnitRows:
    """Rows scaled to unit length, rows of zeros taken out.

    Attributes:
        A, b: The remaining rows, of unit length, shapes (k, m) and (k,).
        length: The length |a_i| each of them had, shape (k,).
        index: Where each of them stood among the rows as given, shape (k,).
        given: A and b as given, shapes (n, m) and (n,).
        conflict: Index of a row 0 u <= b_i < 0, or as good as that, or None.
    """

    def __init__(self, A: ArrayLike, b: ArrayLike) -> None:
        self.given = A, b = checked_rows(A, b)
        # By the largest entry first: squares of tiny entries would vanish.
        largest = np.abs(A).max(axis=1)
        scale = np.where(largest > 0.0, largest, 1.0)
        length = largest * np.linalg.norm(A / scale[:, None], axis=1)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            distance = b / length
        # A row so short, for its right-hand side, has no direction to speak of.
        blank = ~(np.abs(distance) < _FARTHEST)
        conflicts = np.flatnonzero(blank & (b < 0.0))
        self.conflict = int(conflicts[0]) if len(conflicts) else None
        self.index = np.flatnonzero(~blank)
        self.length = length[self.index]
        self.A = A[self.index] / self.length[:, None]
        self.b = distance[self.index]


def checked_rows(A: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    """Returns A (n, m) and b (n,) as arrays of finite floats.

    Raises:
        ValueError: Naming the array, its shape and the shape or value allowed.
    """
    A, b = np.asarray(A, dtype=float), np.asarray(b, dtype=float)
    if A.ndim != 2 or A.shape[1] == 0:
        raise ValueError(f"A has shape {A.shape}, must be (n, m) with m >= 1")
    if b.shape != A.shape[:1]:
        raise ValueError(f"b has shape {b.shape}, must be ({len(A)},) like A's rows")
    for name, array in (("A", A), ("b", b)):
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            index = tuple(wrong[0].tolist())
            raise ValueError(f"{name}{list(index)} is {array[index]}, must be finite")
    return A, b
