"""The QP behind every filter and the linear programs beside it, solved and verified.

A MathematicalProgram proposes, the active set makes the proposal exact on the rows it
touches, and arithmetic decides: the optimality conditions hold, or Farkas' multipliers
prove that there is no point. Questions that floats leave open are decided in rational
numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from numpy.typing import NDArray

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
from vcbf_drake.safety.unit_rows import (
    BALANCE_TOLERANCE,
    FEASIBILITY_TOLERANCE,
    UnitRows,
)

# Rows of sets that may have no interior are opened by so much of the tolerance, ...
OPENING = 0.6 * FEASIBILITY_TOLERANCE
# ... and a verified solution leaves the opened rows by no more than so much of it.
_EXCESS = 0.1 * FEASIBILITY_TOLERANCE
# No point of the set as given is better by more, relative to the distance from the
# reference.
_GAP = 1e-9
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


def nearest_point(
    A: Array,
    b: Array,
    reference: Array,
    num_firm: int = 0,
    solver: str = DEFAULT_SOLVER,
) -> Projection:
    """Returns the point of ``{v : A v <= b}`` nearest to the reference.

    Its multipliers are of the rows as given.

    A reference inside the set is returned untouched. Any other answer is verified by
    the optimality conditions v = reference - A'y, y >= 0, A v <= b, y'(b - A v) = 0.
    A set that is empty by less than 6e-10 counts as one with a point: where its rows
    as given lead to no verified answer, they are opened by as much.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).
        num_firm: The number of first rows that are never opened: together they must
            have an interior.
        solver: The name of the solver that proposes, one of `SOLVERS`.

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
    """Returns the same by the solver, wherever the reference is.

    Its multipliers are of the unit rows.

    Args:
        rows: The rows.
        reference: As for `nearest_point`, like the others.
        num_firm: The number of first rows that are never opened.
        solver: The solver's name.

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

    Args:
        cost: Shape (m,).
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        num_firm: The number of first rows that are not opened, as for `nearest_point`;
            by default all.
        reach: The bound of a point's entries where rows bound them.

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


def opened(rows: UnitRows, num_firm: int) -> Array:
    """Returns right-hand sides with which a set has an interior or no point, (n,).

    Args:
        rows: Its rows.
        num_firm: The number of first rows that are not opened; blank rows are not
            either.
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
    is_balanced = imbalance <= BALANCE_TOLERANCE * np.abs(rows.A).max(axis=0)
    most = float(z @ opened(rows, num_firm)) + reach * float(imbalance.sum())
    if is_balanced.all() and most < -10.0 * BALANCE_TOLERANCE:
        raise _empty(rows, z)


def _empty(rows: UnitRows, conflict: Array) -> EmptySetError:
    """Returns the error with Farkas' proof, an irreducible one."""
    A, b = rows.given
    value = float(conflict @ rows.b) / float(conflict.sum())
    radius = value if rows.A[conflict > 0.0].any() else -math.inf
    return EmptySetError(A, b, radius, rows.as_given(conflict))
