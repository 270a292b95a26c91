r"""The largest ellipsoid of a box cut by one row, in closed form but for one number.

The box is |v_j| <= 1 and the row a'v <= b, all a_j > 0 (else mirror the axis). The
optimality conditions (E42) leave the shape B^2 = (diag(delta) + theta a a')^-1, with
theta the row's multiplier over its reach s = |B a| and delta_j the sum of those of
v_j <= 1 and v_j >= -1 over B's reach sigma_j = |B e_j| along the axis. The row pushes
the ellipsoid against every v_j >= -1, so that the centre is c_j = sigma_j - 1, and
where v_j <= 1 does not touch, the multipliers' balance asks for a_j sigma_j = s. So

    a_j sigma_j = p_j = min(a_j, s),      s + sum_j p_j = b + sum_j a_j,

which is piecewise linear in s. In y_j = kappa a_j^2 / delta_j, with their sum pi and
kappa = pi (1 - pi) / s^2, the reaches sigma_j and s say

    y_j (1 - y_j) = kappa p_j^2,          sum_j y_j = pi,

one equation for pi, and then B^2 is a multinomial covariance in coordinates a_j v_j,

    B^2_ij = (y_i [i = j] - y_i y_j) / (kappa a_i a_j).

With t = (1 - sqrt(1 - pi)) / pi it has the root B^2 = F F',

    F_ij = sqrt(y_i / kappa) / a_i ([i = j] - t sqrt(y_i y_j)).

The row's multiplier is pi / s, and those of -+v_j <= 1 are

    a_j ((1 - y_j) / p_j +- pi / s) / 2.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from vcbf_drake.checks import Array

# A row that mentions an input by less than this has no closed form here.
_LEAST_ENTRY = 1e-4


def box_cut_by_row(a: Array, b: float) -> tuple[Array, Array, Array] | None:
    """Returns the largest ellipsoid in ``{v : |v_j| <= 1, a v <= b}``; see the module.

    Args:
        a: The row, of unit length, shape (m,).
        b: Its right-hand side, less than 1: the row cuts the unit ball.

    Returns:
        The center (m,), a frame F (m, m) with F F' = B^2, and the multipliers of
        v <= 1, -v <= 1 and the row, (2 m + 1,); None where the form does not apply.
    """
    # Plain floats: NumPy's calls cost more than its arithmetic on a few numbers.
    entries = a.tolist()
    sizes = [abs(entry) for entry in entries]
    s = _reach(sizes, b)
    if min(sizes) < _LEAST_ENTRY or s <= 0.0:
        return None
    p = [min(size, s) for size in sizes]
    ratios = [(p_j / s) ** 2 for p_j in p]
    pi = _weight(ratios)
    y = [_small_root(q * pi * (1.0 - pi)) for q in ratios]
    t, per_root_kappa = (1.0 - math.sqrt(1.0 - pi)) / pi, s / math.sqrt(pi * (1.0 - pi))
    root = [math.sqrt(y_j) for y_j in y]
    frame = [
        [
            per_root_kappa * r_i / a_i * ((i == j) - t * r_i * r_j)
            for j, r_j in enumerate(root)
        ]
        for i, (r_i, a_i) in enumerate(zip(root, entries, strict=True))
    ]
    each = list(zip(entries, sizes, p, y, strict=True))
    center = [math.copysign(1.0 - p_j / size, -a_j) for a_j, size, p_j, _ in each]
    bounds = [
        0.5 * max(size * (1.0 - y_j) / p_j + side * a_j * pi / s, 0.0)
        for side in (-1.0, 1.0)
        for a_j, size, p_j, y_j in each
    ]
    return np.array(center), np.array(frame), np.array([*bounds, pi / s])


def _reach(entries: list[float], b: float) -> float:
    """Solves s + sum_j min(a_j, s) = b + sum_j a_j."""
    right, below = b + sum(entries), 0.0
    for count, entry in enumerate(sorted(entries)):
        s = (right - below) / (1 + len(entries) - count)
        if s <= entry:
            return s
        below += entry
    return right - below


def _weight(ratios: list[float]) -> float:
    """Solves sum_j y_j(pi) = pi for pi > 0, by Newton's method within a bracket.

    Args:
        ratios: (p_j / s)^2, at most 1; their sum is above 1.
    """
    # Where v_j <= 1 does not touch, y_j = 1 - pi is the smaller root: pi >= 1/2.
    low, high = (0.5 if max(ratios) == 1.0 else 0.0), 1.0
    pi = len(ratios) / (len(ratios) + 1.0)
    for _ in range(60):
        rest = pi * (1.0 - pi)
        excess, slope = -pi, -1.0
        for q in ratios:
            root = math.sqrt(max(1.0 - 4.0 * q * rest, 0.0))
            excess += 2.0 * q * rest / (1.0 + root)
            slope += q * (1.0 - 2.0 * pi) / max(root, 1e-12)
        low, high = (pi, high) if excess > 0.0 else (low, pi)
        step = -excess / slope if slope < 0.0 else math.inf
        # What is left after the step is about its square.
        if abs(step) <= 1e-9 * pi:
            return pi + step
        pi = pi + step if low < pi + step < high else 0.5 * (low + high)
    return pi


def _small_root(product: float) -> float:
    """The smaller root of y (1 - y) = product."""
    return 2.0 * product / (1.0 + math.sqrt(max(1.0 - 4.0 * product, 0.0)))
