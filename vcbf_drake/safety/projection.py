"""The QP behind every filter and the linear programs beside it, solved and verified.

A MathematicalProgram proposes, the active set makes the proposal exact on the rows it
touches, and arithmetic decides: the optimality conditions hold, or Farkas' multipliers
prove that there is no point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.active_set import ActiveSetSolution, nearest_by_active_set
from vcbf_drake.safety.polytope import (
    BALANCE_TOLERANCE,
    FEASIBILITY_TOLERANCE,
    Emptiness,
    UnitRows,
    emptiness_certificate,
)
from vcbf_drake.safety.programs import (
    DEFAULT_SOLVER,
    LinearProgram,
    NearestPointProgram,
)

# A row shorter than this, which moves by no more over all normalised inputs, is blank.
SHORTEST = 1e-12
# Rows of sets that may have no interior are opened by so much of the tolerance, ...
_OPENING = 0.6 * FEASIBILITY_TOLERANCE
# ... and a verified solution leaves the opened rows by no more than so much of it.
_EXCESS = 0.1 * FEASIBILITY_TOLERANCE
# No point of the set as given is better by more, relative to the distance from the
# reference.
_GAP = 1e-9
# How well A v is known, relative to its terms.
_ROUNDING = 1e-15
# Rows this close to a solver's answer may be active. A wider reach forgives a solver's
# tolerance, a narrower one keeps apart rows that nearly meet.
_REACHES = (1e-7, 1e-4, math.inf)
# Of a linear program: rows with larger multipliers carry the cost; its solution leaves
# no row by more than ...
_CARRYING = 1e-3
_EXACT = 1e-10
# ... or, where the last zoom does not get there, than ...
_NEARLY_EXACT = 1e-7
# No point's cost is lower by more than this, relative to where they are.
_LP_GAP = 1e-9
_ZOOMS = (1.0, 1e4, 1e8)
# The scale of its cost: Clp's tolerance on multipliers is absolute.
_SHARPNESS = 1e4


@dataclass(frozen=True)
class NearestPoint:
    """A verified solution v of min 1/2 |v - reference|^2 subject to ``A v <= b``.

    Attributes:
        point: The minimiser v, shape (m,).
        multipliers: Of the rows as given, nonnegative, shape (n,).
    """

    point: Array
    multipliers: Array


def nearest_point(
    A: Array,
    b: Array,
    reference: Array,
    num_firm: int = 0,
    solver: str = DEFAULT_SOLVER,
) -> NearestPoint:
    """Returns the point of ``{v : A v <= b}`` nearest to the reference.

    A reference inside the set is returned untouched. Any other answer is verified by
    the optimality conditions v = reference - A'y, y >= 0, A v <= b, y'(b - A v) = 0.
    A set that is empty by less than 6e-10 counts as one with a point: where its rows
    as given lead to no verified answer, they are opened by as much.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).
        num_firm: How many rows, the first, are never opened: together they must have
            an interior.
        solver: The name of the solver that proposes, one of `SOLVERS`.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
        SolverError: No proposal could be made exact and verified.
    """
    if (A @ reference <= b).all():
        return NearestPoint(reference, np.zeros(len(b)))
    rows = UnitRows(A, b, SHORTEST)
    program = NearestPointProgram.of_size(*A.shape, solver)
    bounds = rows.b + opening(rows, num_firm)
    for right in (rows.b, bounds):
        proposal = program.solve(rows.A, right, reference)
        for near in _touched(rows.A, right, proposal):
            found = _made_exact(rows.A, right, reference, near)
            if _is_optimal(found, rows.A, rows.b, right, reference):
                return NearestPoint(found.point, found.multipliers / rows.length)
        if _excludes_all(found, rows.A, bounds):
            break  # Opening the rows would not help.
    raise _no_answer(rows, found.conflict)


def minimise_linear(cost: Array, A: Array, b: Array) -> Array:
    """Returns a minimiser of cost'v over ``{v : A v <= b}``.

    The solver's tolerance on rows is absolute. So its answer is made exact on the rows
    that carry the cost and, while others are left by it, sought again around itself, in
    ever larger coordinates.

    Args:
        cost: Shape (m,).
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
        SolverError: No minimiser was verified: perhaps the cost has no least.
    """
    rows = UnitRows(A, b, SHORTEST)
    cost = _SHARPNESS * cost / (float(np.linalg.norm(cost)) or 1.0)
    program, point = LinearProgram.of_size(*A.shape), np.zeros(len(cost))
    size, excess, is_least = 1.0, math.inf, False
    for zoom in _ZOOMS:
        bounds = zoom * (rows.b - rows.A @ point)
        found = program.solve(cost, rows.A, bounds)
        if found is None and zoom == _ZOOMS[0]:
            # Of a set without interior Clp may say that it is empty.
            other = LinearProgram.of_size(*A.shape, math.inf, DEFAULT_SOLVER)
            found = other.solve(cost, rows.A, bounds)
        if found is None:
            break
        move, multipliers = found
        point = _touching(rows, point + move / zoom, multipliers > _CARRYING)
        slack = rows.b - rows.A @ point
        excess = -float(slack.min())
        # No point is better by more than weak duality allows.
        size = 1.0 + float(np.abs(point).max())
        pull = float(np.abs(cost + multipliers @ rows.A).sum()) * size
        is_least = float(multipliers @ slack) + pull <= _LP_GAP * _SHARPNESS * size
        if excess <= _EXACT and is_least:
            return point
    error = _no_answer(rows, None)
    is_near = is_least and excess <= _NEARLY_EXACT * size
    if isinstance(error, SolverError) and is_near:
        return point
    raise error


def _touching(rows: UnitRows, point: Array, carry: NDArray[np.bool_]) -> Array:
    """Moves a point, by little, onto the rows that carry a linear program's cost."""
    slack = rows.b - rows.A @ point
    if not slack[carry].any():
        return point
    move = np.linalg.lstsq(rows.A[carry], slack[carry], rcond=1e-9)[0]
    # Rows that nearly coincide, but for the solver's tolerance, meet elsewhere.
    is_worse = np.max(rows.A @ move - slack) > max(_EXACT, -float(slack.min()))
    return point if is_worse else point + move


def opening(rows: UnitRows, num_firm: int) -> Array:
    """Returns by how much rows are opened: then a set has an interior or no point.

    Args:
        rows: Its rows.
        num_firm: How many rows, the first, stay where they are; blank rows do too.
    """
    distance = np.where(rows.is_blank, 0.0, _OPENING)
    distance[:num_firm] = 0.0
    return distance


def _touched(A: Array, b: Array, proposal: Array | None) -> Iterator[NDArray[np.intp]]:
    """Rows that a proposal touches, from few to all; all at once without a proposal."""
    for reach in _REACHES if proposal is not None else _REACHES[-1:]:
        if proposal is None or math.isinf(reach):
            yield np.arange(len(b))
        else:
            yield (b - A @ proposal < reach).nonzero()[0]


def _made_exact(
    A: Array, b: Array, reference: Array, near: NDArray[np.intp]
) -> ActiveSetSolution:
    """The point nearest to the reference on some of the rows alone."""
    found = nearest_by_active_set(A[near], b[near], reference)
    multipliers = np.zeros(len(b))
    multipliers[near] = found.multipliers
    conflict = None
    if found.conflict is not None:
        conflict = np.zeros(len(b))
        conflict[near] = found.conflict
    return ActiveSetSolution(found.point, multipliers, conflict)


def _is_optimal(
    found: ActiveSetSolution, A: Array, b: Array, opened: Array, reference: Array
) -> bool:
    """Whether a point meets the opened rows, and no point of the set is much nearer.

    No point z with ``A z <= b`` is nearer than (E78) allows.
    """
    v, y = found.point, found.multipliers
    product, pull = A @ v, reference - v
    error = pull - y @ A
    rounding = _ROUNDING * float(y @ np.abs(b) + y.sum())
    gap = float(y @ (b - product) + 0.5 * (error @ error)) + rounding
    size = 1.0 + max(map(abs, pull.tolist()))
    return gap <= _GAP * size and bool((product <= opened + _EXCESS).all())


def _excludes_all(found: ActiveSetSolution, A: Array, b: Array) -> bool:
    """Whether the conflict that the active set ended in is Farkas' proof."""
    return _proof(found.conflict, A, b) is not None


def _proof(conflict: Array | None, A: Array, b: Array) -> tuple[Array, float] | None:
    """Multipliers z of sum 1 with z'A = 0 to rounding, and z'b < 0; None if they fail.

    Args:
        conflict: z, of any length.
        A: The rows, of unit length or zeros.
        b: Their right-hand sides.
    """
    if conflict is None:
        return None
    z = np.where(conflict > BALANCE_TOLERANCE * conflict.max(), conflict, 0.0)
    z /= z.sum()
    imbalance, value = max(map(abs, (z @ A).tolist())), float(z @ b)
    if imbalance > BALANCE_TOLERANCE or value >= -10.0 * BALANCE_TOLERANCE:
        return None
    return z, value


def _no_answer(rows: UnitRows, conflict: Array | None) -> EmptySetError | SolverError:
    """Returns the error that says why: with a proof that the set is empty, or none."""
    A, b = rows.given
    proof = _proven_empty(rows, conflict) or emptiness_certificate(A, b)
    if proof is not None:
        return EmptySetError(A, b, proof.inradius, proof.rows.tolist())
    return SolverError("no proposal of a solver could be verified", A, b)


def _proven_empty(rows: UnitRows, conflict: Array | None) -> Emptiness | None:
    """Farkas' proof by the active set's conflict."""
    proof = _proof(conflict, rows.A, rows.b)
    if proof is None:
        return None
    z, value = proof
    involved = z.nonzero()[0]
    if rows.A[involved].any():
        return Emptiness(z, involved, value)
    # A blank row that is not quite zero is met far outside: no proof by itself.
    is_zero = not rows.given[0][involved].any()
    return Emptiness(z, involved, -math.inf) if is_zero else None
