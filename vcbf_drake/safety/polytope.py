"""Polytopes ``{v : A v <= b}``: linear programs, the largest ball, emptiness, rays.

Rows are A (n, m) and b (n,). What a linear program's solver proposes is made exact and
verified as in `vcbf_drake.safety.projection`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError, UnboundedSetError
from vcbf_drake.safety.programs import LinearProgram
from vcbf_drake.safety.projection import (
    UnitRows,
    nearest_by_active_set,
    nearest_point,
    point_or_proof,
)

# No point's cost is lower by more, relative to its terms.
_GAP = 5e-11
# The width of the set along each variable, where that matters; the lengths of proximal
# steps, after which rational numbers decide; and the scale of the cost, for Clp's
# tolerance on multipliers is absolute.
_EXTENT, _STEPS, _SHARPNESS = 2.0, (1e4, 1e8, 1e8), 1e4
# Rows are opened by so much less than for a projection that this finds the point.
_OPENING = 4.5e-10
# The point of a set that is nearest to one so far downhill is a minimiser; one that is
# as far as this has none.
_DOWNHILL, _FARTHEST = 1e60, 1e30
# A ray may turn towards a row by this angle [rad] and still count as a ray.
_RAY_TOLERANCE = 1e-11
# The number of repeated searches for the largest ball, from the last one.
_ROUNDS = 4


def minimise_linear(
    cost: Array, A: Array, b: Array, num_firm: int | None = None
) -> Array:
    """Returns a minimiser of cost'v over ``{v : A v <= b}``.

    The solver's answer is made exact by proximal steps (Rockafellar 1976): the point
    nearest to one downhill of the last is a minimiser after finitely many, from a
    solver's answer after one or two.

    Rows after the first `num_firm`, by default none, are opened as for `nearest_point`.
    What bounds the set, if it is bounded, is of about unit size.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
        SolverError: The cost has no least.
    """
    rows = UnitRows(A, b)
    cost = cost / (float(np.linalg.norm(cost)) or 1.0)
    proposal = LinearProgram.of_size(*A.shape).solve(_SHARPNESS * cost, rows.A, rows.b)
    point = np.zeros(len(cost)) if proposal is None else proposal
    for step in _STEPS:
        found = nearest_by_active_set(rows.A, rows.b, point - step * cost)
        if found.conflict is not None:
            break
        point, multipliers = found.point, found.multipliers / step
        slack = rows.b - rows.A @ point
        # No point's cost is lower by more than weak duality allows (E75, weak duality).
        pull = np.abs(cost + multipliers @ rows.A) @ (_EXTENT + np.abs(point))
        gap = float(multipliers @ np.abs(slack) + pull)
        size = float(multipliers @ np.abs(rows.b) + np.abs(cost) @ np.abs(point))
        size = min(size, 1.0 + abs(float(cost @ point)))
        if gap <= _GAP * size and rows.are_met(point, slack):
            return point
    point = point_or_proof(found, rows, num_firm, _OPENING, -_DOWNHILL * cost)
    if np.abs(point).max() > _FARTHEST:
        raise SolverError("a linear program without a least", A, b)
    return point


def chebyshev_ball(A: ArrayLike, b: ArrayLike) -> tuple[Array, float]:
    """Returns the centre (m,) and the signed radius of the largest ball in the set.

    max r subject to a_i u + |a_i| r <= b_i. The radius is the least distance from the
    centre to a row's boundary, negative when the set is empty: then no point violates
    all rows by less. Rows of zeros with b_i >= 0 say nothing and are dropped; with
    b_i < 0 they make the radius minus infinity.

    Raises:
        UnboundedSetError: The set holds balls of every size.
        InvalidValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows.checked(A, b)
    if rows.conflict is not None:
        return np.zeros(rows.A.shape[1]), -np.inf
    A, b = rows.without_blanks()
    n, m = A.shape
    if n == 0:
        raise UnboundedSetError(*rows.given, np.eye(m)[0])
    direction = _direction(A, -np.ones(n))
    if direction is not None and (A @ direction < -_RAY_TOLERANCE).all():
        raise UnboundedSetError(*rows.given, direction)
    center, radius, size = np.zeros(m), -math.inf, float(np.abs(b).max()) or 1.0
    cost, balls = -np.eye(m + 1)[m], np.column_stack([A, np.ones(n)])
    for _ in range(_ROUNDS):
        slack = (b - A @ center) / size
        found = center + size * minimise_linear(cost, balls, slack)[:m]
        least = float(np.min(b - A @ found))
        if least <= radius:
            break
        center, radius, size = found, least, abs(least) or size
    return center, radius


def emptiness_certificate(A: ArrayLike, b: ArrayLike) -> EmptySetError | None:
    """Returns the error that proves a set empty; None when a point satisfies its rows.

    Its rows in conflict, at most m + 1, are irreducible: dropping one of them leaves
    rows that some point satisfies. A point that violates rows by at most 6e-10, as a
    distance, counts as a point of the set: flat sets are not empty, nor are those of
    `nearest_point`.

    Raises:
        InvalidValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows.checked(A, b)
    A, b = rows.given
    if rows.conflict is not None:
        return EmptySetError(A, b, -math.inf, np.eye(len(b))[rows.conflict])
    try:
        nearest_point(A, b, np.zeros(A.shape[1]))
    except EmptySetError as error:
        for row in error.conflict:  # Some may only compensate the others' rounding.
            kept = [i for i in error.conflict if i != row]
            fewer = emptiness_certificate(A[kept], b[kept])
            if fewer is not None:
                y = np.zeros(len(b))
                y[kept] = fewer.multipliers
                return EmptySetError(A, b, fewer.inradius, y)
        return error
    return None


def recession_direction(A: ArrayLike) -> Array | None:
    """Returns a unit direction d with A d <= 0, or None when there is none.

    A set that has a point is unbounded exactly when its rows have such a direction.
    Found as a null vector of A, or as the least d with A d <= 0 and 1'A d <= -1;
    verified to 1e-11 on rows of unit length.

    Raises:
        InvalidValueError: Wrong shape or numbers that are not finite.
    """
    rows, _ = UnitRows.checked(A, np.zeros(np.shape(A)[:1])).without_blanks()
    n, m = rows.shape
    _, singular, axes = np.linalg.svd(rows, full_matrices=True)
    if n < m or singular[-1] <= _RAY_TOLERANCE * singular[0]:
        return np.asarray(axes[-1])
    direction = _direction(
        np.vstack([rows, rows.sum(axis=0)]), np.append(np.zeros(n), -1.0)
    )
    if direction is None or np.max(rows @ direction) > _RAY_TOLERANCE:
        return None
    return direction


def _direction(A: Array, b: Array) -> Array | None:
    """The direction of the least d with ``A d <= b``, to be verified; None without."""
    found = nearest_by_active_set(A, b, np.zeros(A.shape[1]))
    length = float(np.linalg.norm(found.point))
    return None if found.conflict is not None or not length else found.point / length
