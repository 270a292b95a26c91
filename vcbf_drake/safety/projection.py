"""The QP behind every filter and the linear programs beside it, solved and verified.

Rows are ``A v <= b``, A (n, m) and b (n,). A MathematicalProgram proposes, the active
set makes the proposal exact on the rows it touches, and arithmetic decides: the
optimality conditions hold, or Farkas' multipliers prove that there is no point. What
floats leave open is decided in rational numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.active_set import (
    Projection,
    nearest_by_active_set,
    nearest_in_rationals,
)
from vcbf_drake.safety.programs import (
    DEFAULT_SOLVER,
    LinearProgram,
    NearestPointProgram,
)

# A point that leaves every row, measured as a distance, by no more than this counts as
# a point of the set [units of u].
FEASIBILITY_TOLERANCE = 1e-9
# Rows of sets that may have no interior are opened by so much of the tolerance, ...
OPENING = 0.6 * FEASIBILITY_TOLERANCE
# ... and a verified solution leaves the opened rows by no more than so much of it.
_EXCESS = 0.1 * FEASIBILITY_TOLERANCE
# No point of the set as given is better by more, relative to the distance from the
# reference.
_GAP = 1e-9
# Multipliers of unit rows, scaled to sum 1, balance when |A'y| is below this.
_BALANCE = 1e-12
# Rows of a conflict that are lighter have no part in it.
_LIGHTEST = 1e-10
# The same, where there is no rounding but that of the rows.
_NOISE = 1e-14
# The relative accuracy of A v, compared with its terms.
_ROUNDING = 1e-15
# Rows this close to a solver's answer may be active. A wider reach forgives a solver's
# tolerance, a narrower one keeps apart rows that nearly meet.
_REACHES = (1e-7, 1e-4)
# Of a linear program: its solution leaves no row by more than ...
_EXACT = 1e-10
# ... and no point's cost is lower by more than this, relative to its terms.
_LP_GAP = 5e-11
# The lengths of its proximal steps; after these, rational numbers decide.
_STEPS = (1e4, 1e8, 1e8)
# The scale of its cost: Clp's tolerance on multipliers is absolute.
_SHARPNESS = 1e4
# The point of a set that is nearest to one so far downhill is a minimiser; one that is
# as far as this has none.
_DOWNHILL = 1e60
_FARTHEST = 1e30
# A row further away than this holds everywhere, or nowhere [units of u].
_FARTHEST_ROW = 1e20


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
        self.is_blank = ~(np.abs(b) / _FARTHEST_ROW < self.length)
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
            multipliers: Those of the unit rows, (n,); or of those without the blanks.
        """
        if len(multipliers) < len(self.b):
            kept, multipliers = multipliers, np.zeros(len(self.b))
            multipliers[~self.is_blank] = kept
        with np.errstate(over="ignore"):
            given: Array = multipliers / self.length
        return given


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


def nearest_point(
    A: Array,
    b: Array,
    reference: Array,
    num_firm: int = 0,
    solver: str = DEFAULT_SOLVER,
) -> Projection:
    """Returns the point of ``{v : A v <= b}`` nearest to the reference.

    A reference inside the set is returned untouched; else see `nearest_in`. Its
    multipliers are of the rows as given.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
    """
    if (A @ reference <= b).all():
        return Projection(reference, np.zeros(len(b)))
    rows = UnitRows(A, b)
    found = nearest_in(rows, reference, num_firm, solver)
    return found._replace(multipliers=rows.as_given(found.multipliers))


def nearest_in(
    rows: UnitRows, reference: Array, num_firm: int, solver: str
) -> Projection:
    """Returns the point that satisfies some rows and is nearest to the reference.

    It is verified by the optimality conditions v = reference - A'y, y >= 0, A v <= b,
    y'(b - A v) = 0, with multipliers y of the unit rows. A set that is empty by less
    than 6e-10 counts as one with a point: where its rows as given lead to no verified
    answer, they are opened by as much.

    Args:
        rows: The rows.
        reference: The point to stay close to, shape (m,).
        num_firm: The number of first rows that are never opened: together they must
            have an interior.
        solver: The name of the solver that proposes, one of `SOLVERS`.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
    """
    program = NearestPointProgram.of_size(*rows.A.shape, solver)
    for is_opened in (False, True):
        right = opened(rows, num_firm) if is_opened else rows.b
        proposal = program.solve(rows.A, right, reference)
        for near in _touched(rows.A, right, proposal):
            found = nearest_by_active_set(rows.A, right, reference, near)
            if _is_optimal(found, rows.A, rows.b, right, reference):
                return found
        _raise_if_empty(found, rows, num_firm)
    return _in_rationals(rows, right, reference)


def minimise_linear(
    cost: Array,
    A: Array,
    b: Array,
    num_firm: int | None = None,
    reach: float = 1.0,
) -> Array:
    """Returns a minimiser of cost'v over ``{v : A v <= b}``.

    The solver's answer is made exact by proximal steps (Rockafellar 1976): the point
    nearest to one downhill of the last is a minimiser after finitely many, from a
    solver's answer after one or two.

    Rows after the first `num_firm`, by default none, are opened as for `nearest_in`; a
    point's entries are bounded by `reach` where rows bound them.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
        SolverError: The cost has no least.
    """
    rows = UnitRows(A, b)
    firm = len(b) if num_firm is None else num_firm
    bounds = opened(rows, firm)
    cost = cost / (float(np.linalg.norm(cost)) or 1.0)
    found = LinearProgram.of_size(*A.shape).solve(_SHARPNESS * cost, rows.A, bounds)
    point = np.zeros(len(cost)) if found is None else found
    for step in _STEPS:
        nearest = nearest_by_active_set(rows.A, bounds, point - step * cost)
        _raise_if_empty(nearest, rows, firm)
        point, multipliers = nearest.point, nearest.multipliers / step
        slack = bounds - rows.A @ point
        # No point's cost is lower by more than weak duality allows (E75, weak duality).
        pull = np.abs(cost + multipliers @ rows.A) @ (reach + np.abs(point))
        gap = float(multipliers @ np.abs(slack) + pull)
        size = 1.0 + abs(float(cost @ point))
        if gap <= _LP_GAP * size and slack.min() >= -_EXACT:
            return point
    point = _in_rationals(rows, bounds, -_DOWNHILL * cost).point
    if np.abs(point).max() > _FARTHEST:
        raise SolverError("a linear program without a least", A, b)
    return point


def _in_rationals(rows: UnitRows, b: Array, reference: Array) -> Projection:
    """The exact decision of a question that floats leave open.

    Raises:
        EmptySetError: No point satisfies the rows.
    """
    found = nearest_in_rationals(rows.A, b, reference)
    if found.conflict is None:
        return found
    # Rows that only make up for the rounding of the others are not named: without them
    # the proof holds for all points that are no further away than the rows.
    z = found.conflict
    heavy, reach = np.where(z > _NOISE * z.max(), z, 0.0), max(1.0, np.abs(b).max())
    most = heavy @ b + reach * np.abs(heavy @ rows.A).sum()
    raise _empty(rows, heavy if most < 0.5 * (z @ b) else z)


def proof_of_conflict(A: Array, b: Array, num_firm: int, near: Array) -> Array | None:
    """Returns Farkas' multipliers of the rows as given; None without a sure conflict.

    Decided in rational numbers, whatever the rows' sizes, and by more than the rounding
    of their terms near a point. The first `num_firm` rows have none.
    """
    rounding = OPENING * (np.abs(b) + np.abs(A) @ np.abs(near))
    rounding[:num_firm] = 0.0
    proof = nearest_in_rationals(A, b + rounding, near).conflict
    if proof is not None:
        weights = proof * UnitRows(A, b).length
        proof[weights < _LIGHTEST * weights.max()] = 0.0
    return proof


def opened(rows: UnitRows, num_firm: int) -> Array:
    """Returns right-hand sides with which a set has an interior or no point, (n,).

    The first `num_firm` rows and blank rows are not opened.
    """
    right = np.where(rows.is_blank, rows.b, rows.b + OPENING)
    right[:num_firm] = rows.b[:num_firm]
    return right


def _touched(
    A: Array, b: Array, proposal: Array | None
) -> Iterator[NDArray[np.intp] | None]:
    """Rows that a proposal touches, from few to all (None)."""
    if proposal is not None:
        slack = b - A @ proposal
        for reach in _REACHES:
            yield (slack < reach).nonzero()[0]
    yield None


def _is_optimal(
    found: Projection, A: Array, b: Array, right: Array, reference: Array
) -> bool:
    """Whether a point meets the rows as opened, and no point of the set is much nearer.

    No point z with ``A z <= b`` is nearer than (E70, optimality by multipliers) allows.
    """
    v, y = found.point, found.multipliers
    product, pull = A @ v, reference - v
    error, rounding = pull - y @ A, _ROUNDING * (np.abs(b) + 1.0)
    gap = float(y @ (b - product + rounding) + 0.5 * (error @ error))
    size = 1.0 + max(map(abs, pull.tolist()))
    spare = min((right - product).tolist(), default=0.0)
    return gap <= _GAP * size and spare >= -_EXCESS


def _raise_if_empty(found: Projection, rows: UnitRows, num_firm: int) -> None:
    """Raises if the conflict that the active set ended in is Farkas' proof in floats.

    That is z of sum 1 with z'A = 0 to rounding, and z'b < 0 of the opened rows, for
    points that are no further away than the rows.

    Raises:
        EmptySetError: No point satisfies the rows.
    """
    if found.conflict is None:
        return
    z = found.conflict
    z = np.where(z > _LIGHTEST * z.max(), z, 0.0)
    z /= z.sum()
    imbalance, reach = np.abs(z @ rows.A), max(1.0, float(np.abs(rows.b).max()))
    # Relative to what is in a column: a slack's may be small, and the slack large.
    is_balanced = imbalance <= _BALANCE * np.abs(rows.A).max(axis=0)
    most = float(z @ opened(rows, num_firm)) + reach * float(imbalance.sum())
    if is_balanced.all() and most < -10.0 * _BALANCE:
        raise _empty(rows, z)


def _empty(rows: UnitRows, conflict: Array) -> EmptySetError:
    """Returns the error with Farkas' proof, an irreducible one."""
    A, b = rows.given
    value = float(conflict @ rows.b) / float(conflict.sum())
    radius = value if rows.A[conflict > 0.0].any() else -math.inf
    return EmptySetError(A, b, radius, rows.as_given(conflict))
