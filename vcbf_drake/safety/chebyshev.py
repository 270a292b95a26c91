"""The largest ball in ``{u : A u <= b}``, or the point that leaves its rows least.

The solver only proposes. An answer is verified by arithmetic before it leaves: by the
slack of the ball's centre and by the dual bound on its radius.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from pydrake.solvers import ClpSolver, MathematicalProgram

from vcbf_drake.checks import Array
from vcbf_drake.errors import SolverError, UnboundedSetError
from vcbf_drake.safety.recession import widening_direction
from vcbf_drake.safety.unit_rows import UnitRows

# A point that leaves every row, measured as a distance, by no more than this counts as
# a point of the set [units of u].
FEASIBILITY_TOLERANCE = 1e-9
# Multipliers of rows of unit length, scaled to sum 1, balance when |A'y| is below this.
_BALANCE_TOLERANCE = 1e-12
# The scale of the program's cost: the solver's tolerance on multipliers is absolute.
_SHARPNESS = 1e4
# How far one linear program may move the centre, in units of its frame.
_REACH = 1e3


def chebyshev_ball(A: ArrayLike, b: ArrayLike) -> tuple[Array, float]:
    """Returns the centre (m,) and the signed radius of the largest ball in the set.

    max r subject to a_i u + |a_i| r <= b_i. The radius is the least distance from the
    centre to a row's boundary, negative when the set is empty: then no point violates
    all rows by less. Rows of zeros with b_i >= 0 say nothing and are dropped; with
    b_i < 0 they make the radius minus infinity.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        UnboundedSetError: The set holds balls of every size.
        SolverError: The linear program's answer could not be verified.
        ValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows(A, b)
    if rows.conflict is not None:
        return np.zeros(rows.A.shape[1]), -np.inf
    ball = largest_ball(rows)
    return ball.center, ball.radius


class Ball:
    """A centre for max r, A u + r <= b (unit rows), and multipliers for its dual.

    The dual: min y'b subject to y >= 0, A'y = 0, sum y = 1.
    """

    def __init__(self, rows: UnitRows, center: Array, multipliers: Array) -> None:
        self.center, self.multipliers = center, multipliers
        self.slack = rows.b - rows.A @ center
        self.radius = float(self.slack.min())
        is_balanced = np.linalg.norm(multipliers @ rows.A) <= _BALANCE_TOLERANCE
        self.bound = float(multipliers @ self.slack) if is_balanced else np.inf
        self.gap = self.bound - self.radius
        # Not by the slack of a centre that may be far away, and rounded as coarsely.
        proof = float(multipliers @ rows.b) if is_balanced else np.inf
        self.proves_emptiness = proof < -FEASIBILITY_TOLERANCE
        has_point = self.radius >= -FEASIBILITY_TOLERANCE
        self.is_decisive = has_point or self.proves_emptiness
        # Of the rows it touches, |b_i| = |a_i center + radius|.
        self.rounding = 1e-15 * float(np.linalg.norm(center) + abs(self.radius))
        self.is_largest = self.gap <= max(1e-12 * abs(self.radius), self.rounding)


def largest_ball(rows: UnitRows) -> Ball:
    """Solves the Chebyshev program; the answer's gap is closed to rounding.

    Raises:
        SolverError: No answer could be verified.
        UnboundedSetError: The set holds balls of every size.
    """
    gap = np.inf
    for ball in ever_larger_balls(rows):
        if ball.is_largest:
            return ball
        gap = ball.gap
    raise SolverError("no verified Chebyshev ball", *rows.given, f"gap {gap:.2g}")


def ever_larger_balls(rows: UnitRows) -> Iterator[Ball]:
    """Solves the Chebyshev program, again and again around its best centre.

    The solver's tolerances are absolute. So its answer is made exact on the rows it
    touches and, while the dual bound disagrees, sought again from there, in the
    coordinates in which the rows are about equally far.

    Args:
        rows: The rows.

    Raises:
        SolverError: The solver gave up.
        UnboundedSetError: The set holds balls of every size.
    """
    A, m = rows.A, rows.A.shape[1]
    if len(A) == 0:
        raise UnboundedSetError(*rows.given, np.eye(m)[0])
    resolution = float(np.max(np.abs(rows.b))) or 1.0
    frame, ball = resolution * np.eye(m), Ball(rows, np.zeros(m), np.zeros(len(A)))
    for _ in range(12):
        center, y, is_far = _chebyshev_program(rows, ball, frame, resolution)
        candidates = [Ball(rows, c, y) for c in (center, _touching(rows, center, y))]
        ball = min(candidates, key=lambda ball: ball.gap)
        yield ball
        resolution *= 1.0 if is_far else 1e-4
        frame = dikin_frame(A, ball.slack - ball.radius + resolution)


def _chebyshev_program(
    rows: UnitRows, ball: Ball, frame: Array, resolution: float
) -> tuple[Array, Array, bool]:
    """Returns the best centre near the ball's, its multipliers, and if it is far off.

    In coordinates z, u = center + frame z, and in rows of about equal weight.
    """
    excess = ball.slack - ball.radius
    weight = 1.0 / (excess + resolution)
    program = MathematicalProgram()
    z = program.NewContinuousVariables(len(ball.center) + 1)
    touching = program.AddLinearConstraint(
        np.c_[rows.A @ frame, np.full_like(excess, resolution)] * weight[:, None],
        np.full_like(excess, -np.inf),
        excess * weight,
        z,
    )
    program.AddBoundingBoxConstraint(-_REACH, _REACH, z)
    program.AddLinearCost(np.append(np.zeros(len(ball.center)), -_SHARPNESS), 0.0, z)
    result = ClpSolver().Solve(program)
    move = np.asarray(result.GetSolution(z))
    is_far = bool(np.max(np.abs(move)) > 0.9 * _REACH)
    if is_far or not result.is_success():
        direction = widening_direction(rows.A)
        if direction is not None:
            raise UnboundedSetError(*rows.given, direction)
        if not result.is_success():
            status = result.get_solution_result()
            raise SolverError("no Chebyshev ball", *rows.given, str(status))
    y = np.maximum(-np.asarray(result.GetDualSolution(touching)), 0.0) * weight
    return ball.center + frame @ move[:-1], balanced(rows.A, y), is_far


def dikin_frame(A: Array, distance: Array) -> Array:
    """Returns (sum a_i a_i' / distance_i^2)^(-1/2), shape (m, m).

    In coordinates z, u = center + frame z, rows that far from the centre hold the unit
    ball, and rows that matter are about equally far.
    """
    _, singular, axes = np.linalg.svd(A / distance[:, None], full_matrices=False)
    return (axes.T / np.maximum(singular, 1e-12 * singular[0])) @ axes


def balanced(A: Array, y: Array) -> Array:
    """Restores A'y = 0, sum y = 1 on the rows that carry y (few and independent).

    Args:
        A: Rows of unit length, shape (n, m).
        y: Multipliers that all but balance, shape (n,).
    """
    y = y / max(float(y.sum()), 1e-300)
    support = y > 1e-13
    columns = np.c_[A[support], np.ones(support.sum())].T
    target = np.append(np.zeros(A.shape[1]), 1.0)
    error = target - columns @ y[support]
    balanced = np.zeros_like(y)
    balanced[support] = y[support] + np.linalg.lstsq(columns, error, rcond=1e-12)[0]
    return np.maximum(balanced, 0.0)


def _touching(rows: UnitRows, center: Array, y: Array) -> Array:
    """Moves the centre, by little, so that the rows that carry y are equally far."""
    A, b = rows.A[y > 0.0], rows.b[y > 0.0]
    move = np.linalg.lstsq(np.c_[A, np.ones(len(b))], b - A @ center, rcond=1e-12)[0]
    return np.asarray(center + move[:-1])
