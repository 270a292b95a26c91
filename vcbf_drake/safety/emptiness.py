"""Whether ``{u : A u <= b}`` is empty, with a proof of either.

A point proves that it is not, Farkas' multipliers that it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import SolverError, UnboundedSetError
from vcbf_drake.safety.active_set import nearest_by_active_set
from vcbf_drake.safety.chebyshev import (
    FEASIBILITY_TOLERANCE,
    Ball,
    balanced,
    ever_larger_balls,
)
from vcbf_drake.safety.unit_rows import UnitRows


@dataclass(frozen=True)
class Emptiness:
    """Farkas' proof that no point satisfies ``A u <= b``, on an irreducible conflict.

    y >= 0 with y'A = 0 and y'b < 0: were u in the set, 0 = y'A u <= y'b < 0. Dropping
    any one of the rows in conflict leaves rows that some point satisfies.

    Attributes:
        multipliers: y, in the units of the rows as given, shape (n,).
        rows: Indices of the rows in conflict (y > 0), at most m + 1 of them, ascending.
        inradius: The signed Chebyshev radius, negative [units of u]; minus infinity
            when a row without coefficients (0 u <= b < 0) is the conflict.
    """

    multipliers: Array
    rows: NDArray[np.intp]
    inradius: float


def emptiness_certificate(A: ArrayLike, b: ArrayLike) -> Emptiness | None:
    """Returns a proof that the set is empty, or None when a point satisfies its rows.

    A point that violates rows by at most 1e-9, measured as a distance, counts as a
    point of the set: flat sets are not empty, and a gap narrower than 2e-9 is no proof.
    The proof is verified on rows of unit length and multipliers of sum 1:
    |A'y| <= 1e-12, and y'b = inradius < -1e-9.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        SolverError: Neither a point nor a proof could be verified.
        ValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows(A, b)
    multipliers = np.zeros(len(rows.given[1]))
    if rows.conflict is not None:
        multipliers[rows.conflict] = 1.0
        return Emptiness(multipliers, np.array([rows.conflict]), -np.inf)
    try:
        ball = _decisive_ball(rows)
    except UnboundedSetError:
        return None
    if ball.radius >= -FEASIBILITY_TOLERANCE:
        return None
    multipliers[rows.index] = _irreducible(rows, ball) / rows.length
    return Emptiness(multipliers, np.flatnonzero(multipliers), ball.radius)


def _irreducible(rows: UnitRows, ball: Ball) -> Array:
    """Drops rows from the conflict, the lightest first, that the proof can spare."""
    y = ball.multipliers
    for row in np.argsort(y, kind="stable"):
        if y[row] > 0.0:
            lighter = y.copy()
            lighter[row] = 0.0
            candidate = Ball(rows, ball.center, balanced(rows.A, lighter))
            if candidate.proves_emptiness:
                y = candidate.multipliers
    return y


def _decisive_ball(rows: UnitRows) -> Ball:
    """Returns the largest ball or, failing that, one that tells if there is a point.

    Between rows that are opposite but for 1e-11 the largest ball may lie too far away
    to be found exactly, while every ball's multipliers prove the set empty.
    """
    decisive = None
    for ball in ever_larger_balls(rows):
        if ball.is_largest and ball.is_decisive:
            return ball
        y = _balanced_by_others(rows.A, ball.multipliers)
        proof = Ball(rows, ball.center, y / y.sum()) if y.any() else ball
        if proof.is_decisive:
            decisive = decisive or proof
    if decisive is None:
        raise SolverError("neither a point nor a proof of emptiness", *rows.given)
    return decisive


def _balanced_by_others(A: Array, y: Array) -> Array:
    """Restores A'y = 0 on all rows, for rows that are nearly opposite."""
    imbalance = y @ A
    size = float(np.linalg.norm(imbalance)) or 1.0
    solution = nearest_by_active_set(A, np.zeros(len(A)), -imbalance / size)
    return y + size * solution.multipliers
