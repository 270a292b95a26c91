"""The answers: slow, plain methods that share no code with those they judge."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from pydrake.geometry.optimization import HPolyhedron

from tests.benchmarks.problem import (
    NUM_INPUTS,
    barrier_rows,
    polytope,
    volume_row,
)
from vcbf_drake.checks import Array

_THINNEST = 1e-6  # Sets with a smaller inradius count as empty.
_LAST_BARRIER = 1e-10  # Weight mu of the last logarithmic barrier.
# A basis of the symmetric matrices, shape (6, 3, 3).
_BASIS = np.array(
    [
        np.outer(i, j) + np.outer(j, i) * (k != m)
        for k, i in enumerate(np.eye(NUM_INPUTS))
        for m, j in enumerate(np.eye(NUM_INPUTS))
        if k <= m
    ]
)


def nearest_input(A: Array, b: Array, reference: Array) -> Array | None:
    """Returns the point of {u : A u <= b} nearest to the reference, or None if empty.

    By trying every set of at most m active rows: the projection onto them is the answer
    if it is feasible and its multipliers are not negative.
    """
    scale = 1.0 + np.abs(b)
    best, least = None, np.inf
    for size in range(NUM_INPUTS + 1):
        for chosen in combinations(range(len(b)), size):
            rows, bounds = A[list(chosen)], b[list(chosen)]
            if (
                size and np.linalg.matrix_rank(rows) < size
            ):  # NumPy 2.0: not of no rows.
                continue
            u = reference - np.linalg.pinv(rows) @ (rows @ reference - bounds)
            if (A @ u <= b + 1e-9 * scale).all():
                distance = float(np.linalg.norm(u - reference))
                if distance < least:
                    best, least = u, distance
    return best


def ellipsoid_gradient(state: Array) -> tuple[float, Array] | None:
    """Returns det B of the largest ellipsoid of inputs and its gradient by the state.

    By Newton's method, on log det B + mu sum_i log s_i, s_i = b_i - a_i c - |B a_i|,
    for ever smaller mu, and then on the optimality conditions of the rows that touch.
    None if the set is empty.
    """
    A, b = polytope(state)
    theta = _start(A, b)
    if theta is None:
        return None
    for barrier in np.geomspace(1.0, _LAST_BARRIER, 16):
        theta = _climb(A, b, theta, float(barrier))
    theta, multipliers = _touch(A, b, theta, _LAST_BARRIER)
    shape, center = _shape(theta), theta[6:]
    reach = A @ shape
    contact = center + reach @ shape / np.linalg.norm(reach, axis=1)[:, None]
    det = float(np.linalg.det(shape))
    slopes = [_slope(state, move, multipliers[6:], contact[6:]) for move in np.eye(6)]
    return det, det * np.array(slopes)


def volume_filtered_input(state: Array, reference: Array) -> Array | None:
    """Returns the input of (E54) with hard rows, or None if there is none."""
    found = ellipsoid_gradient(state)
    if found is None:
        return None
    a, c = volume_row(state, *found)
    A, b = polytope(state)
    return nearest_input(np.vstack([A, a]), np.append(b, c), reference)


def _slope(state: Array, move: Array, multipliers: Array, contact: Array) -> float:
    """The derivative of sum_i lambda_i (b_i - a_i p_i), by a complex step."""
    A, b = barrier_rows(state + 1e-30j * move)
    return float(np.imag(multipliers @ (b - (A * contact).sum(axis=1))) / 1e-30)


def _start(A: Array, b: Array) -> Array | None:
    try:
        center = HPolyhedron(A, b).ChebyshevCenter()
    except RuntimeError:
        return None
    radius = float(np.min((b - A @ center) / np.linalg.norm(A, axis=1)))
    if radius < _THINNEST:
        return None
    shape = 0.5 * radius * np.eye(NUM_INPUTS)
    return np.concatenate([shape[np.triu_indices(NUM_INPUTS)], center])


def _shape(theta: Array) -> Array:
    return np.tensordot(theta[:6], _BASIS, 1)


def _value(A: Array, b: Array, theta: Array, barrier: float) -> float:
    """The function to be made large; -inf outside its domain."""
    shape = _shape(theta)
    slack = b - A @ theta[6:] - np.linalg.norm(A @ shape, axis=1)
    if np.linalg.eigvalsh(shape)[0] <= 0.0 or slack.min() <= 0.0:
        return -np.inf
    return float(np.linalg.slogdet(shape)[1] + barrier * np.log(slack).sum())


def _climb(A: Array, b: Array, theta: Array, barrier: float) -> Array:
    """Newton's method with a line search, from inside."""
    value = _value(A, b, theta, barrier)
    for _ in range(50):
        gradient, hessian, slack, slopes, curvatures = _derivatives(A, b, theta)
        weights = barrier / slack
        gradient = gradient + weights @ slopes
        hessian = hessian + np.tensordot(weights, curvatures, 1)
        hessian -= (slopes.T * (weights / slack)) @ slopes
        step, size = np.linalg.solve(hessian, -gradient), 1.0
        while (new := _value(A, b, theta + size * step, barrier)) <= value:
            size *= 0.5
            if size < 1e-6:
                return theta
        theta, value = theta + size * step, new
    return theta


def _touch(A: Array, b: Array, theta: Array, barrier: float) -> tuple[Array, Array]:
    """Newton's method on the optimality conditions; returns theta and multipliers."""
    *_, slack, _, _ = _derivatives(A, b, theta)
    on = np.flatnonzero(slack < np.sqrt(barrier))
    multipliers = np.zeros(len(b))
    multipliers[on] = barrier / slack[on]
    for _ in range(6):
        gradient, hessian, slack, slopes, curvatures = _derivatives(A, b, theta)
        corner = np.zeros((len(on), len(on)))
        curved = hessian + np.tensordot(multipliers, curvatures, 1)
        matrix = np.block([[curved, slopes[on].T], [slopes[on], corner]])
        right = np.append(gradient + multipliers @ slopes, slack[on])
        step = np.linalg.lstsq(matrix, -right, rcond=1e-13)[0]
        theta = theta + step[:9]
        multipliers[on] += step[9:]
    return theta, multipliers


def _derivatives(
    A: Array, b: Array, theta: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Returns what Newton's methods are made of.

    The gradient (9,) and Hessian (9, 9) of log det B, the slacks s (n,), their
    gradients (n, 9) and Hessians (n, 9, 9).
    """
    shape = _shape(theta)
    turned = np.linalg.inv(shape) @ _BASIS
    gradient = np.append(np.trace(turned, axis1=1, axis2=2), np.zeros(3))
    hessian = np.zeros((9, 9))
    hessian[:6, :6] = -np.einsum("kij,lji->kl", turned, turned)
    parts = np.einsum("kij,nj->nki", _BASIS, A)  # d(B a) / d(theta), (n, 6, 3)
    reach = A @ shape
    length = np.linalg.norm(reach, axis=1)
    along = np.einsum("nki,ni->nk", parts, reach / length[:, None])
    curvatures = np.zeros((len(b), 9, 9))
    curvatures[:, :6, :6] = (
        along[:, :, None] * along[:, None] - parts @ parts.transpose(0, 2, 1)
    ) / length[:, None, None]
    slack = b - A @ theta[6:] - length
    return gradient, hessian, slack, -np.hstack([along, A]), curvatures
