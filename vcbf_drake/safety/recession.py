"""Directions in which ``{u : A u <= b}`` never ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydrake.solvers import ClpSolver, MathematicalProgram

from vcbf_drake.checks import Array
from vcbf_drake.safety.unit_rows import UnitRows

# A ray may turn towards a row by this angle [rad] and still count as a ray.
_RAY_TOLERANCE = 1e-11
# The scale of the program's cost: the solver's tolerance on multipliers is absolute.
_SHARPNESS = 1e4


def recession_direction(A: ArrayLike) -> Array | None:
    """Returns a unit direction d with A d <= 0, or None when there is none.

    A set that has a point is unbounded exactly when its rows have such a direction.
    Found as a null vector of A, by max t subject to A d + t <= 0, |d_j| <= 1, or by
    min 1'A d subject to A d <= 0, |d_j| <= 1; verified to 1e-11 on rows of unit length.

    Args:
        A: The rows, shape (n, m).

    Raises:
        ValueError: Wrong shape or numbers that are not finite.
    """
    A = np.asarray(A, dtype=float)
    rows = UnitRows(A, np.zeros(len(A))).A
    n, m = rows.shape
    _, singular, axes = np.linalg.svd(rows, full_matrices=True)
    if n < m or singular[-1] <= _RAY_TOLERANCE * singular[0]:
        return np.asarray(axes[-1])
    direction = widening_direction(rows)
    if direction is not None:
        return direction
    direction = _ray(rows, np.zeros(n), rows.sum(axis=0))
    # Rows that should be met exactly, are, whatever the solver's tolerance.
    met = rows[np.abs(rows @ direction) < 1e-9]
    direction -= np.linalg.lstsq(met, met @ direction, rcond=1e-12)[0]
    length = np.linalg.norm(direction)
    if length < 0.5 or np.max(rows @ direction) > _RAY_TOLERANCE * length:
        return None
    return np.asarray(direction / length)


def widening_direction(A: Array) -> Array | None:
    """Returns d with A d < 0, along which a set holds balls of every size, or None.

    Args:
        A: Rows of unit length, shape (n, m).
    """
    direction = _ray(A, np.ones(len(A)), np.zeros(A.shape[1]))
    return direction if np.max(A @ direction) < -_RAY_TOLERANCE else None


def _ray(A: Array, margin: Array, cost: Array) -> Array:
    """Solves min cost'd - t, A d + margin t <= 0, |d_j| <= 1, for d of length 1 (or 0).

    Verifying it is left to the caller.
    """
    n, m = A.shape
    program = MathematicalProgram()
    d = program.NewContinuousVariables(m + 1)
    program.AddLinearConstraint(np.c_[A, margin], np.full(n, -np.inf), np.zeros(n), d)
    program.AddBoundingBoxConstraint(-1.0, 1.0, d)
    program.AddLinearCost(_SHARPNESS * np.append(cost, -1.0), 0.0, d)
    direction = np.asarray(ClpSolver().Solve(program).GetSolution(d))[:-1]
    length = np.linalg.norm(direction)
    return direction / length if length > 1e-6 else np.zeros(m)
