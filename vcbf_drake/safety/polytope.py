"""Polytopes ``{v : A v <= b}``: the nearest point, linear programs, balls, emptiness.

Rows are A (n, m) and b (n,). A MathematicalProgram proposes, the active set makes the
proposal exact on the rows it touches, and arithmetic decides: the optimality conditions
hold, or Farkas' multipliers prove that there is no point. What floats leave open is
decided in rational numbers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array, finite_array, require
from vcbf_drake.errors import EmptySetError, SolverError, UnboundedSetError
from vcbf_drake.safety.active_set import Projection, nearest_by_active_set
from vcbf_drake.safety.programs import (
    DEFAULT_SOLVER,
    LinearProgram,
    NearestPointProgram,
)

# Tolerances of a row are shares of its size (E72). Where rows as given lead to no
# verified answer they are opened by this, of a linear program by so much less that a
# projection finds its point; a verified solution leaves no row by more.
_OPENING, _LP_OPENING, _EXCESS = 6e-10, 4.5e-10, 1e-10
# No point of the set is better by more, relative to the cost; or, of a linear program,
# to its terms.
_GAP, _LP_GAP = 1e-9, 5e-11
# Multipliers of unit rows, scaled to sum 1, balance when |A'y| is below this.
_BALANCE = 1e-12
# Rows of a conflict that are lighter have no part in it, in floats and in rationals.
_LIGHTEST, _NOISE = 1e-10, 1e-14
# The relative accuracy of A v, compared with its terms.
_ROUNDING = 1e-15
# Rows this close to a solver's answer may be active.
REACH = 1e-6
# Of a linear program: the width of its set along each variable, where that matters;
# the lengths of its proximal steps, after which rational numbers decide; and the scale
# of its cost, for Clp's tolerance on multipliers is absolute.
_EXTENT, _STEPS, _SHARPNESS = 2.0, (1e4, 1e8, 1e8), 1e4
# The point of a set that is nearest to one so far downhill is a minimiser; one that is
# as far as this has none.
_DOWNHILL, _FARTHEST = 1e60, 1e30
# A row further away than this holds everywhere, or nowhere [units of u].
_FARTHEST_ROW = 1e20
# A ray may turn towards a row by this angle [rad] and still count as a ray.
_RAY_TOLERANCE = 1e-11
# The number of repeated searches for the largest ball, from the last one.
_ROUNDS = 4


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
        """Returns the rows of arrays A (n, m) and b (n,) that a user gave.

        Raises:
            InvalidValueError: Naming the array, and what is allowed.
        """
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

    def as_given(self, multipliers: Array) -> Array:
        """Returns multipliers of the rows as given, infinite of subnormal ones.

        Args:
            multipliers: Those of the unit rows, (n,); or of those without the blanks.
        """
        if len(multipliers) < len(self.b):
            kept, multipliers = multipliers, np.zeros(len(self.b))
            multipliers[~self.is_blank] = kept
        with np.errstate(over="ignore"):
            given: Array = multipliers / self.length
        return given


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
    return _decided(found, rows, num_firm, _OPENING, reference)


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
        if gap <= _LP_GAP * size and (slack >= -_EXCESS * rows.sizes(point)).all():
            return point
    point = _decided(found, rows, num_firm, _LP_OPENING, -_DOWNHILL * cost)
    if np.abs(point).max() > _FARTHEST:
        raise SolverError("a linear program without a least", A, b)
    return point


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
    if not gap <= _GAP * min(1.0 + away, away * (away + size)):
        return False
    return min(slack.tolist(), default=0.0) >= 0.0 or bool(
        (slack >= -_EXCESS * rows.sizes(v)).all()
    )


def _decided(
    found: Projection,
    rows: UnitRows,
    num_firm: int | None,
    opening: float,
    reference: Array,
) -> Array:
    """The nearest point where floats found none that is verified, or the proof of none.

    All rows but the first `num_firm` and blanks are opened, by a share of their sizes,
    so that the set has an interior or no point. The conflict in which the floats ended
    may be Farkas' proof: z of sum 1 with z'A = 0 to rounding, and z'b < 0 for points
    that are no further away than the rows. Else rational numbers decide.

    Raises:
        EmptySetError: No point satisfies the rows.
    """
    b = np.where(rows.is_blank, rows.b, rows.b + opening * rows.sizes(found.point))
    b[:num_firm], reach = rows.b[:num_firm], float(np.abs(rows.b).max(initial=1.0))
    if found.conflict is not None:
        z = found.conflict
        z = np.where(z > _LIGHTEST * z.max(), z, 0.0)
        z /= z.sum()
        imbalance = np.abs(z @ rows.A)
        # Relative to what is in a column: a slack's may be small, and the slack large.
        is_balanced = imbalance <= _BALANCE * np.abs(rows.A).max(axis=0)
        most = float(z @ b) + reach * float(imbalance.sum())
        if is_balanced.all() and most < -10.0 * _BALANCE * float(z @ np.abs(b)):
            raise _empty(rows, z)
    exact = nearest_by_active_set(rows.A, b, reference, is_exact=True)
    if exact.conflict is None:
        return exact.point
    # Rows that only make up for the rounding of the others are not named, where the
    # proof holds without them.
    z = exact.conflict / exact.conflict.sum()
    heavy = np.where(z > _NOISE * z.max(), z, 0.0)
    most = float(heavy @ b) + reach * float(np.abs(heavy @ rows.A).sum())
    raise _empty(rows, heavy if most < 0.5 * (z @ b) else z)


def _empty(rows: UnitRows, conflict: Array) -> EmptySetError:
    """Returns the error with Farkas' proof, an irreducible one."""
    A, b = rows.given
    value = float(conflict @ rows.b) / float(conflict.sum())
    radius = value if rows.A[conflict > 0.0].any() else -math.inf
    return EmptySetError(A, b, radius, rows.as_given(conflict))


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
