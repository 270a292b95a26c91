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
# Rows of sets that may have no interior are opened by this. Half the tolerance is left
# for what a projection onto the input set moves afterwards.
_OPENING = 0.4 * FEASIBILITY_TOLERANCE
# A row shorter than this, which moves by no more over all normalised inputs, is blank.
_BLANK = 1e-12
# A reference further away than this is approached step by step.
_NEAR = 10.0
_MOST_STEPS = 20
# Relative, of a sum of rows times multipliers.
_ROUNDING = 1e-15
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
        found = _opened(A, b, reference) or _by_solvers(A, b, reference)
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
    return _scaled(_active_set(rows, bounds, reference), length)


def _opened(A: Array, b: Array, reference: Array) -> NearestPoint | None:
    """The nearest point of a set that is empty by less than can be told.

    It counts as one with a point, which is where its rows meet when they are opened.
    """
    length = _lengths(A)
    rows, bounds = A / length[:, None], b / length
    found = _active_set(rows, bounds + _OPENING, reference)
    if found is None or np.max(rows @ found.point - bounds) > FEASIBILITY_TOLERANCE:
        return None
    return _scaled(found, length)


def _active_set(A: Array, b: Array, reference: Array) -> NearestPoint | None:
    """Solves the optimality conditions on all rows; None where that fails."""
    solution = None
    if np.abs(reference).max() > _NEAR:
        solution = _from_afar(A, b, reference)
    return solution or _on_rows(slice(None), A, b, reference)


def _from_afar(A: Array, b: Array, reference: Array) -> NearestPoint | None:
    """The same from references that are not too far away.

    A point p is nearest to r exactly when it is nearest to p + s (r - p), s > 0: seen
    from far away, what tells the rows apart would drown in rounding. And when it is
    nearest to r - A'z, of multipliers z that it has at least: where the rows that push
    stay the same, most of their push is taken off.
    """
    point = reference / np.abs(reference).max()
    taken_off, pushed = np.zeros(len(b)), np.zeros(len(b), dtype=bool)
    for _ in range(_MOST_STEPS):
        away = reference - taken_off @ A - point
        near = _NEAR * max(1.0, float(np.abs(point).max()))
        times = max(1.0, float(np.abs(away).max()) / near)
        solution = _on_rows(slice(None), A, b, point + away / times)
        if solution is None:
            return None
        multipliers = taken_off + times * solution.multipliers
        moved = float(np.abs(solution.point - point).max())
        point, pushes = solution.point, solution.multipliers > 0.0
        if times == 1.0 or moved <= 1e-12 * near:
            is_optimal = _is_optimal(A, b, point, multipliers)
            return NearestPoint(point, multipliers) if is_optimal else None
        if (pushes == pushed).all():
            taken_off += 0.9 * (times - 1.0) * solution.multipliers
        pushed = pushes
    return None


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
    length[length <= _BLANK] = 1.0
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
    if _is_optimal(A, b, point, multipliers):
        return NearestPoint(point, multipliers)
    point = _touching(A, b, reference, multipliers)
    if not _is_optimal(A, b, point, multipliers):
        return None
    return NearestPoint(point, multipliers)


def _touching(A: Array, b: Array, reference: Array, multipliers: Array) -> Array:
    """Moves r - A'y onto the rows with y > 0, as far as rounding explains it."""
    point: Array = reference - multipliers @ A
    pushing = multipliers > 0.0
    slack = (b - A @ point)[pushing]
    move = np.linalg.lstsq(A[pushing], slack, rcond=1e-12)[0]
    rounding = _ROUNDING * (np.abs(reference).max() + multipliers.sum())
    return point + move if np.abs(move).max() <= rounding else point


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
