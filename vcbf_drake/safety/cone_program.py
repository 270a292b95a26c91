"""The cone program that proposes the largest ellipsoid inside a polytope."""

from __future__ import annotations

from functools import lru_cache
import math
from threading import Lock

import numpy as np
from pydrake.solvers import (
    Binding,
    ClarabelSolver,
    EvaluatorBase,
    MathematicalProgram,
    SolverOptions,
)

from vcbf_drake.checks import Array


class ConeProgram:
    """max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i, L lower triangular.

    Built once per size. A solve overwrites every coefficient that differs, so that its
    answer depends on its own data only.
    """

    def __init__(self, num_rows: int, num_inputs: int, tolerance: float) -> None:
        m = num_inputs
        self._row, self._column = np.tril_indices(m)
        self._k = len(self._row)
        self._slot, self._entry = 1 + self._column, np.arange(self._k)
        # Drake pads the geometric mean with ones to a power of two.
        self._power = 2 ** math.ceil(math.log2(m))
        self._program = MathematicalProgram()
        x = self._program.NewContinuousVariables(self._k + m)
        diagonal = x[: self._k][self._row == self._column]
        self._program.AddMaximizeGeometricMeanCost(diagonal, 1.0)
        dense = np.ones((m + 1, self._k + m))
        cones = [
            self._program.AddLorentzConeConstraint(dense, np.ones(m + 1), x)
            for _ in range(num_rows)
        ]
        self._cones = [cone.evaluator() for cone in cones]
        # Of this type a binding is read many times faster than of its own.
        self._bindings = [
            Binding[EvaluatorBase](cone.evaluator(), cone.variables()) for cone in cones
        ]
        self._F = np.zeros((num_rows, m + 1, self._k + m))
        self._g = np.zeros((num_rows, m + 1))
        self._rows = np.full((num_rows, m + 1), np.nan)
        self._options = SolverOptions()
        for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
            self._options.SetOption(ClarabelSolver.id(), name, tolerance)
        self._solver = ClarabelSolver()
        self._lock = Lock()

    def solve(self, A: Array, b: Array) -> tuple[Array, Array, Array] | None:
        """Returns d, L and the multipliers d(log det L)/db, or None."""
        m, k = A.shape[1], self._k
        with self._lock:
            self._F[:, 0, k:], self._g[:, 0] = -A, b
            self._F[:, self._slot, self._entry] = A[:, self._row]
            rows = np.column_stack([A, b])
            # An update costs more than a comparison, and most rows are the box's.
            for i in (rows != self._rows).any(axis=1).nonzero()[0]:
                self._cones[i].UpdateCoefficients(self._F[i], self._g[i])
            self._rows = rows
            result = self._solver.Solve(self._program, None, self._options)
        if not result.is_success():
            return None
        x = result.get_x_val()
        L = np.zeros((m, m))
        L[self._row, self._column] = x[:k]
        diagonal = L.diagonal().tolist()
        if not min(diagonal) > 0.0:
            return None
        duals = [result.GetDualSolution(binding)[0] for binding in self._bindings]
        # The cost's multipliers are those of (det L)^(1/P) = exp(log det L / P).
        mean = math.prod(diagonal) ** (1.0 / self._power)
        return x[k : k + m], L, np.array(duals) * (self._power / mean)


@lru_cache(maxsize=128)
def cone_program(num_rows: int, num_inputs: int, tolerance: float) -> ConeProgram:
    """Returns the program of this size, built once."""
    return ConeProgram(num_rows, num_inputs, tolerance)
