"""The polytope ``{u : A u <= b}``: its Chebyshev ball, its emptiness, its rays.

Every answer is verified by arithmetic before it leaves: a ball by the slack of its
centre and by the dual bound on its radius, emptiness by Farkas multipliers, a ray by
its products with the rows. The solver only proposes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.solvers import ClpSolver, MathematicalProgram

from vcbf_drake.errors import Array, SolverError, UnboundedSetError
from vcbf_drake.safety.active_set import nearest_by_active_set

# A point that leaves every row, measured as a distance, by no more than this counts as
# a point of the set [units of u].
_FEASIBILITY_TOLERANCE = 1e-9
# Multipliers of rows of unit length, scaled to sum 1, balance when |A'y| is below this.
_BALANCE_TOLERANCE = 1e-12
# A row further away than this holds everywhere, or nowhere [units of u].
FARTHEST = 1e20
# The scale of the program's cost: the solver's tolerance on multipliers is absolute.
_SHARPNESS = 1e4
# How far one linear program may move the centre, in units of its frame.
_REACH = 1e3
# A ray may turn towards a row by this angle [rad] and still count as a ray.
_RAY_TOLERANCE = 1e-11


@dataclass(frozen=True)
class Emptiness:
    """Farkas' proof that no point satisfies ``A u <= b``, on an irreducible conflict.

    y >= 0 with y'A = 0 and y'b < 0: were u in the set, 0 = y'A u <= y'b < 0. Dropping
    any one of the rows in conflict leaves rows that some point satisfies.

    Attributes:
        multipliers: y, in the units of the rows as given, shape (n,).
        rows: Indices of the rows in conflict (y > 0), at most m + 1 of them, ascending.
        inradius: The signed Chebyshev radius, negative [units of u]; minus infinity
            when a row without coefficients (0 u <= b < 0) is the conflict.
    """

    multipliers: Array
    rows: NDArray[np.intp]
    inradius: float


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


def emptiness_certificate(A: ArrayLike, b: ArrayLike) -> Emptiness | None:
    """Returns a proof that the set is empty, or None when a point satisfies its rows.

    A point that violates rows by at most 1e-9, measured as a distance, counts as a
    point of the set: flat sets are not empty, and a gap narrower than 2e-9 is no proof.
    The proof is verified on rows of unit length and multipliers of sum 1:
    |A'y| <= 1e-12, and y'b = inradius < -1e-9.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Raises:
        SolverError: Neither a point nor a proof could be verified.
        ValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows(A, b)
    multipliers = np.zeros(len(rows.given[1]))
    if rows.conflict is not None:
        multipliers[rows.conflict] = 1.0
        return Emptiness(multipliers, np.array([rows.conflict]), -np.inf)
    try:
        ball = _decisive_ball(rows)
    except UnboundedSetError:
        return None
    if ball.radius >= -_FEASIBILITY_TOLERANCE:
        return None
    multipliers[rows.index] = _irreducible(rows, ball) / rows.length
    return Emptiness(multipliers, np.flatnonzero(multipliers), ball.radius)


def _irreducible(rows: UnitRows, ball: Ball) -> Array:
    """Drops rows from the conflict, the lightest first, that the proof can spare."""
    y = ball.multipliers
    for row in np.argsort(y, kind="stable"):
        if y[row] > 0.0:
            lighter = y.copy()
            lighter[row] = 0.0
            candidate = Ball(rows, ball.center, _balanced(rows.A, lighter))
            if candidate.proves_emptiness:
                y = candidate.multipliers
    return y


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
    direction = _widening_direction(rows)
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


def _widening_direction(A: Array) -> Array | None:
    """Returns d with A d < 0, along which a set holds balls of every size, or None."""
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


class UnitRows:
    """Rows scaled to unit length, rows of zeros taken out.

    Attributes:
        A, b: The remaining rows, of unit length, shapes (k, m) and (k,).
        length: The length |a_i| each of them had, shape (k,).
        index: Where each of them stood among the rows as given, shape (k,).
        given: A and b as given, shapes (n, m) and (n,).
        conflict: Index of a row 0 u <= b_i < 0, or as good as that, or None.
    """

    def __init__(self, A: ArrayLike, b: ArrayLike) -> None:
        self.given = A, b = checked_rows(A, b)
        # By the largest entry first: squares of tiny entries would vanish.
        largest = np.abs(A).max(axis=1)
        scale = np.where(largest > 0.0, largest, 1.0)
        length = largest * np.linalg.norm(A / scale[:, None], axis=1)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            distance = b / length
        # A row so short, for its right-hand side, has no direction to speak of.
        blank = ~(np.abs(distance) < FARTHEST)
        conflicts = np.flatnonzero(blank & (b < 0.0))
        self.conflict = int(conflicts[0]) if len(conflicts) else None
        self.index = np.flatnonzero(~blank)
        self.length = length[self.index]
        self.A = A[self.index] / self.length[:, None]
        self.b = distance[self.index]


def checked_rows(A: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    """Returns A (n, m) and b (n,) as arrays of finite floats.

    Raises:
        ValueError: Naming the array, its shape and the shape or value allowed.
    """
    A, b = np.asarray(A, dtype=float), np.asarray(b, dtype=float)
    if A.ndim != 2 or A.shape[1] == 0:
        raise ValueError(f"A has shape {A.shape}, must be (n, m) with m >= 1")
    if b.shape != A.shape[:1]:
        raise ValueError(f"b has shape {b.shape}, must be ({len(A)},) like A's rows")
    for name, array in (("A", A), ("b", b)):
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            index = tuple(wrong[0].tolist())
            raise ValueError(f"{name}{list(index)} is {array[index]}, must be finite")
    return A, b


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
        self.proves_emptiness = proof < -_FEASIBILITY_TOLERANCE
        has_point = self.radius >= -_FEASIBILITY_TOLERANCE
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
    for ball in _ever_larger_balls(rows):
        if ball.is_largest:
            return ball
        gap = ball.gap
    raise SolverError("no verified Chebyshev ball", *rows.given, f"gap {gap:.2g}")


def _decisive_ball(rows: UnitRows) -> Ball:
    """Returns the largest ball or, failing that, one that tells if there is a point.

    Between rows that are opposite but for 1e-11 the largest ball may lie too far away
    to be found exactly, while every ball's multipliers prove the set empty.
    """
    decisive = None
    for ball in _ever_larger_balls(rows):
        if ball.is_largest and ball.is_decisive:
            return ball
        y = _balanced_by_others(rows.A, ball.multipliers)
        proof = Ball(rows, ball.center, y / y.sum()) if y.any() else ball
        if proof.is_decisive:
            decisive = decisive or proof
    if decisive is None:
        raise SolverError("neither a point nor a proof of emptiness", *rows.given)
    return decisive


def _ever_larger_balls(rows: UnitRows) -> Iterator[Ball]:
    """Solves the Chebyshev program, again and again around its best centre.

    The solver's tolerances are absolute. So its answer is made exact on the rows it
    touches and, while the dual bound disagrees, sought again from there, in the
    coordinates in which the rows are about equally far.
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
        direction = _widening_direction(rows.A)
        if direction is not None:
            raise UnboundedSetError(*rows.given, direction)
        if not result.is_success():
            status = result.get_solution_result()
            raise SolverError("no Chebyshev ball", *rows.given, str(status))
    y = np.maximum(-np.asarray(result.GetDualSolution(touching)), 0.0) * weight
    return ball.center + frame @ move[:-1], _balanced(rows.A, y), is_far


def dikin_frame(A: Array, distance: Array) -> Array:
    """Returns (sum a_i a_i' / distance_i^2)^(-1/2), shape (m, m).

    In coordinates z, u = center + frame z, rows that far from the centre hold the unit
    ball, and rows that matter are about equally far.
    """
    _, singular, axes = np.linalg.svd(A / distance[:, None], full_matrices=False)
    return (axes.T / np.maximum(singular, 1e-12 * singular[0])) @ axes


def _balanced(A: Array, y: Array) -> Array:
    """Restores A'y = 0, sum y = 1 on the rows that carry y (few and independent)."""
    y = y / max(float(y.sum()), 1e-300)
    support = y > 1e-13
    columns = np.c_[A[support], np.ones(support.sum())].T
    target = np.append(np.zeros(A.shape[1]), 1.0)
    error = target - columns @ y[support]
    balanced = np.zeros_like(y)
    balanced[support] = y[support] + np.linalg.lstsq(columns, error, rcond=1e-12)[0]
    return np.maximum(balanced, 0.0)


def _balanced_by_others(A: Array, y: Array) -> Array:
    """Restores A'y = 0 on all rows, for rows that are nearly opposite."""
    imbalance = y @ A
    size = float(np.linalg.norm(imbalance)) or 1.0
    solution = nearest_by_active_set(A, np.zeros(len(A)), -imbalance / size)
    return y + size * solution.multipliers


def _touching(rows: UnitRows, center: Array, y: Array) -> Array:
    """Moves the centre, by little, so that the rows that carry y are equally far."""
    A, b = rows.A[y > 0.0], rows.b[y > 0.0]
    move = np.linalg.lstsq(np.c_[A, np.ones(len(b))], b - A @ center, rcond=1e-12)[0]
    return np.asarray(center + move[:-1])
