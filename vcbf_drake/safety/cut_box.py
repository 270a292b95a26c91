"""The largest ellipsoid of a box that one row cuts, in closed form but for one root.

Of the box |v_j| <= 1 and the row a v <= b, with |a| = 1 and every a_j > 0 (an input is
turned round where it is not), let r = |B a|. The conditions (E56) make B^-2 a diagonal
matrix but for a a', and then the half-widths s_j of the ellipsoid are (E74)

    s_j = min(1, r / a_j),   where   r + sum_j (min(r, a_j) - a_j) = b.

It touches the far side alone of the k inputs with a_j > r, and both of the others. With
rho_j = a_j / r and S_j = (1 - 4 w (1 - w) rho_j^2)^(1/2), the weight w of the row is
the root between 0 and 1 of a convex function, summed over the others,

    w - k (1 - w) - sum_j (1 - S_j) / 2 = 0,

the far sides have the weight w, or (1 + S_j) / 4 + w rho_j / 2, the near ones 0, or
(1 + S_j) / 4 - w rho_j / 2, and B^2 = Q (I - w u u') Q: the unit vector u is along Q a,
Q^2 diagonal, of 1 / (w rho_j^2), or 2 / (1 + S_j).
"""

from __future__ import annotations

import math

import numpy as np

from vcbf_drake.checks import Array


def cut_box(a: Array, b: float) -> tuple[Array, Array, Array]:
    """Returns the largest ellipsoid {F w + c : |w| <= 1}, to be certified.

    Args:
        a: The row, of unit length and without zeros, shape (m,).
        b: Its right-hand side, below 1 and above -sum |a_j|.

    Returns:
        c, shape (m,); F, shape (m, m); the multipliers of the rows v_j <= 1, -v_j <= 1
        and the row that cuts, shape (2 m + 1,).
    """
    row = a.tolist()
    size = [abs(each) for each in row]
    r = _reach(size, b)
    ratio = [each / r for each in size]
    w = _weight([rho for rho in ratio if rho <= 1.0], sum(rho > 1.0 for rho in ratio))
    center, diagonal, upper, lower = [], [], [], []
    for each, rho in zip(row, ratio, strict=True):
        if rho > 1.0:
            near, far, half_width, q = 0.0, w * rho, 1.0 / rho, 1.0 / (w * rho * rho)
        else:
            both, half_width = 0.25 + 0.25 * _root(w, rho), 1.0
            near, far, q = both - 0.5 * w * rho, both + 0.5 * w * rho, 0.5 / both
        center.append(math.copysign(1.0 - half_width, -each))
        diagonal.append(math.sqrt(q))
        upper.append(near if each > 0.0 else far)
        lower.append(far if each > 0.0 else near)
    Q = np.array(diagonal)
    u = Q * a
    shrunk = (1.0 - math.sqrt(1.0 - w)) / (u @ u) * np.outer(u, u)
    frame = Q[:, None] * (np.eye(len(a)) - shrunk)
    multipliers = np.maximum([*upper, *lower, w / r], 0.0)
    return np.array(center), frame, multipliers


def _reach(size: list[float], b: float) -> float:
    """Solves r + sum_j (min(r, a_j) - a_j) = b, from below."""
    far = size
    while True:
        r = (b + sum(far)) / (1 + len(far))
        further = [each for each in far if each > r]
        if len(further) == len(far):
            return r
        far = further


def _weight(ratio: list[float], k: int) -> float:
    """Newton's method for w, from above: the function is convex."""
    w = 1.0
    while True:
        value, slope = w - k * (1.0 - w), 1.0 + k
        for rho in ratio:
            S = _root(w, rho)
            value -= 0.5 * (1.0 - S)
            slope -= (1.0 - 2.0 * w) * rho * rho / (S or 1.0)
        if not (value > 1e-16 * slope > 0.0):
            return w
        w -= value / slope


def _root(w: float, rho: float) -> float:
    return math.sqrt(max(0.0, 1.0 - 4.0 * w * (1.0 - w) * rho * rho))
