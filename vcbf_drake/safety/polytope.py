"""Polytopes ``{u : A u <= b}``: unit rows, the largest ball, emptiness and recession.

A linear program proposes a ball, arithmetic makes it exact on the rows it touches, and
a dual bound verifies it: a point proves that a set is not empty, Farkas' multipliers
that it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import SolverError, UnboundedSetError
from vcbf_drake.safety.active_set import nearest_by_active_set
from vcbf_drake.safety.programs import LinearProgram

# A point that leaves every row, measured as a distance, by no more than this counts as
# a point of the set [units of u].
FEASIBILITY_TOLERANCE = 1e-9
# A row further away than this holds everywhere, or nowhere [units of u].
_FARTHEST = 1e20
# Multipliers of rows of unit length, scaled to sum 1, balance when |A'y| is below this.
BALANCE_TOLERANCE = 1e-12
# A ray may turn towards a row by this angle [rad] and still count as a ray.
_RAY_TOLERANCE = 1e-11
# The scale of a linear program's cost: Clp's tolerance on multipliers is absolute.
_SHARPNESS = 1e4
# How far one linear program may move the centre, in units of its frame.
_REACH = 1e3


class UnitRows:
    """Rows ``A u <= b`` scaled to unit length, which measure a violation as a distance.

    A row without a direction to speak of is a blank: zeros, and what stood to its
    right. Blanks are rows of zeros, and those further away than 1e20.

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
            multipliers: Of the unit rows, blanks too, shape (n,).
        """
        with np.errstate(over="ignore"):
            given: Array = multipliers / self.length
        return given

    def in_units_given(self, multipliers: Array) -> Array:
        """Returns multipliers of the rows as given, shape (n,).

        Args:
            multipliers: Of `without_blanks`.
        """
        restored = np.zeros(len(self.b))
        restored[~self.is_blank] = multipliers
        return self.as_given(restored)


def _lengths(A: Array) -> Array:
    with np.errstate(over="ignore"):
        length: Array = np.sqrt(np.vecdot(A, A))
    if length.min(initial=1.0) < 1e-150 or length.max(initial=1.0) > 1e150:
        # By the largest entry first: squares of tiny entries would vanish.
        largest = np.abs(A).max(axis=1)
        scaled = A / np.where(largest > 0.0, largest, 1.0)[:, None]
        length = largest * np.sqrt(np.vecdot(scaled, scaled))
    return length


def chebyshev_ball(A: ArrayLike, b: ArrayLike) -> tuple[Array, float]:
    """Returns the centre (m,) and the signed radius of the largest ball in the set.

    max r subject to a_i u + |a_i| r <= b_i. The radius is the least distance from the
    centre to a row's boundary, negative when the set is empty: then no point violates
    all rows by less. Rows of zeros with b_i >= 0 say nothing and are dropped; with
    b_i < 0 they make the radius minus infinity.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        UnboundedSetError: The set holds balls of every size.
        SolverError: The linear program's answer could not be verified.
        ValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows.checked(A, b)
    if rows.conflict is not None:
        return np.zeros(rows.A.shape[1]), -np.inf
    ball = largest_ball(rows)
    return ball.center, ball.radius


class Ball:
    """A centre for max r, A u + r <= b (unit rows), and multipliers for its dual.

    The dual: min y'b subject to y >= 0, A'y = 0, sum y = 1.
    """

    def __init__(self, A: Array, b: Array, center: Array, multipliers: Array) -> None:
        self.center, self.multipliers = center, multipliers
        self.slack = b - A @ center
        self.radius = float(self.slack.min())
        is_balanced = np.linalg.norm(multipliers @ A) <= BALANCE_TOLERANCE
        self.bound = float(multipliers @ self.slack) if is_balanced else np.inf
        self.gap = self.bound - self.radius
        # Not by the slack of a centre that may be far away, and rounded as coarsely.
        proof = float(multipliers @ b) if is_balanced else np.inf
        self.proves_emptiness = proof < -FEASIBILITY_TOLERANCE
        has_point = self.radius >= -FEASIBILITY_TOLERANCE
        self.is_decisive = has_point or self.proves_emptiness
        # Of the rows it touches, |b_i| = |a_i center + radius|.
        self.rounding = 1e-15 * float(np.linalg.norm(center) + abs(self.radius))
        self.is_largest = self.gap <= max(1e-12 * abs(self.radius), self.rounding)


def largest_ball(rows: UnitRows) -> Ball:
    """Solves the Chebyshev program; the answer's gap is closed to rounding.

    Raises:
        SolverError: No answer could be verified.
        UnboundedSetError: The set holds balls of every size.
    """
    gap = np.inf
    for ball in _ever_larger_balls(rows):
        if ball.is_largest:
            return ball
        gap = ball.gap
    raise SolverError("no verified Chebyshev ball", *rows.given, f"gap {gap:.2g}")


def _ever_larger_balls(rows: UnitRows) -> Iterator[Ball]:
    """Solves the Chebyshev program, again and again around its best centre.

    The solver's tolerances are absolute. So its answer is made exact on the rows it
    touches and, while the dual bound disagrees, sought again from there, in the
    coordinates in which the rows are about equally far.

    Raises:
        SolverError: The solver gave up.
        UnboundedSetError: The set holds balls of every size.
    """
    A, b = rows.without_blanks()
    n, m = A.shape
    if n == 0:
        raise UnboundedSetError(*rows.given, np.eye(m)[0])
    resolution = float(np.max(np.abs(b))) or 1.0
    frame, ball = resolution * np.eye(m), Ball(A, b, np.zeros(m), np.zeros(n))
    program = LinearProgram.of_size(n, m + 1, _REACH)
    cost = np.append(np.zeros(m), -_SHARPNESS)
    for _ in range(12):
        # In coordinates z, u = center + frame z, and in rows of about equal weight.
        excess = ball.slack - ball.radius
        weight = 1.0 / (excess + resolution)
        lhs = np.column_stack([A @ frame, np.full(n, resolution)]) * weight[:, None]
        found = program.solve(cost, lhs, excess * weight)
        is_far = found is None or bool(np.max(np.abs(found[0])) > 0.9 * _REACH)
        if is_far:
            direction = widening_direction(A)
            if direction is not None:
                raise UnboundedSetError(*rows.given, direction)
        if found is None:
            raise SolverError("no Chebyshev ball", *rows.given)
        center, y = ball.center + frame @ found[0][:-1], balanced(A, found[1] * weight)
        candidates = [Ball(A, b, c, y) for c in (center, _touching(A, b, center, y))]
        ball = min(candidates, key=lambda ball: ball.gap)
        yield ball
        resolution *= 1.0 if is_far else 1e-4
        frame = dikin_frame(A, ball.slack - ball.radius + resolution)


def dikin_frame(A: Array, distance: Array) -> Array:
    """Returns (sum a_i a_i' / distance_i^2)^(-1/2), shape (m, m).

    In coordinates z, u = center + frame z, rows that far from the centre hold the unit
    ball, and rows that matter are about equally far.
    """
    _, singular, axes = np.linalg.svd(A / distance[:, None], full_matrices=False)
    return (axes.T / np.maximum(singular, 1e-12 * singular[0])) @ axes


def balanced(A: Array, y: Array) -> Array:
    """Restores A'y = 0, sum y = 1 on the rows that carry y (few and independent).

    Args:
        A: Rows of unit length, shape (n, m).
        y: Multipliers that all but balance, shape (n,).
    """
    y = y / max(float(y.sum()), 1e-300)
    support = y > 1e-13
    columns = np.c_[A[support], np.ones(support.sum())].T
    target = np.append(np.zeros(A.shape[1]), 1.0)
    error = target - columns @ y[support]
    restored = np.zeros_like(y)
    restored[support] = y[support] + np.linalg.lstsq(columns, error, rcond=1e-12)[0]
    return np.maximum(restored, 0.0)


def _touching(A: Array, b: Array, center: Array, y: Array) -> Array:
    """Moves the centre, by little, so that the rows that carry y are equally far."""
    A, b = A[y > 0.0], b[y > 0.0]
    move = np.linalg.lstsq(np.c_[A, np.ones(len(b))], b - A @ center, rcond=1e-12)[0]
    return np.asarray(center + move[:-1])


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
    rows = UnitRows.checked(A, b)
    if rows.conflict is not None:
        multipliers = np.zeros(len(rows.b))
        multipliers[rows.conflict] = 1.0
        return Emptiness(multipliers, np.array([rows.conflict]), -math.inf)
    try:
        ball = _decisive_ball(rows)
    except UnboundedSetError:
        return None
    if ball.radius >= -FEASIBILITY_TOLERANCE:
        return None
    multipliers = rows.in_units_given(_irreducible(*rows.without_blanks(), ball))
    return Emptiness(multipliers, np.flatnonzero(multipliers), ball.radius)


def _irreducible(A: Array, b: Array, ball: Ball) -> Array:
    """Drops rows from the conflict, the lightest first, that the proof can spare."""
    y = ball.multipliers
    for row in np.argsort(y, kind="stable"):
        if y[row] > 0.0:
            lighter = y.copy()
            lighter[row] = 0.0
            candidate = Ball(A, b, ball.center, balanced(A, lighter))
            if candidate.proves_emptiness:
                y = candidate.multipliers
    return y


def _decisive_ball(rows: UnitRows) -> Ball:
    """Returns the largest ball or, failing that, one that tells if there is a point.

    Between rows that are opposite but for 1e-11 the largest ball may lie too far away
    to be found exactly, while every ball's multipliers prove the set empty.
    """
    A, b = rows.without_blanks()
    decisive = None
    for ball in _ever_larger_balls(rows):
        if ball.is_largest and ball.is_decisive:
            return ball
        y = _balanced_by_others(A, ball.multipliers)
        proof = Ball(A, b, ball.center, y / y.sum()) if y.any() else ball
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


def recession_direction(A: ArrayLike) -> Array | None:
    """Returns a unit direction d with A d <= 0, or None when there is none.

    A set that has a point is unbounded exactly when its rows have such a direction.
    Found as a null vector of A, by max t subject to A d + t <= 0, |d_j| <= 1, or by
    min 1'A d subject to A d <= 0, |d_j| <= 1; verified to 1e-11 on rows of unit length.

    Args:
        A: The rows, shape (n, m).

    Raises:
        ValueError: Wrong shape or numbers that are not finite.
    """
    A = np.asarray(A, dtype=float)
    rows, _ = UnitRows.checked(A, np.zeros(len(A))).without_blanks()
    n, m = rows.shape
    _, singular, axes = np.linalg.svd(rows, full_matrices=True)
    if n < m or singular[-1] <= _RAY_TOLERANCE * singular[0]:
        return np.asarray(axes[-1])
    direction = widening_direction(rows)
    if direction is not None:
        return direction
    direction = _ray(rows, np.zeros(n), rows.sum(axis=0))
    # Rows that should be met exactly, are, whatever the solver's tolerance.
    met = rows[np.abs(rows @ direction) < 1e-9]
    direction -= np.linalg.lstsq(met, met @ direction, rcond=1e-12)[0]
    length = np.linalg.norm(direction)
    if length < 0.5 or np.max(rows @ direction) > _RAY_TOLERANCE * length:
        return None
    return np.asarray(direction / length)


def widening_direction(A: Array) -> Array | None:
    """Returns d with A d < 0, along which a set holds balls of every size, or None.

    Args:
        A: Rows of unit length, shape (n, m).
    """
    direction = _ray(A, np.ones(len(A)), np.zeros(A.shape[1]))
    return direction if np.max(A @ direction) < -_RAY_TOLERANCE else None


def _ray(A: Array, margin: Array, cost: Array) -> Array:
    """Solves min cost'd - t, A d + margin t <= 0, |d_j| <= 1, for d of length 1 (or 0).

    Verifying it is left to the caller.
    """
    n, m = A.shape
    found = LinearProgram.of_size(n, m + 1, 1.0).solve(
        _SHARPNESS * np.append(cost, -1.0), np.column_stack([A, margin]), np.zeros(n)
    )
    direction = np.zeros(m) if found is None else found[0][:-1]
    length = np.linalg.norm(direction)
    return direction / length if length > 1e-6 else np.zeros(m)
