"""MathematicalPrograms of fixed size: built once, overwritten and solved at every tick.

The filter states three kinds of problems: linear programs, the QP and the cone program
of the largest ellipsoid. A solver only proposes their solutions; the caller makes them
exact and verifies them.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
import logging
import math
from threading import Lock, local
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.solvers import (
    Binding,
    ClarabelSolver,
    ClpSolver,
    EvaluatorBase,
    GurobiSolver,
    MathematicalProgram,
    MathematicalProgramResult,
    MosekSolver,
    NloptSolver,
    OsqpSolver,
    SnoptSolver,
    SolverInterface,
    SolverOptions,
)

from vcbf_drake.checks import Array, require

if TYPE_CHECKING:
    from typing import Self  # Python 3.10 has none.

DEFAULT_SOLVER = "Clarabel"
# Drake's solvers that take the QP ...
SOLVERS: dict[str, type[SolverInterface]] = {
    "Clarabel": ClarabelSolver,
    "Clp": ClpSolver,
    "Gurobi": GurobiSolver,
    "Mosek": MosekSolver,
    "NLopt": NloptSolver,
    "OSQP": OsqpSolver,
    "SNOPT": SnoptSolver,
}
# ... and of these, those that take the cone program and return its multipliers.
CONE_SOLVERS = ("Clarabel", "Mosek")
# With no more inputs than these an ellipsoid is cheaper from the solver than from
# Newton's method.
FEW_INPUTS = 3


def check_solver(name: str) -> None:
    """Checks that a solver is known, in this build of Drake, and licensed.

    Args:
        name: One of `SOLVERS`.

    Raises:
        InvalidValueError: It is not, with those that are.
    """
    usable = [key for key, kind in SOLVERS.items() if _is_usable(kind())]
    rule = f"one of {', '.join(usable)}"
    if name in SOLVERS and name not in usable:
        is_built = SOLVERS[name]().available()
        lack = "has no license here" if is_built else "is not in this build of Drake"
        rule = f"{rule}, for {name} {lack}"
    require(name in usable, "solver", name, rule)


def _is_usable(solver: SolverInterface) -> bool:
    return bool(solver.available() and solver.enabled())


def _options(name: str, tolerance: float, **clarabels: int) -> SolverOptions:
    options = SolverOptions()
    if name == "Clarabel":
        for key in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
            options.SetOption(ClarabelSolver.id(), key, tolerance)
        for key, value in clarabels.items():
            options.SetOption(ClarabelSolver.id(), key, value)
    if name == "OSQP":
        for key in ("eps_abs", "eps_rel"):
            options.SetOption(OsqpSolver.id(), key, tolerance)
    return options


_ours = local()


def _is_of_others(record: logging.LogRecord) -> bool:
    """Whether a message is none of a solver whose answer is verified here anyway."""
    return record.levelno >= logging.WARNING or not getattr(_ours, "solving", False)


logging.getLogger("drake").addFilter(_is_of_others)


class FixedProgram:
    """A MathematicalProgram of fixed size with its solver, its options and a lock.

    Every solve overwrites all coefficients, so that the answer depends on the data
    alone, not on earlier solves.

    Attributes:
        program: As it was stated last.
        variables: Its decision variables.
    """

    def __init__(
        self, num_variables: int, solver: SolverInterface, options: SolverOptions
    ) -> None:
        self.program = MathematicalProgram()
        self.variables = self.program.NewContinuousVariables(num_variables)
        self._solver, self._options, self._lock = solver, options, Lock()

    @classmethod
    @lru_cache(maxsize=512)
    def of_size(cls, *size: Any) -> Self:
        """Returns the program of this size (its constructor's arguments), kept."""
        return cls(*size)

    @cached_property
    def _start(self) -> Array:
        return np.zeros(self.program.num_vars())

    def _solve(self) -> MathematicalProgramResult:
        _ours.solving = True
        try:
            return self._solver.Solve(self.program, self._start, self._options)
        finally:
            _ours.solving = False

    def _point(self) -> Array | None:
        result = self._solve()
        return result.get_x_val() if result.is_success() else None

    def _add_rows(self, count: int) -> tuple[Any, Array]:
        """Adds rows without an effect; returns them and their lower bounds."""
        below, dense = np.full(count, -np.inf), np.ones((count, len(self.variables)))
        rows = self.program.AddLinearConstraint(dense, below, -below, self.variables)
        return rows.evaluator(), below


class LinearProgram(FixedProgram):
    """min c'v subject to ``A v <= b``, of n rows and m variables, by Clp."""

    def __init__(self, num_rows: int, num_variables: int) -> None:
        super().__init__(num_variables, ClpSolver(), SolverOptions())
        zero, v = np.zeros(num_variables), self.variables
        self._cost = self.program.AddLinearCost(zero, 0.0, v).evaluator()
        self._rows, self._below = self._add_rows(num_rows)

    def solve(self, cost: Array, A: Array, b: Array) -> Array | None:
        """Returns a minimiser; None without one."""
        with self._lock:
            self._cost.UpdateCoefficients(cost, 0.0)
            self._rows.UpdateCoefficients(A, self._below, b)
            return self._point()


class NearestPointProgram(FixedProgram):
    """The QP min 1/2 |v - reference|^2 subject to ``A v <= b``, by one of `SOLVERS`."""

    def __init__(
        self, num_rows: int, num_variables: int, solver: str = DEFAULT_SOLVER
    ) -> None:
        # On some QPs Clarabel cycles; on others it is done after a dozen.
        options = _options(solver, 1e-9, max_iter=30)
        super().__init__(num_variables, SOLVERS[solver](), options)
        self._identity, zero = np.eye(num_variables), np.zeros(num_variables)
        self._cost = self.program.AddQuadraticCost(
            self._identity, zero, self.variables, is_convex=True
        ).evaluator()
        self._rows, self._below = self._add_rows(num_rows)

    def state(self, A: Array, b: Array, reference: Array) -> None:
        """Overwrites the program's data."""
        constant = 0.5 * float(reference @ reference)
        self._cost.UpdateCoefficients(self._identity, -reference, constant, True)
        self._rows.UpdateCoefficients(A, self._below, b)

    def solve(self, A: Array, b: Array, reference: Array) -> Array | None:
        """Returns a minimiser; None without one."""
        with self._lock:
            self.state(A, b, reference)
            return self._point()


class EllipsoidProgram(FixedProgram):
    """max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i, L lower triangular (E48).

    The variables are L's entries, row by row, and then d. Of a box, whose first rows
    are v_j <= 1 and then -v_j <= 1, the rows of L have half the cones, and small ones:
    |L'e_j| <= t_j, t_j + d_j <= 1, t_j - d_j <= 1.

    Args:
        num_rows: n.
        num_inputs: m.
        tolerance: The solver's, where it has one.
        solver: One of `CONE_SOLVERS`; `DEFAULT_SOLVER` stands in for others.
        is_box: Whether the first 2 m rows are those of the box |v_j| <= 1.
    """

    def __init__(
        self,
        num_rows: int,
        num_inputs: int,
        tolerance: float,
        solver: str = DEFAULT_SOLVER,
        is_box: bool = False,
    ) -> None:
        m = num_inputs
        self._row, self._column = np.tril_indices(m)
        self._k, self._lower = len(self._row), m * self._row + self._column
        name = solver if solver in CONE_SOLVERS else DEFAULT_SOLVER
        # A box is of unit size, and of few inputs it is solved as exactly without.
        is_plain = is_box and m <= FEW_INPUTS
        spared = ("equilibrate_enable", "iterative_refinement_enable")
        options = _options(name, tolerance, **dict.fromkeys(spared * is_plain, 0))
        super().__init__(self._k + m, SOLVERS[name](), options)
        x = self.variables
        self._slot, self._entry = 1 + self._column, np.arange(self._k)
        # Drake pads the geometric mean with ones to a power of two.
        self._power = 2 ** math.ceil(math.log2(m))
        diagonal = x[: self._k][self._row == self._column]
        self.program.AddMaximizeGeometricMeanCost(diagonal, 1.0)
        self._box = self._add_box() if is_box else None
        self._first = 2 * m if is_box else 0
        dense, count = np.ones((m + 1, self._k + m)), num_rows - self._first
        cones = [
            self.program.AddLorentzConeConstraint(dense, np.ones(m + 1), x)
            for _ in range(count)
        ]
        self._cones = [cone.evaluator() for cone in cones]
        self._bindings = [_quickly_read(cone) for cone in cones]
        self._F = np.zeros((count, m + 1, self._k + m))
        self._g = np.zeros((count, m + 1))

    def _add_box(self) -> Any:
        """Adds the rows |v_j| <= 1; returns their binding."""
        L, d = self.variables[: self._k], self.variables[self._k :]
        m = len(d)
        reach = self.program.NewContinuousVariables(m, "t")
        for j in range(m):
            self.program.AddLorentzConeConstraint(
                np.concatenate([reach[[j]], L[self._row == j]])
            )
        reaches, centers = np.eye(m), np.eye(m)
        sides = np.block([[reaches, centers], [reaches, -centers]])
        below, ones = np.full(2 * m, -np.inf), np.ones(2 * m)
        rows = self.program.AddLinearConstraint(
            sides, below, ones, np.concatenate([reach, d])
        )
        return _quickly_read(rows)

    def state(self, A: Array, b: Array) -> None:
        """Overwrites the program's data."""
        A, b = A[self._first :], b[self._first :]
        self._F[:, 0, self._k :], self._g[:, 0] = -A, b
        self._F[:, self._slot, self._entry] = A[:, self._row]
        for cone, F, g in zip(self._cones, self._F, self._g, strict=True):
            cone.UpdateCoefficients(F, g)

    def solve(self, A: Array, b: Array) -> tuple[Array, Array, Array] | None:
        """Returns d, L and the multipliers d(log det L)/db; None without them."""
        m, k = A.shape[1], self._k
        with self._lock:
            self.state(A, b)
            result = self._solve()
        if not result.is_success():
            return None
        x = result.get_x_val()
        L = np.zeros((m, m))
        L.put(self._lower, x[:k])
        diagonal = L.diagonal().tolist()
        if not min(diagonal) > 0.0:
            return None
        duals = [] if self._box is None else -result.GetDualSolution(self._box)
        duals = [*duals, *(result.GetDualSolution(row)[0] for row in self._bindings)]
        # The cost's multipliers are those of (det L)^(1/P) = exp(log det L / P).
        mean = math.prod(diagonal) ** (1.0 / self._power)
        multipliers = np.maximum(duals, 0.0)
        return x[k : k + m], L, multipliers * (self._power / mean)


def _quickly_read(binding: Any) -> Any:
    """A binding, of the type whose dual solution is read many times faster."""
    return Binding[EvaluatorBase](binding.evaluator(), binding.variables())
