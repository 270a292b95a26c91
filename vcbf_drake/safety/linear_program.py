"""Small linear programs, solved exactly enough to be checked."""

from __future__ import annotations

from functools import lru_cache
from threading import Lock

import numpy as np
from pydrake.solvers import ClpSolver, MathematicalProgram

from vcbf_drake.checks import Array
from vcbf_drake.errors import SolverError
from vcbf_drake.safety.active_set import nearest_by_active_set
from vcbf_drake.safety.unit_length import of_unit_length

# A point that leaves every row, measured as a distance, by no more than this is one.
_FEASIBILITY_TOLERANCE = 1e-7
# What counts as no violation at all.
_EXACT = 1e-10
# Proximal points: how far their references are, how little a point may move that
# stays, and how often it is tried.
_STEP = 1e4
_STILL = 1e-9
_MOST_STEPS = 6
# The scale of the program's cost: the solver's tolerance on multipliers is absolute.
_SHARPNESS = 1e4
# How often, and how much closer each time, a solution is sought again from itself.
_MOST_REFINEMENTS = 3
_ZOOM = 1e4


def minimise_linear(cost: Array, A: Array, b: Array) -> Array:
    """Returns a minimiser of cost'v over ``{v : A v <= b}``.

    Args:
        cost: Shape (m,).
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        SolverError: No minimiser was found: the set is empty or the cost unbounded.
    """
    rows, bounds, _ = of_unit_length(A, b)
    cost = cost / (float(np.linalg.norm(cost)) or 1.0)
    found = _by_nearest_points(cost, rows, bounds)
    if found is not None:
        return found
    cost = cost * _SHARPNESS
    point, zoom, program = np.zeros(len(cost)), 1.0, _program(*A.shape)
    for _ in range(_MOST_REFINEMENTS):
        solution = program.solve(cost, rows, zoom * (bounds - rows @ point))
        if solution is None:
            break
        move, multipliers = solution
        point = _touching(rows, bounds, point + move / zoom, multipliers)
        if np.max(rows @ point - bounds) <= _EXACT:
            return point
        zoom *= _ZOOM  # The solver's tolerance on rows is absolute too.
    excess = float(np.max(rows @ point - bounds))
    if zoom == 1.0 or excess > _FEASIBILITY_TOLERANCE * (1.0 + np.abs(point).max()):
        raise SolverError("the linear program has no verified solution", A, b)
    return point


def _by_nearest_points(cost: Array, A: Array, b: Array) -> Array | None:
    """The minimiser by proximal points: v becomes the point nearest to v - t cost.

    Where v stays, it is a minimiser, and a large t gets there in a few steps. One that
    moves by d is off by d times the set's diameter, over t.
    """
    point: Array = np.zeros(len(cost))
    for _ in range(_MOST_STEPS):
        found = nearest_by_active_set(A, b, point - _STEP * cost)
        moved = max(map(abs, (found.point - point).tolist()))
        point = found.point
        size = 1.0 + max(map(abs, point.tolist()))
        if moved <= _STILL * size:
            return point if np.max(A @ point - b) <= _EXACT * size else None
    return None


def _touching(A: Array, b: Array, point: Array, multipliers: Array) -> Array:
    """Moves the point, by little, onto the rows that carry the cost."""
    carry = multipliers < -1e-9
    slack = (b - A @ point)[carry]
    if not slack.any():
        return point
    moved: Array = point + np.linalg.lstsq(A[carry], slack, rcond=1e-9)[0]
    # Rows that nearly coincide, but for the solver's tolerance, meet elsewhere.
    worse = np.max(A @ moved - b) > max(_EXACT, float(np.max(A @ point - b)))
    return point if worse else moved


class _Program:
    """The LP as a MathematicalProgram of fixed size; every solve overwrites it all."""

    def __init__(self, num_rows: int, num_variables: int) -> None:
        self._lock = Lock()
        self._program = MathematicalProgram()
        v = self._program.NewContinuousVariables(num_variables)
        self._below = np.full(num_rows, -np.inf)
        self._cost = self._program.AddLinearCost(
            np.zeros(num_variables), 0.0, v
        ).evaluator()
        self._rows = self._program.AddLinearConstraint(
            np.ones((num_rows, num_variables)), self._below, self._below, v
        )

    def solve(self, cost: Array, A: Array, b: Array) -> tuple[Array, Array] | None:
        """Returns a minimiser and the rows' multipliers (at most 0), or None."""
        with self._lock:
            self._cost.UpdateCoefficients(cost, 0.0)
            self._rows.evaluator().UpdateCoefficients(A, self._below, b)
            result = ClpSolver().Solve(self._program)
            if not result.is_success():
                return None
            return result.get_x_val(), np.asarray(result.GetDualSolution(self._rows))


@lru_cache(maxsize=256)
def _program(num_rows: int, num_variables: int) -> _Program:
    return _Program(num_rows, num_variables)
