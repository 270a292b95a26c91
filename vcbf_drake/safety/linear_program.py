"""Small linear programs, solved exactly enough to be checked."""

from __future__ import annotations

from functools import lru_cache
from threading import Lock

import numpy as np
from pydrake.solvers import ClpSolver, MathematicalProgram

from vcbf_drake.errors import Array, SolverError

_FEASIBILITY_TOLERANCE = 1e-7


def minimise_linear(cost: Array, A: Array, b: Array) -> Array:
    """Returns a minimiser of cost'v over ``{v : A v <= b}``.

    Args:
        cost: Shape (m,).
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        SolverError: No minimiser was found: the set is empty or the cost unbounded.
    """
    point, success = _program(*A.shape).solve(cost, A, b)
    if not success or np.max(A @ point - b) > _FEASIBILITY_TOLERANCE * (
        1.0 + np.abs(b).max()
    ):
        raise SolverError("the linear program has no verified solution", A, b)
    return point


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
        ).evaluator()

    def solve(self, cost: Array, A: Array, b: Array) -> tuple[Array, bool]:
        with self._lock:
            self._cost.UpdateCoefficients(cost, 0.0)
            self._rows.UpdateCoefficients(A, self._below, b)
            result = ClpSolver().Solve(self._program)
        return result.get_x_val(), result.is_success()


@lru_cache(maxsize=256)
def _program(num_rows: int, num_variables: int) -> _Program:
    return _Program(num_rows, num_variables)
