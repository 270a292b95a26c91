"""A proposed ellipsoid made exact and certified, and two that have a closed form.

Newton's method on the optimality conditions (E56), in the ellipsoid's own coordinates,
makes it and its multipliers exact. Weak duality bounds the remaining error.
"""

from __future__ import annotations

import math
from operator import mul
from typing import NamedTuple

import numpy as np

from vcbf_drake.checks import Array

# Largest certified error of log det B, hence of the volume's relative error.
ACCEPTED_GAP = 1e-7
# The least divisor.
_SHORTEST = 1e-300
# Newton's method stops below this gap.
TARGET_GAP = 1e-9
# It takes so many steps at most; without any bound after a few it hardly finds one.
_STEPS, _PATIENCE = 7, 3
# The ratio of axes up to which its bound is as good as itself, and what exp allows.
_LARGE_RATIO, _LARGE = 1e6, 700.0


class Ellipsoid(NamedTuple):
    """The largest ellipsoid ``{B v + c : |v| <= 1}`` inside ``{u : A u <= b}``.

    Attributes:
        center: c, shape (m,).
        frame: F with F F' = B^2, shape (m, m).
        log_det: log det B.
        multipliers: lambda >= 0 of (E56), d(log det B)/db, in the units of the rows
            as given and exactly 0 for rows that do not touch, shape (n,).
        certified_gap: No ellipsoid inside has a log det larger by more than this.
    """

    center: Array
    frame: Array
    log_det: float
    multipliers: Array
    certified_gap: float

    @property
    def shape(self) -> Array:
        """B, symmetric and positive definite, shape (m, m)."""
        return symmetric(self.frame)

    @property
    def volume(self) -> float:
        """The volume: that of the unit m-ball times det B."""
        half = 0.5 * len(self.center)
        return math.pi**half / math.gamma(half + 1.0) * math.exp(self.log_det)

    def contact_points(self, A: Array) -> Array:
        """Returns the points c + B^2 a_i / |B a_i| furthest along rows, (k, m) (E57).

        Rows with a positive multiplier touch the ellipsoid there. A row of zeros has no
        such point and gets the centre.

        Args:
            A: The rows a_i, shape (k, m).
        """
        reach = A @ self.frame
        length = np.maximum(np.sqrt(np.vecdot(reach, reach)), _SHORTEST)
        points: Array = self.center + reach / length[:, None] @ self.frame.T
        return points

    def volume_gradient(self, A: Array) -> tuple[Array, Array]:
        """Returns dV/dA (n, m) and dV/db (n,) of the volume V (E57).

        dV = V sum_i lambda_i (db_i - da_i p_i), p_i the contact points. Where more rows
        touch than determine the ellipsoid, as with a row given twice, V has one-sided
        derivatives only, and this is a supergradient of log V in b.

        Args:
            A: The rows of the set, shape (n, m).
        """
        dV_db = self.volume * self.multipliers
        return -dV_db[:, None] * self.contact_points(A), dV_db


def symmetric(frames: Array) -> Array:
    """Returns (F F')^(1/2) of every F, shape (..., m, m); nan where F is."""
    known = np.isfinite(frames).all(axis=(-2, -1))
    shapes = np.full_like(frames, np.nan)
    axes, lengths, _ = np.linalg.svd(frames[known])
    roots = axes * np.sqrt(lengths)[..., None, :]
    shapes[known] = roots @ np.swapaxes(roots, -2, -1)
    return shapes


def polish(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> Ellipsoid | None:
    """Makes a proposal exact by Newton's method, one step at least, and certifies it.

    The gap says little of the multipliers: its error is the square of theirs.

    Args:
        A: The rows, of unit length, shape (n, m).
        b: Their right-hand sides, shape (n,).
        center: c of the proposal, shape (m,).
        frame: F with F F' = B^2, shape (m, m).
        multipliers: Multipliers of the rows, shape (n,).

    Returns:
        The best ellipsoid with a bound; None without one.
    """
    best, least = None, math.inf
    for step in range(1, _STEPS + 1):
        try:
            center, frame, multipliers = _step(A, b, center, frame, multipliers)
        except np.linalg.LinAlgError:
            break
        found = certified(A, b, center, frame, multipliers)
        is_exact = least <= ACCEPTED_GAP  # Before: what is left may be rounding.
        if found and found.certified_gap < least:
            best, least = found, found.certified_gap
        if least <= TARGET_GAP or is_exact or (step == _PATIENCE and best is None):
            break
    return best


def _step(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> tuple[Array, Array, Array]:
    """A semismooth Newton step on the optimality conditions (E73).

    The step moves the centre by d and the shape from I to I + D, in the coordinates in
    which the ellipsoid is the unit ball. A row takes part when w_i > e_i; the weights
    of the others are zero. The conditions, linear in D, d and the change of w, ask for

        2 D = I - sum (v_i - w_i e_i) n_i n_i',   d = sum v_i n_i,
        n_i' D n_i + n_i' d = e_i   for the rows that take part,

    which determines v, and w_i becomes v_i - w_i n_i' d.
    """
    reach, length, e, w = _contacts(A, b, center, frame, multipliers)
    on = ((w > 0.0) | (e < 0.0)).nonzero()[0]
    e, w, length = e[on], w[on], length[on]
    n = reach[on] / length[:, None]
    cosine = n @ n.T
    half = 0.5 * cosine * cosine
    matrix = half - cosine
    # Rows given twice make it singular; shifted, they share their weight.
    matrix.flat[:: len(on) + 1] += 1e-10
    we = w * e
    v = np.linalg.solve(matrix, 0.5 - e + half @ we)
    d = v @ n
    multipliers = np.zeros(len(b))
    multipliers[on] = np.maximum(v - w * (n @ d), 0.0) / length
    turn = (n.T * (0.5 * (we - v))) @ n
    return center + frame @ d, 1.5 * frame + frame @ turn, multipliers


def certified(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> Ellipsoid | None:
    """Returns the ellipsoid, scaled until it touches, and its certificate.

    The gap gets the rounding of |B a_i| and b_i - a_i c added, which grows with the
    ratio of the longest to the shortest axis, and that of log det B. None without a
    bound.
    """
    reach, length, e, w = _contacts(A, b, center, frame, multipliers)
    gap = _gap(reach / length[:, None], e, w)
    if gap == math.inf:
        return None
    m, scale = len(center), 1.0 + min(e.tolist())
    frame = scale * frame
    log_det = float(np.linalg.slogdet(frame)[1])
    size = math.sqrt(np.vdot(frame, frame) / m)
    # A bound of the ratio (Guggenheimer, Edelman, Johnson 1995); the ratio itself takes
    # longer.
    ratio = 2.0 * math.exp(min(m * math.log(size) - log_det, _LARGE))
    if ratio > _LARGE_RATIO:
        ratio = float(np.linalg.cond(frame))
    gap += 4e-16 * abs(log_det)
    gap += 4e-16 * m * ratio * (1.0 + math.sqrt(center @ center) / size)
    return Ellipsoid(center, frame, log_det, w / length, gap)


def _contacts(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> tuple[Array, Array, Array, Array]:
    """Rows a_i F, lengths |B a_i|, excess distances e and weights w of `_step`."""
    reach = A @ frame
    length = np.sqrt(np.vecdot(reach, reach))
    e = (b - A @ center) / length - 1.0
    w = multipliers * length
    return reach, length, e, w * (w > e)


def _gap(n: Array, e: Array, w: Array) -> float:
    """Bounds log det B* - log det B by weak duality, in the coordinates of `_step`.

    There B = (1 + min e) I. With S = sum w_i n_i n_i' and r = |S - I|, the bound of
    section 6 of docs/theory.md has log det S >= tr(S - I) - r^2 / (2 (1 - r)), and
    |c| <= 2 sum w_i (1 + e_i) over 1 - r - |sum w_i n_i|. Taken as 0.05, well below
    what it is, this also tells how exact the multipliers are.
    """
    m = n.shape[1]
    excess = (n.T * w) @ n
    excess.flat[:: m + 1] -= 1.0
    r, imbalance = math.sqrt(np.vdot(excess, excess)), math.hypot(*(w @ n).tolist())
    weights, beyond = w.tolist(), e.tolist()
    mass, reach = sum(weights), 1.0 + min(beyond)
    total = mass + sum(map(mul, weights, beyond))
    if not (r < 0.5 and imbalance < 0.04 and 0.0 < total < 1.1 * m * reach):
        return math.inf
    farthest = 2.0 * total / 0.05
    log_det = mass - m - 0.5 * r * r / (1.0 - r)
    return m * math.log((total + imbalance * farthest) / (m * reach)) - log_det


def interval(A: Array, b: Array) -> Ellipsoid | None:
    """One input: the interval between the nearest bounds on either side."""
    rows = A[:, 0]
    bound = b / rows
    upper = int(np.where(rows > 0.0, bound, np.inf).argmin())
    lower = int(np.where(rows < 0.0, bound, -np.inf).argmax())
    half = 0.5 * float(bound[upper] - bound[lower])
    if not (rows[upper] > 0.0 > rows[lower] and half > 0.0):
        return None
    multipliers = np.zeros(len(b))
    multipliers[[upper, lower]] = 0.5 / half
    center = np.array([0.5 * (bound[upper] + bound[lower])])
    rounding = 1e-15 * (1.0 + abs(float(center[0])) / half)
    return Ellipsoid(center, np.array([[half]]), math.log(half), multipliers, rounding)


def cut_box(a: Array, b: float) -> tuple[Array, Array, Array]:
    """Returns the largest ellipsoid of a box that one row cuts, to be certified.

    Of the box |v_j| <= 1 and the row a v <= b, in closed form but for one root (E74).
    B^2 = Q (I - w u u') Q, with u the direction of Q a and Q^2 diagonal.

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
    """Solves r + sum_j (min(r, a_j) - a_j) = b for r, from below."""
    far = size
    while True:
        r = (b + sum(far)) / (1 + len(far))
        further = [each for each in far if each > r]
        if len(further) == len(far):
            return r
        far = further


def _weight(ratio: list[float], k: int) -> float:
    """Solves for w by Newton's method, from above: the function is convex."""
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
