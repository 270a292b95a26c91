"""Other people's routes, each written the way its documentation shows.

Packages are imported when a route is made, so that those that are missing cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
import os
from typing import Any, TypeAlias

import numpy as np
from pydrake.geometry.optimization import HPolyhedron
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from tests.benchmarks.problem import (
    A_PLANT,
    B_PLANT,
    BOX_A,
    BOX_B,
    CENTERS,
    LIMIT,
    NUM_INPUTS,
    NUM_STATES,
    RADII,
    RATES,
    barrier_rows,
    polytope,
    volume_row,
)
from vcbf_drake.checks import Array

# From the state and the controller's input to the input, or None for "infeasible".
Filter: TypeAlias = Callable[[Array, Array], Array | None]
# From the state to det B and its gradient by the state, or None for "empty".
VolumeGradient: TypeAlias = Callable[[Array], tuple[float, Array] | None]
# From A, b and a point to the nearest point of {u : A u <= b}, or None for "empty".
Projection: TypeAlias = Callable[[Array, Array, Array], Array | None]

_STEP = 1e-4  # Of the differences, where their error is least.


def filter_with(project: Projection) -> Filter:
    """Returns the plain CBF-QP of a solver."""

    def tick(state: Array, reference: Array) -> Array | None:
        return project(*polytope(state), reference)

    return tick


def volume_filter_with(gradient: VolumeGradient, project: Projection) -> Filter:
    """Returns the VCBF-QP of a gradient and a solver."""

    def tick(state: Array, reference: Array) -> Array | None:
        found = gradient(state)
        if found is None:
            return None
        a, c = volume_row(state, *found)
        A, b = polytope(state)
        return project(np.vstack([A, a]), np.append(b, c), reference)

    return tick


# QPs ---------------------------------------------------------------------------------


def drake() -> Projection:
    """A MathematicalProgram built and solved at every tick, by Clarabel."""
    solver = ClarabelSolver()

    def project(A: Array, b: Array, point: Array) -> Array | None:
        program = MathematicalProgram()
        u = program.NewContinuousVariables(NUM_INPUTS)
        program.AddQuadraticErrorCost(np.eye(NUM_INPUTS), point, u)
        program.AddLinearConstraint(A, np.full(len(b), -np.inf), b, u)
        result = solver.Solve(program)
        return result.GetSolution(u) if result.is_success() else None

    return project


def quadprog() -> Projection:
    """Goldfarb and Idnani's dual method, called directly."""
    import quadprog as package

    def project(A: Array, b: Array, point: Array) -> Array | None:
        try:
            return package.solve_qp(np.eye(NUM_INPUTS), point, -A.T, -b)[0]
        except ValueError:  # "constraints are inconsistent, no solution"
            return None

    return project


def cvxpy() -> Projection:
    """A parametrised problem, compiled once for each number of rows, by Clarabel."""
    import cvxpy as cp

    @lru_cache
    def problem_of(num_rows: int) -> tuple[Any, ...]:
        u, point = cp.Variable(NUM_INPUTS), cp.Parameter(NUM_INPUTS)
        A, b = cp.Parameter((num_rows, NUM_INPUTS)), cp.Parameter(num_rows)
        cost = cp.Minimize(cp.sum_squares(u - point))
        return cp.Problem(cost, [A @ u <= b]), u, (A, b, point)

    def project(A: Array, b: Array, point: Array) -> Array | None:
        problem, u, parameters = problem_of(len(b))
        for parameter, value in zip(parameters, (A, b, point), strict=True):
            parameter.value = value
        problem.solve(solver=cp.CLARABEL)
        return u.value if problem.status == cp.OPTIMAL else None

    return project


# Ellipsoid and gradient --------------------------------------------------------------


def drake_differences() -> VolumeGradient:
    """Central differences of HPolyhedron's largest inscribed ellipsoid."""

    def det(state: Array) -> float:
        ellipsoid = HPolyhedron(*polytope(state)).MaximumVolumeInscribedEllipsoid()
        return 1.0 / abs(np.linalg.det(ellipsoid.A()))

    def evaluate(state: Array) -> tuple[float, Array] | None:
        try:
            slopes = [
                (det(state + move) - det(state - move)) / (2.0 * _STEP)
                for move in _STEP * np.eye(NUM_STATES)
            ]
            return det(state), np.array(slopes)
        except RuntimeError:  # Drake's word for an empty set.
            return None

    return evaluate


def cvxpylayers() -> VolumeGradient:
    """The cone program as a differentiable layer, its gradient by JAX."""
    jax = _jax()
    import cvxpy as cp
    from cvxpylayers.jax import CvxpyLayer
    from diffcp import SolverError

    jnp = jax.numpy
    num_rows = len(BOX_B) + len(RADII)
    B = cp.Variable((NUM_INPUTS, NUM_INPUTS), PSD=True)
    center = cp.Variable(NUM_INPUTS)
    A, b = cp.Parameter((num_rows, NUM_INPUTS)), cp.Parameter(num_rows)
    inside = [cp.norm(B @ A[i]) + A[i] @ center <= b[i] for i in range(num_rows)]
    problem = cp.Problem(cp.Maximize(cp.log_det(B)), inside)
    layer = CvxpyLayer(problem, parameters=[A, b], variables=[B, center])

    def det(state: Any) -> Any:
        rows, bounds = barrier_rows(state)
        all_rows = jnp.concatenate([jnp.asarray(BOX_A), rows])
        shape, _ = layer(all_rows, jnp.concatenate([jnp.asarray(BOX_B), bounds]))
        return jnp.linalg.det(shape)

    det_and_slope = jax.value_and_grad(det)

    def evaluate(state: Array) -> tuple[float, Array] | None:
        try:
            value, slope = det_and_slope(jnp.asarray(state))
            return float(value), np.asarray(slope)
        except SolverError:
            return None

    return evaluate


# Whole filters -----------------------------------------------------------------------


def cbfpy() -> Filter:
    """CBFpy, strict; everything by JAX, compiled."""
    jax = _jax()
    from cbfpy import CBF, CBFConfig

    jnp = jax.numpy

    class PointMass(CBFConfig):
        def __init__(self) -> None:
            limit = LIMIT * np.ones(NUM_INPUTS)
            super().__init__(
                NUM_STATES, NUM_INPUTS, u_min=-limit, u_max=limit, relax_qp=False
            )

        def f(self, z: Any) -> Any:
            return jnp.asarray(A_PLANT) @ z

        def g(self, z: Any) -> Any:
            return jnp.asarray(B_PLANT)

        def h_2(self, z: Any) -> Any:
            offset = z[:3] - CENTERS
            return (offset * offset).sum(axis=1) - RADII**2

        def alpha_2(self, h: Any) -> Any:
            return RATES[1] * h

        def alpha(self, h: Any) -> Any:
            return RATES[0] * h

    chosen = CBF.from_config(PointMass())

    def tick(state: Array, reference: Array) -> Array | None:
        u = np.asarray(chosen.safety_filter(state, reference))
        return u if np.isfinite(u).all() else None

    return tick


def _jax() -> Any:
    """JAX as CBFpy's documentation asks for it on a CPU: float64, one thread."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("JAX_ENABLE_X64", "1")
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import jax
    import jax.numpy

    jax.config.update(
        "jax_enable_x64", True
    )  # Should somebody have imported it before.
    return jax
