"""Goldfarb and Idnani's active-set iterations on a handful of rows.

They minimise 1/2 |v - reference|^2 subject to ``A v <= b``, A (n, m) and b (n,), by
their dual method (1983): the row that is violated most joins, rows that would push
leave. It ends when no row is violated, or none of the active ones can make room for the
one that is: then the rows have no common point. It runs in floats or, where rounding
leaves a question open, in rational numbers, which represent floats exactly and do not
round.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from operator import mul
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from vcbf_drake.checks import Array

# A row this near to the span of others, relative to its length, is in it.
_INDEPENDENT = 1e-12
# A row violated by less, relative to the terms of a v - b, need not join.
_TOLERANCE = 1e-13
# In floats it ends after this many rows have joined, per row of the set.
_PATIENCE = 3

_Number: TypeAlias = Any  # A float or a Fraction.
_Vector: TypeAlias = list[_Number]  # Of a handful of numbers: faster than arrays.


class Projection(NamedTuple):
    """The point nearest to a reference, unverified: the caller checks it.

    Attributes:
        point: v, the reference itself or, to rounding, on the rows with y > 0, (m,).
        multipliers: y >= 0, with v = reference - A'y to rounding, shape (n,).
        conflict: Where v violates a row that no other row can make room for: z >= 0,
            not all 0, with A'z = 0 to rounding, shape (n,); else None.
    """

    point: Array
    multipliers: Array
    conflict: Array | None = None


def nearest_by_active_set(
    A: Array,
    b: Array,
    reference: Array,
    near: Sequence[int] | None = None,
    is_exact: bool = False,
) -> Projection:
    """Returns the point nearest to a reference, shape (m,).

    Args:
        A: The rows, shape (n, m).
        b: Their right-hand sides, shape (n,).
        reference: Shape (m,).
        near: The indices of the rows that are taken; all by default.
        is_exact: Whether to calculate in rational numbers, without rounding. Every step
            raises the cost, so that no choice of active rows comes twice. It takes
            about a hundred times longer than in floats.
    """
    rows, sides, from_ = A.tolist(), b.tolist(), reference.tolist()
    near = range(len(b)) if near is None else near
    rows, sides = [rows[i] for i in near], [sides[i] for i in near]
    if is_exact:
        rows = [list(map(Fraction, row)) for row in rows]
        sides, from_ = list(map(Fraction, sides)), list(map(Fraction, from_))
    face = _Face(rows, sides, from_, is_exact)
    found, proof = face.iterate(), None
    multipliers = np.zeros(len(b))
    for row, y in zip(face.rows, face.multipliers, strict=True):
        multipliers[near[row]] = y
    if found is not None:
        proof = np.zeros(len(b))
        proof[near] = found
    return Projection(np.array(face.point, dtype=float), multipliers, proof)


def _dot(a: _Vector, b: _Vector) -> _Number:
    return sum(map(mul, a, b))


def _minus(a: _Vector, factor: _Number, b: _Vector) -> _Vector:
    return [x - factor * y for x, y in zip(a, b, strict=True)]


class _Face:
    """The active rows, and the point nearest to the reference on all of them.

    The rows are L Q: L unit lower triangular, the rows of Q at right angles. Nothing is
    updated from step to step but L and Q: what follows from them has the rounding of
    the rows themselves, however narrow their angles.

    Attributes:
        rows: Which are active, in the order in which they joined.
        point: m numbers.
        multipliers: y >= 0, with reference - point = (active rows)'y.
    """

    def __init__(
        self, A: Sequence[_Vector], b: _Vector, reference: _Vector, is_exact: bool
    ) -> None:
        self._A, self._b, self._reference = A, b, reference
        self._least = 0.0 if is_exact else _INDEPENDENT**2
        self._tolerance = 0.0 if is_exact else _TOLERANCE
        # Where much cancels in floats, what is left is at a right angle, and a point
        # far away is where it should be, at the second time only.
        self._passes = 1 if is_exact else 2
        self._L: list[_Vector] = []
        self._Q: list[_Vector] = []
        self._squares: _Vector = []  # Of the rows of Q.
        self._Qv: _Vector = []  # Where the rows are met.
        self.rows: list[int] = []
        self.point = reference
        self.multipliers: _Vector = []

    def iterate(self) -> _Vector | None:
        """Makes rows active until the point violates none.

        Returns:
            The conflict in which it ends, n numbers; None without.
        """
        conflict, joined = None, 0
        while not (
            conflict or (self._tolerance and joined == _PATIENCE * len(self._b))
        ):
            worst, most = -1, 0
            for i, (a, b) in enumerate(zip(self._A, self._b, strict=True)):
                excess = _dot(a, self.point) - b
                if excess > most and self._tolerance:
                    terms = sum(map(abs, map(mul, a, self.point))) + abs(b)
                    excess -= self._tolerance * terms
                if excess > most:
                    worst, most = i, excess
            if worst < 0 or worst in self.rows:
                break
            conflict, joined = self._join(worst), joined + 1
        return conflict

    def _join(self, row: int) -> _Vector | None:
        """Makes a violated row active, and those inactive that stand in its way.

        In the span of the active rows, its multiplier replaces theirs; the component of
        the row orthogonal to them moves the point. Returns None, or the conflict where
        it cannot be met: n numbers.
        """
        a = self._A[row]
        excess = _dot(a, self.point) - self._b[row]
        while True:
            along, left = self._split(a)
            square, share = _dot(left, left), self._solved(along)
            is_free = square > self._least * _dot(a, a)
            step, leaving = excess / square if is_free else np.inf, -1
            for i, s in enumerate(share):
                if s > 0 and self.multipliers[i] < step * s:
                    step, leaving = self.multipliers[i] / s, i
            if leaving >= 0:
                self.multipliers = _minus(self.multipliers, step, share)
                excess -= step * square
                self._remove(leaving)
            elif is_free:
                self._append(row, along, left, square)
                self._move()
                return None
            else:
                conflict: _Vector = [0] * len(self._b)
                for i, s in zip(self.rows, share, strict=True):
                    conflict[i] = max(-s, 0)
                conflict[row] = 1
                return conflict

    def _split(self, a: _Vector) -> tuple[_Vector, _Vector]:
        """A row's coordinates along Q, and its orthogonal remainder."""
        along: _Vector = [0] * len(self._Q)
        left = a
        for _ in range(self._passes):
            for i, q in enumerate(self._Q):
                part = _dot(q, left) / self._squares[i]
                along[i] += part
                left = _minus(left, part, q)
        return along, left

    def _append(self, row: int, along: _Vector, left: _Vector, square: _Number) -> None:
        self._Qv.append(self._b[row] - _dot(along, self._Qv))
        self._Q.append(left)
        self._squares.append(square)
        self._L.append(along)
        self.rows.append(row)

    def _remove(self, i: int) -> None:
        """Takes out the row that joined as number i."""
        later = self.rows[i + 1 :]
        del self.multipliers[i], self.rows[i:]
        del self._L[i:], self._Q[i:], self._squares[i:], self._Qv[i:]
        for row in later:
            along, left = self._split(self._A[row])
            self._append(row, along, left, _dot(left, left))

    def _move(self) -> None:
        """Finds point and multipliers."""
        point, pull = self._reference, [0] * len(self._Q)
        for _ in range(self._passes):
            for i, (q, at) in enumerate(zip(self._Q, self._Qv, strict=True)):
                move = (_dot(q, point) - at) / self._squares[i]
                pull[i] += move
                point = _minus(point, move, q)
        self.point = point
        self.multipliers = [max(y, 0) for y in self._solved(pull)]

    def _solved(self, right: _Vector) -> _Vector:
        """Solves L'y = right."""
        y = right.copy()
        for i in range(len(y) - 1, 0, -1):
            for j, along in enumerate(self._L[i]):
                y[j] -= along * y[i]
        return y
