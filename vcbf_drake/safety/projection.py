"""The point of a polytope ``{v : A v <= b}`` nearest to a reference, certified.

A MathematicalProgram proposes it, an active set makes it exact on the rows that it
touches, and arithmetic decides: the optimality conditions hold, or Farkas' multipliers
prove that there is no point.

The active set is Goldfarb and Idnani's dual method (1983): the row that is violated
most joins, rows that would push leave, until no row is violated, or none of the active
ones can make room for the one that is. It runs in floats or, where these leave a
question open, in rational numbers, which represent floats exactly and do not round.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
import math
from operator import mul
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array, finite_array, require
from vcbf_drake.errors import EmptySetError
from vcbf_drake.safety.programs import DEFAULT_SOLVER, NearestPointProgram

# Rows this close to a solver's answer may be active.
REACH = 1e-6
# Tolerances of a row are shares of its size (E72). Where rows as given lead to no
# verified answer they are opened by the first; none of one leaves a row by the second.
_OPENING, _EXCESS = 6e-10, 1e-10
# No point of the set is nearer by more, relative to the cost.
_GAP = 1e-9
# Multipliers of unit rows, scaled to sum 1, balance when |A'y| is below this.
_BALANCE = 1e-12
# Rows of a conflict that are lighter have no part in it, in floats and in rationals.
_LIGHTEST, _NOISE = 1e-10, 1e-14
# The relative accuracy of A v, compared with its terms.
_ROUNDING = 1e-15
# A row further away than this holds everywhere, or nowhere [units of u].
_FARTHEST_ROW = 1e20
# Of the active set in floats: a row this near to the span of others, relative to its
# length, is in it; one violated by less, relative to the terms of a v - b, need not
# join; and it ends after this many have joined, per row of the set.
_INDEPENDENT, _TOLERANCE, _PATIENCE = 1e-12, 1e-13, 3

# Of a handful of floats or Fractions: faster than arrays.
_Vector: TypeAlias = list[Any]


class UnitRows:
    """Rows ``A u <= b`` scaled to unit length, which measure a violation as a distance.

    A row without a direction is a blank: zeros, with its right-hand side. Blanks are
    rows of zeros, and those further away than 1e20.

    Attributes:
        A: The rows, of unit length or zeros, shape (n, m).
        b: Their right-hand sides, shape (n,).
        length: The length |a_i| each of them had, 1 for blanks, shape (n,).
        is_blank: Shape (n,).
        given: A and b as given.
    """

    def __init__(self, A: Array, b: Array) -> None:
        self.given = A, b
        self.length = np.hypot.reduce(A, axis=1, initial=0.0)
        # Not by b / length, which may overflow, nor may the largest length.
        self.is_blank = ~(np.abs(b) / _FARTHEST_ROW < self.length)
        if self.is_blank.any():
            self.length[self.is_blank] = 1.0
            A = np.where(self.is_blank[:, None], 0.0, A)
        self.A, self.b = A / self.length[:, None], b / self.length

    @staticmethod
    def checked(A: ArrayLike, b: ArrayLike) -> UnitRows:
        """Returns the rows of a user; an `InvalidValueError` names a wrong array."""
        rows, sides = "rows (n, m) of finite numbers, m >= 1", "finite, one a row of A"
        A, b = finite_array(A, "A", 2, rows), finite_array(b, "b", 1, sides)
        require(A.shape[1] > 0, "A", A, rows)
        require(len(b) == len(A), "b", b, sides)
        return UnitRows(A, b)

    @property
    def conflict(self) -> int | None:
        """Index of a blank row 0 u <= b_i < 0, if there is one."""
        conflicts = (self.is_blank & (self.b < 0.0)).nonzero()[0].tolist()
        return next(iter(conflicts), None)

    def without_blanks(self) -> tuple[Array, Array]:
        """Returns the rows that have a direction, and their right-hand sides."""
        return self.A[~self.is_blank], self.b[~self.is_blank]

    def sizes(self, near: Array) -> Array:
        """Returns the sizes of rows near a point, at most 1, shape (n,) (E72)."""
        return np.minimum(np.abs(self.b) + np.abs(self.A) @ np.abs(near), 1.0)

    def are_met(self, point: Array, slack: Array) -> bool:
        """Whether a point with this slack leaves no row by more than counts (E72)."""
        return min(slack.tolist(), default=0.0) >= 0.0 or bool(
            (slack >= -_EXCESS * self.sizes(point)).all()
        )

    def as_given(self, multipliers: Array) -> Array:
        """Returns multipliers of the rows as given, infinite of subnormal ones.

        From those of the unit rows, (n,), or of those without the blanks.
        """
        if len(multipliers) < len(self.b):
            kept, multipliers = multipliers, np.zeros(len(self.b))
            multipliers[~self.is_blank] = kept
        with np.errstate(over="ignore"):
            return np.asarray(multipliers / self.length)


def nearest_point(
    A: Array,
    b: Array,
    reference: Array,
    num_firm: int = 0,
    solver: str = DEFAULT_SOLVER,
) -> Array:
    """Returns the point v of ``{v : A v <= b}`` nearest to a reference, shape (m,).

    It is verified by the optimality conditions v = reference - A'y, y >= 0, A v <= b,
    y'(b - A v) = 0, with multipliers y of the unit rows. A set that is empty by less
    than 6e-10 of its rows' sizes counts as one with a point: where its rows as given
    lead to no verified answer, they are opened by as much.

    Args:
        A: The rows, shape (n, m).
        b: Their right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).
        num_firm: The number of first rows that are never opened: together they must
            have an interior.
        solver: The name of the solver that proposes, one of `SOLVERS`.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
    """
    rows = UnitRows(A, b)
    program = NearestPointProgram.of_size(*A.shape, solver)
    proposal = program.solve(rows.A, rows.b, reference)
    distances = [] if proposal is None else (rows.b - rows.A @ proposal).tolist()
    touched = [i for i, each in enumerate(distances) if each < REACH]
    for near in (touched, range(len(b))):
        found = nearest_by_active_set(rows.A, rows.b, reference, near)
        if is_optimal(found, rows, reference):
            return found.point
    return point_or_proof(found, rows, num_firm, _OPENING, reference)


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
    """Returns the point nearest to a reference.

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


def is_optimal(found: Projection, rows: UnitRows, reference: Array) -> bool:
    """Whether a point meets the rows, and no point of the set is much nearer.

    No point z with ``A z <= b`` is nearer than (E70, optimality by multipliers) allows.
    """
    v, y = found.point, found.multipliers
    pull, slack = reference - v, rows.b - rows.A @ v
    error = pull - y @ rows.A
    away, size = math.sqrt(pull @ pull), math.sqrt(v @ v)
    rounding = _ROUNDING * (np.abs(rows.b) + size)
    gap = float(y @ (slack + rounding) + 0.5 * (error @ error))
    is_near = gap <= _GAP * min(1.0 + away, away * (away + size))
    return is_near and rows.are_met(v, slack)


def point_or_proof(
    found: Projection,
    rows: UnitRows,
    num_firm: int | None,
    opening: float,
    reference: Array,
) -> Array:
    """Returns the nearest point where floats found none that is verified.

    All rows but the first `num_firm` and blanks are opened, by a share of their sizes,
    so that the set has an interior or no point. The conflict in which the floats ended
    may be Farkas' proof: z of sum 1 with z'A = 0 to rounding, and z'b < 0 for points
    that are no further away than the rows. Else rational numbers decide.

    Raises:
        EmptySetError: No point satisfies the rows.
    """
    b = np.where(rows.is_blank, rows.b, rows.b + opening * rows.sizes(found.point))
    b[:num_firm], reach = rows.b[:num_firm], float(np.abs(rows.b).max(initial=1.0))
    z, is_proof = found.conflict, False
    if z is not None:
        z = np.where(z > _LIGHTEST * z.max(), z, 0.0)
        z /= z.sum()
        imbalance = np.abs(z @ rows.A)
        # Relative to what is in a column: a slack's may be small, and the slack large.
        is_balanced = imbalance <= _BALANCE * np.abs(rows.A).max(axis=0)
        most = float(z @ b) + reach * float(imbalance.sum())
        least = 10.0 * _BALANCE * float(z @ np.abs(b))
        is_proof = bool(is_balanced.all()) and most < -least
    if z is None or not is_proof:
        exact = nearest_by_active_set(rows.A, b, reference, is_exact=True)
        if exact.conflict is None:
            return exact.point
        # Rows that only make up for the rounding of the others are not named, where the
        # proof holds without them.
        every = exact.conflict / exact.conflict.sum()
        z = np.where(every > _NOISE * every.max(), every, 0.0)
        most = float(z @ b) + reach * float(np.abs(z @ rows.A).sum())
        z = z if most < 0.5 * (every @ b) else every
    has_direction = rows.A[z > 0.0].any()
    radius = float(z @ rows.b) / float(z.sum()) if has_direction else -math.inf
    raise EmptySetError(*rows.given, radius, rows.as_given(z))


def _dot(a: _Vector, b: _Vector) -> Any:
    return sum(map(mul, a, b))


def _minus(a: _Vector, factor: Any, b: _Vector) -> _Vector:
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

    def _append(self, row: int, along: _Vector, left: _Vector, square: Any) -> None:
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
