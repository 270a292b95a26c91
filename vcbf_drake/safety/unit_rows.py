"""Rows of unit length, whose violation is a distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array

# A point that leaves every row, measured as a distance, by no more than this counts as
# a point of the set [units of u].
FEASIBILITY_TOLERANCE = 1e-9
# Multipliers of rows of unit length, scaled to sum 1, balance when |A'y| is below this.
BALANCE_TOLERANCE = 1e-12
# A row further away than this holds everywhere, or nowhere [units of u].
_FARTHEST = 1e20


class UnitRows:
    """Rows ``A u <= b`` scaled to unit length, which measure a violation as a distance.

    A row without a direction is a blank: zeros, with its right-hand side. Blanks are
    rows of zeros, and those further away than 1e20.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Attributes:
        A: The rows, of unit length or zeros, shape (n, m).
        b: Their right-hand sides, shape (n,).
        length: The length |a_i| each of them had, 1 for blanks, shape (n,).
        is_blank: Shape (n,).
        given: A and b as given.
    """

    def __init__(self, A: Array, b: Array) -> None:
        self.given = A, b
        self.length = _lengths(A)
        # Not by b / length, which may overflow, nor may the largest length.
        self.is_blank = ~(np.abs(b) / _FARTHEST < self.length)
        if self.is_blank.any():
            self.length[self.is_blank] = 1.0
            A = np.where(self.is_blank[:, None], 0.0, A)
        self.A, self.b = A / self.length[:, None], b / self.length

    @staticmethod
    def checked(A: ArrayLike, b: ArrayLike) -> UnitRows:
        """Returns the rows of arrays A (n, m) and b (n,) of finite numbers.

        Raises:
            ValueError: Naming the array, its shape and the shape or value allowed.
        """
        A, b = np.asarray(A, dtype=float), np.asarray(b, dtype=float)
        if A.ndim != 2 or A.shape[1] == 0:
            raise ValueError(f"A has shape {A.shape}, must be (n, m) with m >= 1")
        if b.shape != A.shape[:1]:
            raise ValueError(
                f"b has shape {b.shape}, must be ({len(A)},) like A's rows"
            )
        for name, array in (("A", A), ("b", b)):
            wrong = np.argwhere(~np.isfinite(array))
            if len(wrong):
                index = tuple(wrong[0].tolist())
                raise ValueError(
                    f"{name}{list(index)} is {array[index]}, must be finite"
                )
        return UnitRows(A, b)

    @property
    def conflict(self) -> int | None:
        """Index of a blank row 0 u <= b_i < 0, if there is one."""
        conflicts = (self.is_blank & (self.b < 0.0)).nonzero()[0]
        return int(conflicts[0]) if len(conflicts) else None

    def without_blanks(self) -> tuple[Array, Array]:
        """Returns the rows that have a direction, and their right-hand sides."""
        return self.A[~self.is_blank], self.b[~self.is_blank]

    def as_given(self, multipliers: Array) -> Array:
        """Returns multipliers of the rows as given, infinite of subnormal ones.

        Args:
            multipliers: Multipliers of the unit rows, blanks too, shape (n,).
        """
        with np.errstate(over="ignore"):
            given: Array = multipliers / self.length
        return given

    def in_units_given(self, multipliers: Array) -> Array:
        """Returns multipliers of the rows as given, shape (n,).

        Args:
            multipliers: Multipliers of the rows of `without_blanks`.
        """
        restored = np.zeros(len(self.b))
        restored[~self.is_blank] = multipliers
        return self.as_given(restored)


def _lengths(A: Array) -> Array:
    with np.errstate(over="ignore"):
        length: Array = np.sqrt(np.vecdot(A, A))
    lengths = length.tolist()
    if lengths and not (min(lengths) > 1e-150 and max(lengths) < 1e150):
        # By the largest entry first: squares of tiny entries would vanish.
        largest = np.abs(A).max(axis=1)
        scaled = A / np.where(largest > 0.0, largest, 1.0)[:, None]
        length = largest * np.sqrt(np.vecdot(scaled, scaled))
    return length
