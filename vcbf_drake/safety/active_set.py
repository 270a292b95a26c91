"""Goldfarb and Idnani's active-set iterations on a handful of rows."""

from __future__ import annotations

import math
from operator import mul
from typing import NamedTuple

import numpy as np

from vcbf_drake.checks import Array

# A row this near to the span of others, for its length, is in it.
_INDEPENDENT = 1e-12
# A row violated by less, relative to the point's size, need not join.
_TOLERANCE = 1e-13


class ActiveSetSolution(NamedTuple):
    """Where the iterations ended; the caller has to check what it is.

    Attributes:
        point: v, the reference itself or, to rounding, on the rows with y > 0, (m,).
        multipliers: y >= 0, with v = reference - A'y to rounding, shape (n,).
        conflict: Where v violates a row for which no other can make room: z >= 0, not
            all 0, with A'z = 0 to rounding, shape (n,); else None.
    """

    point: Array
    multipliers: Array
    conflict: Array | None


def nearest_by_active_set(A: Array, b: Array, reference: Array) -> ActiveSetSolution:
    """Minimises 1/2 |v - reference|^2 subject to ``A v <= b``.

    By the dual method of Goldfarb and Idnani (1983): the row that is violated most
    joins, rows that would push leave. It ends when no row is violated, or none of the
    active ones can make room for the one that is: then the rows have no common point.

    Args:
        A: The rows, shape (n, m).
        b: Their right-hand sides, shape (n,).
        reference: The point that is projected, shape (m,).
    """
    face, point, conflict = _Face(A, b, reference), reference, None
    for _ in range(3 * len(b)):
        excess = A @ point - b
        worst = int(excess.argmax())
        most = float(excess[worst])
        if most <= _TOLERANCE * face.size or worst in face.rows:
            break
        conflict = face.join(worst, most)
        if conflict is not None:
            break
        point = np.array(face.point)
    multipliers = np.zeros(len(b))
    multipliers[face.rows] = face.multipliers
    return ActiveSetSolution(point, multipliers, conflict)


_Vector = list[float]  # Of a handful of numbers: faster than arrays.


def _dot(a: _Vector, b: _Vector) -> float:
    return sum(map(mul, a, b))


def _minus(a: _Vector, factor: float, b: _Vector) -> _Vector:
    return [x - factor * y for x, y in zip(a, b, strict=True)]


class _Face:
    """The active rows, and the point nearest to the reference where all are met.

    The rows are L Q: L lower triangular, the rows of Q at right angles and of length 1.
    Nothing is updated from step to step but L and Q: what follows from them has the
    rounding of the rows themselves, however narrow their angles.

    Attributes:
        rows: Which are active, in the order in which they joined.
        point: m numbers.
        multipliers: y >= 0, with reference - point = (active rows)'y.
    """

    def __init__(self, A: Array, b: Array, reference: Array) -> None:
        self._A, self._b = A, b
        self._L: list[_Vector] = []
        self._Q: list[_Vector] = []
        self._Qv: _Vector = []  # Where the rows are met.
        self._reference: _Vector = reference.tolist()
        self.rows: list[int] = []
        self.point = self._reference
        self.multipliers: _Vector = []

    @property
    def size(self) -> float:
        """How large numbers are at the point, at least 1."""
        return 1.0 + max(map(abs, self.point))

    def join(self, row: int, excess: float) -> Array | None:
        """Makes a violated row active, and those inactive that stand in its way.

        Along the active rows' span its multiplier takes over from theirs; what is left
        of the row, at a right angle to them, moves the point. Returns None, or the
        conflict where it cannot be met.

        Args:
            row: Which.
            excess: By how much the point violates it.
        """
        a = self._A[row].tolist()
        while True:
            along, left, length = self._split(a)
            share = self._solved(along)
            is_free = length > _INDEPENDENT * math.hypot(length, *along)
            step, leaving = excess / length**2 if is_free else math.inf, -1
            for i, s in enumerate(share):
                if s > 0.0 and self.multipliers[i] < step * s:
                    step, leaving = self.multipliers[i] / s, i
            if leaving >= 0:
                self.multipliers = _minus(self.multipliers, step, share)
                excess -= step * length**2
                self._remove(leaving)
            elif is_free:
                self._append(row, along, left, length)
                self._move()
                return None
            else:
                conflict = np.zeros(len(self._b))
                conflict[self.rows] = np.maximum(np.negative(share), 0.0)
                conflict[row] = 1.0
                return conflict

    def _split(self, a: _Vector) -> tuple[_Vector, _Vector, float]:
        """A row's coordinates along Q, what is left of it, and the length of that."""
        along, left = [0.0] * len(self._Q), a
        # Where much cancels, what is left is at a right angle at the second time only.
        for _ in range(2):
            for i, q in enumerate(self._Q):
                part = _dot(q, left)
                along[i] += part
                left = _minus(left, part, q)
        return along, left, math.sqrt(_dot(left, left))

    def _append(self, row: int, along: _Vector, left: _Vector, length: float) -> None:
        rest = float(self._b[row]) - _dot(along, self._Qv)
        self._Q.append([x / length for x in left])
        self._Qv.append(rest / length)
        self._L.append([*along, length])
        self.rows.append(row)

    def _remove(self, i: int) -> None:
        """Takes out the row that joined as number i."""
        later = self.rows[i + 1 :]
        del self.multipliers[i], self.rows[i:]
        del self._L[i:], self._Q[i:], self._Qv[i:]
        for row in later:
            self._append(row, *self._split(self._A[row].tolist()))

    def _move(self) -> None:
        """Finds point and multipliers."""
        point, pull = self._reference, [0.0] * len(self._Q)
        # A reference far away leaves, the first time, rounding of its own size.
        for _ in range(2):
            for i, (q, at) in enumerate(zip(self._Q, self._Qv, strict=True)):
                move = _dot(q, point) - at
                pull[i] += move
                point = _minus(point, move, q)
        self.point = point
        self.multipliers = [max(y, 0.0) for y in self._solved(pull)]

    def _solved(self, right: _Vector) -> _Vector:
        """Solves L'y = right."""
        y = right.copy()
        for i in range(len(y) - 1, -1, -1):
            row = self._L[i]
            y[i] /= row[i]
            for j in range(i):
                y[j] -= row[j] * y[i]
        return y
