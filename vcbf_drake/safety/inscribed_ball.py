"""The largest ball in a polytope at every tick: signed radius and its derivative."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math
from threading import Lock

import numpy as np
from pydrake.solvers import ClpSolver, MathematicalProgram

from vcbf_drake.checks import Array
from vcbf_drake.safety.chebyshev import Ball, largest_ball
from vcbf_drake.safety.unit_rows import UnitRows

# Verified to this, a ball of a set of about unit size is exact enough for a tick.
_ACCEPTED_GAP = 1e-9


@dataclass(frozen=True)
class InscribedBall:
    """The ball max r, a_i c + |a_i| r <= b_i, and its derivative (E57).

    Attributes:
        radius: r, negative when the set is empty; minus infinity when a row of zeros
            excludes every point.
        multipliers: mu_i = dr/db_i of (E57), at least zero, shape (n,).
        contacts: p_i = c + r a_i / |a_i|, shape (n, m).
    """

    radius: float
    multipliers: Array
    contacts: Array


def inscribed_ball(A: Array, b: Array) -> InscribedBall:
    """Returns the largest ball inside ``{v : A v <= b}``, or the least bad one.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        UnboundedSetError: The set holds balls of every size.
        SolverError: The linear program's answer could not be verified.
    """
    rows = UnitRows(A, b)
    multipliers, contacts = np.zeros(len(b)), np.zeros(A.shape)
    if rows.conflict is not None:
        return InscribedBall(-math.inf, multipliers, contacts)
    ball = _program(*rows.A.shape).ball(rows) or largest_ball(rows)
    multipliers[rows.index] = ball.multipliers / rows.length
    contacts[rows.index] = ball.center + ball.radius * rows.A
    return InscribedBall(ball.radius, multipliers, contacts)


class _Program:
    """The linear program of fixed size; every solve overwrites it all."""

    def __init__(self, num_rows: int, num_inputs: int) -> None:
        self._lock = Lock()
        self._program = MathematicalProgram()
        z = self._program.NewContinuousVariables(num_inputs + 1)
        self._program.AddLinearCost(np.append(np.zeros(num_inputs), -1.0), 0.0, z)
        self._below = np.full(num_rows, -np.inf)
        self._rows = self._program.AddLinearConstraint(
            np.ones((num_rows, num_inputs + 1)), self._below, self._below, z
        )

    def ball(self, rows: UnitRows) -> Ball | None:
        """The verified ball, or None."""
        lhs = np.column_stack([rows.A, np.ones(len(rows.b))])
        with self._lock:
            self._rows.evaluator().UpdateCoefficients(lhs, self._below, rows.b)
            result = ClpSolver().Solve(self._program)
            if not result.is_success():
                return None
            point, dual = result.get_x_val(), result.GetDualSolution(self._rows)
        active = np.flatnonzero(np.asarray(dual) < -1e-9)
        try:
            # Exact on the rows that carry the multipliers: a vertex of the program.
            vertex = np.linalg.lstsq(lhs[active], rows.b[active], rcond=None)[0]
            target = np.append(np.zeros(len(point) - 1), 1.0)
            weights = np.linalg.lstsq(lhs[active].T, target, rcond=None)[0]
        except np.linalg.LinAlgError:
            return None
        multipliers = np.zeros(len(rows.b))
        multipliers[active] = np.maximum(weights, 0.0)
        for center in (point[:-1], vertex[:-1]):
            ball = Ball(rows, np.asarray(center), multipliers)
            if abs(ball.gap) <= _ACCEPTED_GAP * (1.0 + abs(ball.radius)):
                return ball
        return None


@lru_cache(maxsize=256)
def _program(num_rows: int, num_inputs: int) -> _Program:
    return _Program(num_rows, num_inputs)
