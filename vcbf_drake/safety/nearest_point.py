"""The point of a polytope nearest to a reference: the QP behind every filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import (
    ClarabelSolver,
    MathematicalProgram,
    NloptSolver,
    SnoptSolver,
    SolverInterface,
    SolverOptions,
)

from vcbf_drake.errors import Array, EmptySetError, SolverError
from vcbf_drake.safety.active_set import nonnegative_multipliers
from vcbf_drake.safety.polytope import emptiness_certificate

# A verified solution leaves no row, measured as a distance, by more than this.
FEASIBILITY_TOLERANCE = 1e-9
# Its duality gap, relative to the size of the cost's terms, is at most this.
GAP_TOLERANCE = 1e-9
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


def nearest_point(A: Array, b: Array, reference: Array) -> NearestPoint:
    """Returns the point of ``{v : A v <= b}`` nearest to the reference.

    A reference inside the set is returned untouched. Any other answer is verified by
    the optimality conditions v = reference - A'y, y >= 0, A v <= b, y'(b - A v) = 0.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).

    Raises:
        EmptySetError: No point satisfies the rows; certified, not guessed.
        SolverError: No solver's answer could be verified.
    """
    found = nearest_point_by_active_set(A, b, reference)
    if found is None:
        certificate = emptiness_certificate(A, b)
        if certificate is not None:
            raise EmptySetError(A, b, certificate.inradius, certificate.rows.tolist())
        found = _by_solvers(A, b, reference)
    if found is None:
        raise SolverError("no solver's answer to the QP could be verified", A, b)
    return found


def nearest_point_by_active_set(
    A: Array, b: Array, reference: Array
) -> NearestPoint | None:
    """Returns the verified nearest point; None where the set is empty, or all but.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        reference: The point to stay close to, shape (m,).
    """
    if (A @ reference <= b).all():
        return NearestPoint(reference, np.zeros(len(b)))
    length = _lengths(A)
    rows, bounds = A / length[:, None], b / length
    return _scaled(_on_rows(slice(None), rows, bounds, reference), length)


def _by_solvers(A: Array, b: Array, reference: Array) -> NearestPoint | None:
    """Lets one solver after another propose which rows the nearest point touches."""
    length = _lengths(A)
    rows, bounds = A / length[:, None], b / length
    for solver, options in _solvers():
        guess = _program(*A.shape).solve(solver, options, rows, bounds, reference)
        for touching in _TOUCHING:
            near = (bounds - rows @ guess < touching).nonzero()[0]
            solution = _on_rows(near, rows, bounds, reference)
            if solution is not None:
                return _scaled(solution, length)
    return None


def _lengths(A: Array) -> Array:
    """The rows' lengths, (n,); 1, to leave it alone, for one that is all but zero."""
    length: Array = np.sqrt(np.einsum("ij,ij->i", A, A))
    length[length <= 1e-12 * max(1.0, length.max())] = 1.0
    return length


def _scaled(found: NearestPoint | None, length: Array) -> NearestPoint | None:
    return found and NearestPoint(found.point, found.multipliers / length)


def _on_rows(
    rows: NDArray[np.intp] | slice, A: Array, b: Array, reference: Array
) -> NearestPoint | None:
    """Solves the optimality conditions on some rows, and verifies them on all.

    Returns None when the result is not an optimum: another row matters too.
    """
    multipliers = np.zeros(len(b))
    multipliers[rows] = nonnegative_multipliers(A[rows], b[rows], reference)
    point = reference - multipliers @ A
    if not _is_optimal(A, b, point, multipliers):
        return None
    return NearestPoint(point, multipliers)


def _is_optimal(A: Array, b: Array, point: Array, multipliers: Array) -> bool:
    """Whether a point reference - A'y, y >= 0, is the projection, to the tolerances."""
    slack = b - A @ point
    scale = 1.0 + multipliers @ np.abs(b)
    return bool(
        slack.min() >= -FEASIBILITY_TOLERANCE
        and abs(multipliers @ slack) <= GAP_TOLERANCE * scale
    )


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
