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
# Newton's method stops below this gap.
TARGET_GAP = 1e-9
# Without any bound after so many steps it hardly ever finds one.
_PATIENCE = 3


class Ellipsoid(NamedTuple):
    """The largest ellipsoid ``{B v + c : |v| <= 1}`` inside ``{u : A u <= b}``.

    Attributes:
        center: c, shape (m,).
        frame: F with F F' = B^2, shape (m, m).
        log_det: log det B.
        multipliers: lambda >= 0 of (E56), d(log det B)/db, in the units of the rows
            as given and exactly 0 for rows that do not touch, shape (n,).
        certified_gap: No ellipsoid inside has a log det larger by more than this.
        rows: A as given, shape (n, m).
    """

    center: Array
    frame: Array
    log_det: float
    multipliers: Array
    certified_gap: float
    rows: Array

    @property
    def shape(self) -> Array:
        """B, symmetric and positive definite, shape (m, m)."""
        return symmetric(self.frame)

    @property
    def volume(self) -> float:
        """The volume: that of the unit m-ball times det B."""
        half = 0.5 * len(self.center)
        return math.pi**half / math.gamma(half + 1.0) * math.exp(self.log_det)

    def contact_point(self, a: Array) -> Array:
        """Returns c + B^2 a / |B a|, shape (m,): its point furthest along a row (E57).

        Args:
            a: The row, shape (m,).
        """
        reach = a @ self.frame
        point: Array = self.center + self.frame @ reach / math.sqrt(reach @ reach)
        return point

    @property
    def contact_points(self) -> Array:
        """The points p_i = c + B^2 a_i / |B a_i| furthest along each row, (n, m) (E57).

        Rows with a positive multiplier touch the ellipsoid there. A row of zeros has no
        such point and gets the centre.
        """
        reach = self.rows @ self.frame
        length = np.linalg.norm(reach, axis=1, keepdims=True)
        return self.center + reach / np.where(length > 0.0, length, 1.0) @ self.frame.T

    def volume_gradient(self) -> tuple[Array, Array]:
        """Returns dV/dA (n, m) and dV/db (n,) of the volume V (E57).

        dV = V sum_i lambda_i (db_i - da_i p_i), p_i the contact points. Where more rows
        touch than determine the ellipsoid, as with a row given twice, V has one-sided
        derivatives only, and this is a supergradient of log V in b.
        """
        dV_db = self.volume * self.multipliers
        return -dV_db[:, None] * self.contact_points, dV_db


def symmetric(frames: Array) -> Array:
    """Returns (F F')^(1/2) of every F, shape (..., m, m); nan where F is."""
    known = np.isfinite(frames).all(axis=(-2, -1))
    shapes = np.full_like(frames, np.nan)
    axes, lengths, _ = np.linalg.svd(frames[known])
    roots = axes * np.sqrt(lengths)[..., None, :]
    shapes[known] = roots @ np.swapaxes(roots, -2, -1)
    return shapes


def polish(
    A: Array,
    b: Array,
    center: Array,
    frame: Array,
    multipliers: Array,
) -> Ellipsoid | None:
    """Semismooth Newton's method on the optimality conditions (E56).

    In the coordinates in which the ellipsoid is the unit ball, with the rows' unit
    normals n_i, their excess distance e_i = (b_i - a_i c) / |B a_i| - 1 and their
    weights w_i = lambda_i |B a_i|, the conditions read

        sum w_i n_i n_i' = I,   sum w_i n_i = 0,   min(w_i, e_i) = 0.

    A row takes part in a step when w_i > e_i; the weights of the others are zero. The
    step moves the centre by d and the shape from I to I + D. The conditions, linear in
    D, d and the change of w, ask for

        2 D = I - sum (v_i - w_i e_i) n_i n_i',   d = sum v_i n_i,
        n_i' D n_i + n_i' d = e_i   for the rows that take part,

    which determines v, and w_i becomes v_i - w_i n_i' d.

    The gap says little of the multipliers: its error is the square of theirs. So one
    step at least is taken.

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
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        for step in range(8):
            n, length, e, w = _contacts(A, b, center, frame, multipliers)
            if step > 0:
                gap = _gap(n, e, w)
                if gap < least:
                    best, least = (center, frame, w / length, e), gap
                if gap <= TARGET_GAP or (step == _PATIENCE and best is None):
                    break
            on = ((w > 0.0) | (e < 0.0)).nonzero()[0]
            n, e, w = n[on], e[on], w[on]
            cosine = n @ n.T
            half = 0.5 * cosine * cosine
            matrix = half - cosine
            # Rows given twice make it singular; shifted, they share their weight.
            matrix.flat[:: len(on) + 1] += 1e-10
            we = w * e
            try:
                v = np.linalg.solve(matrix, 0.5 - e + half @ we)
            except np.linalg.LinAlgError:
                break
            d = v @ n
            multipliers = np.zeros(len(b))
            multipliers[on] = np.maximum(v - w * (n @ d), 0.0) / length[on]
            center = center + frame @ d
            frame = 1.5 * frame - 0.5 * frame @ ((n.T * (v - we)) @ n)
    return best and _inside(A, *best, least)


def certified(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> Ellipsoid | None:
    """Returns the ellipsoid as it is with its certificate; None without a bound."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        n, length, e, w = _contacts(A, b, center, frame, multipliers)
        gap = _gap(n, e, w)
    return _inside(A, center, frame, w / length, e, gap) if gap < math.inf else None


def _contacts(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> tuple[Array, Array, Array, Array]:
    """Unit normals n, lengths |B a_i|, excess distances e and weights w of `polish`."""
    n = A @ frame
    length = np.sqrt(np.vecdot(n, n))
    n /= length[:, None]
    e = (b - A @ center) / length - 1.0
    w = multipliers * length
    w[w <= e] = 0.0
    return n, length, e, w


def _gap(n: Array, e: Array, w: Array) -> float:
    """Bounds log det B* - log det B by weak duality, in the coordinates of `polish`.

    There B = (1 + min e) I. For every ellipsoid (B, c) inside and S = sum w_i n_i n_i',

        sum w_i (1 + e_i) >= sum w_i (|B n_i| + n_i c) >= tr(S B) + c' sum w_i n_i

    and tr(S B) >= m (det S det B)^(1/m). At the optimum S = I and sum w_i n_i vanishes;
    until then, with the Frobenius norm r = |S - I| < 1,

        log det S >= tr(S - I) - r^2 / (2 (1 - r)),

    and |c| is bounded by c'S c = sum w_i (n_i c)^2 with -|c| <= n_i c <= 1 + e_i, to
    2 sum w_i (1 + e_i) over 1 - r - |sum w_i n_i|. Taken as 0.05, well below what it
    is, this also tells how exact the multipliers are.
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


def _inside(
    A: Array, center: Array, frame: Array, multipliers: Array, e: Array, gap: float
) -> Ellipsoid:
    """Scales the ellipsoid until it touches.

    The gap gets the rounding of |B a_i| and b_i - a_i c added, which grows with the
    ratio of the longest to the shortest axis, and that of log det B.
    """
    scale = 1.0 + float(e.min())
    lengths = (scale * np.linalg.svd(frame, compute_uv=False)).tolist()
    longest, shortest = lengths[0] + math.sqrt(center @ center), lengths[-1]
    log_det = sum(map(math.log, lengths))
    rounding = 4e-16 * (len(lengths) * longest / shortest + abs(log_det))
    return Ellipsoid(center, scale * frame, log_det, multipliers, gap + rounding, A)


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
    return Ellipsoid(
        center, np.array([[half]]), math.log(half), multipliers, rounding, A
    )


def cut_box(a: Array, b: float) -> tuple[Array, Array, Array]:
    """Returns the largest ellipsoid of a box that one row cuts, to be certified.

    Of the box |v_j| <= 1 and the row a v <= b, in closed form but for one root (E74).
    With r = |B a|, rho_j = |a_j| / r and S_j = (1 - 4 w (1 - w) rho_j^2)^(1/2), its
    half-widths are min(1, 1 / rho_j) and the row's weight is w. The far sides have the
    weights w, or (1 + S_j) / 4 + w rho_j / 2, the near ones 0, or (1 + S_j) / 4 -
    w rho_j / 2, and B^2 = Q (I - w u u') Q: u is the direction of Q a, and Q^2 is
    diagonal, of 1 / (w rho_j^2), or 2 / (1 + S_j).

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
