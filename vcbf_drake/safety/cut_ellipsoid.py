r"""An ellipsoid cut by rows: where Newton's method starts without a solver.

In the coordinates in which the ellipsoid is the unit ball, the largest ellipsoid of the
part of the ball with n'z <= beta, |n| = 1, is one of revolution around n. With half-
length tau along n and sigma across, its centre lies at beta - tau along n, and it stays
inside the ball when (beta - tau)^2 = (1 - sigma^2) (sigma^2 - tau^2) / sigma^2. Of
these, tau sigma^(m - 1) is largest for

    sigma^2 = tau z,    tau = (1 - beta^2) z / (z^2 + 1 - 2 beta z),
    z = (sqrt((m - 1)^2 beta^2 + 4 m) - (m - 1) beta) / 2.

What is cut so, row by row, has 0.8 to 0.95 of the largest ellipsoid's volume where two
rows cut a box and 0.4 to 0.85 where eight do. How it should grow from there, by I to
I + D and by d, tells which rows will touch: to first order they are those with a
positive weight in

    max  tr D - |D|^2 / 2 - |d|^2 / 2   subject to   n_i'D n_i + n_i'd <= e_i,

whose weights satisfy sum_j ((n_i'n_j)^2 + n_i'n_j) w_j = 1 - e_i where they are
positive.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from vcbf_drake.checks import Array

# Past this the cut ball says little of what the rows leave: they face each other.
_DEEPEST = -0.7
# A row that cuts off less than this of the unit ball's radius is left to Newton.
_SHALLOWEST = 1e-3
# A row further outside the unit ball than this does not count among its neighbours.
_FARTHEST = 0.5


def cut_ellipsoid(
    A: Array, b: Array, center: Array, frame: Array
) -> tuple[Array, Array] | None:
    """Cuts {center + frame z : |z| <= 1} until it meets every row; see the module.

    Args:
        A: The rows, shape (n, m).
        b: Their right-hand sides, shape (n,).
        center: Inside every row or not, shape (m,).
        frame: Shape (m, m).

    Returns:
        The center (m,) and frame (m, m) of an ellipsoid that meets the rows, nearly;
        None where a row leaves less than 15 % of an ellipsoid's width.
    """
    for _ in range(2 * len(b)):
        normals = A @ frame
        length = np.sqrt(np.vecdot(normals, normals))
        reach = (b - A @ center) / length
        deepest = int(reach.argmin())
        beta = float(reach[deepest])
        if beta >= 1.0 - _SHALLOWEST:
            break
        if not beta >= _DEEPEST:
            return None
        n = normals[deepest] / length[deepest]
        shift, tau, sigma = _cut_ball(beta, len(n))
        axis = frame @ n
        center = center + shift * axis
        frame = sigma * frame + (tau - sigma) * axis[:, None] * n
    return center, frame


def _cut_ball(beta: float, m: int) -> tuple[float, float, float]:
    """Returns centre, tau and sigma of the unit ball cut at beta."""
    lean = (m - 1) * beta
    z = 0.5 * (math.sqrt(lean * lean + 4.0 * m) - lean)
    tau = (1.0 - beta * beta) * z / (z * z + 1.0 - 2.0 * beta * z)
    return beta - tau, tau, math.sqrt(tau * z)


def estimated_weights(n: Array, e: Array) -> Array:
    """Returns the rows' weights in the module's program, or close to them, (k,).

    Rows with negative weights are left out, the worst first, until there are none.

    Args:
        n: The rows' unit normals where the ellipsoid is the unit ball, shape (k, m).
        e: How far outside the ball they lie, shape (k,).
    """
    cosine = n @ n.T
    matrix = cosine * cosine + cosine
    matrix.flat[:: len(e) + 1] += 1e-9  # Rows may be given twice.
    on = (e < _FARTHEST).nonzero()[0]
    weights = np.zeros(len(e))
    while len(on) > 0:
        w = np.linalg.solve(matrix[on[:, None], on], 1.0 - e[on])
        least = float(w.min())
        if least >= 0.0:
            weights[on] = w
            break
        on = on[w > 0.7 * least]
    return weights
