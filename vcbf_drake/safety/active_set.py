"""Goldfarb and Idnani's active-set iterations on a handful of rows."""

from __future__ import annotations

import math

import numpy as np

from vcbf_drake.errors import Array

# A row this near to the span of others, for its length, is in it.
_INDEPENDENT = 1e-12
# A row violated by less, relative to the reference's violations, need not join.
_TOLERANCE = 1e-11


def nonnegative_multipliers(A: Array, b: Array, reference: Array) -> Array:
    """Returns the y >= 0 that minimises 1/2 |A'y|^2 - y'(A reference - b).

    The dual of the projection, by the dual method of Goldfarb and Idnani: the row that
    is violated most joins, rows that would push leave. It ends when no row is violated,
    or none of the active ones can make room for the one that is: then the rows have no
    common point, and y is not a minimiser, for there is none. The caller has to check.

    Args:
        A: The rows, shape (n, m).
        b: Their right-hand sides, shape (n,).
        reference: The point that is projected, shape (m,).
    """
    violation = A @ reference - b
    tolerance = _TOLERANCE * (1.0 + float(np.abs(violation).max(initial=0.0)))
    y, active = np.zeros(len(b)), np.zeros(len(b), dtype=bool)
    for _ in range(3 * len(b)):
        excess = violation - A @ (y @ A)
        excess[active] = -np.inf
        worst = int(excess.argmax())
        if excess[worst] <= tolerance or not _join(A, y, active, worst, excess[worst]):
            break
    return np.maximum(y, 0.0)


def _join(A: Array, y: Array, active: Array, row: int, excess: float) -> bool:
    """Makes a violated row active, in place, and those inactive that stand in its way.

    Along the active rows' span its multiplier takes over from theirs; what is left of
    the row, at a right angle to them, moves the point. Returns whether it could be met.
    """
    length_square = float(A[row] @ A[row])
    if length_square == 0.0:
        return False
    while (others := active.nonzero()[0]).size:
        share = np.linalg.lstsq(A[others].T, A[row], rcond=None)[0]
        left = A[row] - share @ A[others]
        square = float(left @ left)
        full = excess / square if square > _INDEPENDENT**2 * length_square else math.inf
        blocking = (share > 0.0).nonzero()[0]
        ratios = y[others[blocking]] / share[blocking]
        step = min(full, float(ratios.min(initial=math.inf)))
        if not step < math.inf:  # Nothing gives way, or rounding has left no number.
            return False
        y[row] += step
        y[others] -= step * share
        if step == full:
            active[row] = True
            return True
        excess -= step * square
        leaving = others[blocking[ratios.argmin()]]
        y[leaving], active[leaving] = 0.0, False
    y[row] += excess / length_square
    active[row] = True
    return True
