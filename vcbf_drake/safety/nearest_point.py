"""The point of a polytope nearest to a reference: the QP behind every filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math
from threading import Lock

import numpy as np
from pydrake.solvers import (
    ClarabelSolver,
    MathematicalProgram,
    NloptSolver,
    SnoptSolver,
    SolverInterface,
    SolverOptions,
)

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.active_set import ActiveSetSolution, nearest_by_active_set
from vcbf_drake.safety.emptiness import Emptiness, emptiness_certificate
from vcbf_drake.safety.unit_length import of_unit_length

# No row is left by more than this, measured as a distance, once the point is projected
# onto the input set.
FEASIBILITY_TOLERANCE = 1e-9
# Of that, rows of sets that may have no interior are opened by ...
_OPENING = 0.6 * FEASIBILITY_TOLERANCE
# ... and a verified solution leaves the opened rows by no more than ...
_EXCESS = 0.1 * FEASIBILITY_TOLERANCE
# No point of the set as given is better by more, relative to the distance from the
# reference.
_GAP = 1e-9
# How well A v is known, relative to its terms.
_ROUNDING = 1e-15
# Multipliers of rows of unit length, of sum 1, balance when |A'z| is below this.
_BALANCE = 1e-12
# Rows this close to a solver's answer may be active; the wider reach forgives a
# solver's tolerance, the narrower one keeps apart rows that nearly meet.
_TOUCHING = (1e-7, 1e-4)


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
    A: Array, b: Array, reference: Array, num_firm: int = 0
) -> NearestPoint:
    """Returns the point of ``{v : A v <= b}`` nearest to the reference.

    A reference inside the set is returned untouched. Any other answer is verified by
    the optimality conditions v = reference - A'y, y >= 0, A v <= b, y'(b - A v) = 0.
    A set that is empty by less than 6e-10 counts as one with a point: its rows are
    opened by as much.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).
        num_firm: How many rows, the first, are never opened: together they must have
            an interior.

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
        SolverError: No solver's answer could be verified.
    """
    rows, bounds, length = of_unit_length(A, b)
    found, conflict = _by_active_set(rows, bounds, reference, num_firm)
    if found is None:
        proof = _proven_empty(A, rows, bounds, conflict) or emptiness_certificate(A, b)
        if proof is not None:
            raise EmptySetError(A, b, proof.inradius, proof.rows.tolist())
        found = _by_solvers(rows, bounds, reference, num_firm)
    if found is None:
        raise SolverError("no solver's answer to the QP could be verified", A, b)
    return NearestPoint(found.point, found.multipliers / length)


def nearest_point_by_active_set(
    A: Array, b: Array, reference: Array, num_firm: int = 0
) -> NearestPoint | None:
    """Returns the same, verified; None where the set is empty, as far as one can tell.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).
        num_firm: How many rows, the first, are never opened.
    """
    rows, bounds, length = of_unit_length(A, b)
    found, _ = _by_active_set(rows, bounds, reference, num_firm)
    return found and NearestPoint(found.point, found.multipliers / length)


def opened(A: Array, b: Array, num_firm: int) -> Array:
    """Returns right-hand sides of a set that has an interior unless it is empty.

    Args:
        A: Rows of unit length, or blank, shape (n, m).
        b: Their right-hand sides, shape (n,).
        num_firm: How many rows, the first, stay where they are; blank rows do too.
    """
    opening: Array = np.where(A.any(axis=1), _OPENING, 0.0)
    opening[:num_firm] = 0.0
    return b + opening


def _by_active_set(
    A: Array, b: Array, reference: Array, num_firm: int
) -> tuple[NearestPoint | None, Array | None]:
    """The nearest point; where rounding leaves it open which, that of the opened set.

    Also the conflict between rows where there is none.
    """
    solution = nearest_by_active_set(A, b, reference)
    if not _is_optimal(solution, A, b, b, reference):
        bounds = opened(A, b, num_firm)
        solution = nearest_by_active_set(A, bounds, reference)
        if not _is_optimal(solution, A, b, bounds, reference):
            return None, solution.conflict
    return NearestPoint(solution.point, solution.multipliers), None


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


def _proven_empty(
    given: Array, A: Array, b: Array, conflict: Array | None
) -> Emptiness | None:
    """Farkas' proof, z'A = 0 and z'b < 0, on rows of unit length or of zeros."""
    if conflict is None:
        return None
    z = np.where(conflict > _BALANCE * conflict.max(), conflict, 0.0)
    z /= z.sum()
    rows = z.nonzero()[0]
    imbalance, value = max(map(abs, (z @ A).tolist())), float(z @ b)
    if imbalance > _BALANCE or value >= -10.0 * _BALANCE:
        return None
    if A[rows].any():
        return Emptiness(z, rows, value)
    # A blank row that is not quite zero is met far outside: no proof by itself.
    return None if given[rows].any() else Emptiness(z, rows, -math.inf)


def _by_solvers(
    A: Array, b: Array, reference: Array, num_firm: int
) -> NearestPoint | None:
    """Lets one solver after another propose which rows the nearest point touches."""
    bounds = opened(A, b, num_firm)
    for solver, options in _solvers():
        guess = _program(*A.shape).solve(solver, options, A, bounds, reference)
        for touching in _TOUCHING:
            near = (bounds - A @ guess < touching).nonzero()[0]
            on_rows = nearest_by_active_set(A[near], bounds[near], reference)
            y = np.zeros(len(b))
            y[near] = on_rows.multipliers
            solution = ActiveSetSolution(on_rows.point, y, None)
            if _is_optimal(solution, A, b, bounds, reference):
                return NearestPoint(solution.point, y)
    return None


class _Program:
    """The QP as a MathematicalProgram of fixed size; every solve overwrites it all."""

    def __init__(self, num_rows: int, num_variables: int) -> None:
        self._lock = Lock()
        self._program = MathematicalProgram()
        v = self._program.NewContinuousVariables(num_variables)
        self._identity = np.eye(num_variables)
        self._below = np.full(num_rows, -np.inf)
        self._cost = self._program.AddQuadraticCost(
            self._identity, np.zeros(num_variables), v, is_convex=True
        ).evaluator()
        self._rows = self._program.AddLinearConstraint(
            np.ones((num_rows, num_variables)),
            self._below,
            np.zeros(num_rows),
            v,
        ).evaluator()

    def solve(
        self,
        solver: SolverInterface,
        options: SolverOptions,
        A: Array,
        b: Array,
        reference: Array,
    ) -> Array:
        with self._lock:
            self._cost.UpdateCoefficients(self._identity, -reference)
            self._rows.UpdateCoefficients(A, self._below, b)
            result = solver.Solve(self._program, np.zeros(len(reference)), options)
        point: Array = result.get_x_val()
        return point


@lru_cache(maxsize=256)
def _program(num_rows: int, num_variables: int) -> _Program:
    return _Program(num_rows, num_variables)


@lru_cache(maxsize=1)
def _solvers() -> tuple[tuple[SolverInterface, SolverOptions], ...]:
    """Returns the solvers in the order in which they are tried.

    Clarabel with its default step length cycles on some feasible QPs without slack.
    """
    shorter_steps = SolverOptions()
    shorter_steps.SetOption(ClarabelSolver.id(), "max_step_fraction", 0.9)
    return (
        (NloptSolver(), SolverOptions()),
        (ClarabelSolver(), shorter_steps),
        (SnoptSolver(), SolverOptions()),
    )
