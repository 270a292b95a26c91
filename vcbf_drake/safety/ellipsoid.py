"""The largest ellipsoid inside a polytope, its multipliers and certificate.

    max log det B   subject to   |B a_i| + a_i c <= b_i,   B = B' > 0        (E48)

A cone program proposes the ellipsoid, Newton's method on the optimality conditions
(E56) makes it and its multipliers exact, and weak duality bounds the remaining error;
no ellipsoid is returned without that certificate. One input, and a box that one row
cuts, need no program.
"""

from __future__ import annotations

import math
from operator import mul
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError, UnboundedSetError
from vcbf_drake.safety.polytope import chebyshev_ball, recession_direction
from vcbf_drake.safety.programs import FEW_INPUTS, EllipsoidProgram
from vcbf_drake.safety.projection import UnitRows

# Largest certified error of log det B, hence of the volume's relative error, and the
# one below which Newton's method stops.
_ACCEPTED_GAP, _TARGET_GAP = 1e-7, 1e-9
# It takes so many steps at most; without any bound after a few it hardly finds one.
_STEPS, _PATIENCE = 7, 3
# Of a set of unit size the cone program reaches this tolerance; one Newton step is then
# enough. With more inputs than a few, others cost less than the solver's.
_FAST_TOLERANCE = 1e-10
# Of any polytope it reaches this one; two or three Newton steps are then enough.
_CAREFUL_TOLERANCE = 1e-5
# Sets thinner than this, of about unit size, may count as empty: there the rounding of
# their rows alone can exceed the accepted gap.
THINNEST = 1e-7
# Rows whose angle has a cosine this near to 1 are one to the cone program.
_PARALLEL = 1e-12
# Rows further away than this, in its frame, would spoil the cone program's scaling and
# are brought nearer; Newton's method and the certificate take them where they are.
_FARTHEST = 1e6
# The relative accuracy of b - A u, compared with its terms.
_ROUNDING = 1e-15
# The least divisor.
_SHORTEST = 1e-300
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


def symmetric(frames: Array) -> Array:
    """Returns (F F')^(1/2) of every F, shape (..., m, m); nan where F is."""
    known = np.isfinite(frames).all(axis=(-2, -1))
    shapes = np.full_like(frames, np.nan)
    axes, lengths, _ = np.linalg.svd(frames[known])
    roots = axes * np.sqrt(lengths)[..., None, :]
    shapes[known] = roots @ np.swapaxes(roots, -2, -1)
    return shapes


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def inscribed_ellipsoid(A: ArrayLike, b: ArrayLike) -> Ellipsoid:
    """Returns the largest ellipsoid inside ``{u : A u <= b}``.

    Its volume is certified to a relative error of 1e-7.

    Args:
        A: The rows, shape (n, m). Rows of zeros with b_i >= 0 are dropped.
        b: The right-hand sides, shape (n,).

    Raises:
        EmptySetError: The set has no interior: its inradius is not positive.
        UnboundedSetError: The set contains a ray.
        SolverError: No ellipsoid could be certified.
        ValueError: Wrong shapes or numbers that are not finite.
    """
    rows = UnitRows.checked(A, b)
    (center, radius), (A, b) = chebyshev_ball(*rows.given), rows.without_blanks()
    # Of the rows it touches, |b_i| = |a_i center + radius|.
    if radius <= _ROUNDING * (float(np.linalg.norm(center)) + abs(radius)):
        raise EmptySetError(*rows.given, radius)
    every, kept = np.arange(len(b)), np.sort(_tightest(A, b, 0))
    found = _interval(A, b) if A.shape[1] == 1 else _around(center, A, b, every)
    if found is None and len(kept) < len(b):
        # A row beside another, a little further out, can spoil the search.
        found = _around(center, A, b, kept)
    if found is None:
        direction = recession_direction(A)
        if direction is not None:
            raise UnboundedSetError(*rows.given, direction)
        raise SolverError("no ellipsoid could be certified", *rows.given)
    return found._replace(multipliers=rows.as_given(found.multipliers))


def _around(
    center: Array, A: Array, b: Array, kept: NDArray[np.intp]
) -> Ellipsoid | None:
    """Finds the same from an interior point; the cone program has the rows kept.

    Its tolerance is absolute, so it is solved in the coordinates z, u = center +
    frame z, and then in those of what it finds. In the first frame, (sum a_i a_i' /
    distance_i^2)^(-1/2), rows that matter are about equally far.
    """
    _, singular, axes = np.linalg.svd(A / (b - A @ center)[:, None], False)
    frame = (axes.T / np.maximum(singular, 1e-12 * singular[0])) @ axes
    multipliers = np.zeros(len(b))
    for _ in range(4):
        normals, distance = A[kept] @ frame, b[kept] - A[kept] @ center
        length = np.linalg.norm(normals, axis=1)
        program = EllipsoidProgram.of_size(*normals.shape, _CAREFUL_TOLERANCE)
        guess = program.solve(
            normals / length[:, None], np.minimum(distance / length, _FARTHEST)
        )
        if guess is None:
            return None
        center, frame = center + frame @ guess[0], frame @ guess[1]
        multipliers[kept] = guess[2] / length
        if found := _polished(A, b, center, frame, multipliers):
            return found
    return None


def ellipsoid_of_unit_rows(A: Array, b: Array, solver: str, is_box: bool) -> Ellipsoid:
    """Returns the same, faster, of a set of about unit size and rows of unit length.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        solver: The name of the solver that proposes.
        is_box: Whether the first 2 m rows are those of the box |v_j| <= 1.

    Raises:
        EmptySetError: The set has no interior.
        SolverError: No ellipsoid could be certified.
    """
    m, found = A.shape[1], None
    if m == 1:
        found = _interval(A, b)
    elif is_box and len(b) == 2 * m + 1 and b[-1] + np.abs(A[-1]).sum() > THINNEST:
        found = _certified(A, b, *cut_box(A[-1], float(b[-1])))
    else:
        kept: NDArray[np.intp] | slice = slice(None)
        tolerance, multipliers = _FAST_TOLERANCE, np.zeros(len(b))
        if m > FEW_INPUTS:
            tolerance, kept = _CAREFUL_TOLERANCE, _tightest(A, b, 2 * m * is_box)
        rows, bounds = A[kept], b[kept]
        program = EllipsoidProgram.of_size(*rows.shape, tolerance, solver, is_box)
        if guess := program.solve(rows, bounds):
            multipliers[kept] = guess[2]
            found = _polished(A, b, *guess[:2], multipliers)
    if found and found.certified_gap <= _ACCEPTED_GAP:
        return found
    return inscribed_ellipsoid(A, b)


def _tightest(A: Array, b: Array, first: int) -> NDArray[np.intp]:
    """The first rows, and of those behind that are parallel the one furthest in.

    An arm has such rows: both limits of a joint's angle and speed limit its
    acceleration.
    """
    order = first + b[first:].argsort(kind="stable")
    cosine = A[order] @ A[order].T
    is_spare = np.tril(cosine > 1.0 - _PARALLEL, -1).any(axis=1)
    return np.concatenate([np.arange(first), order[~is_spare]])


def _polished(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> Ellipsoid | None:
    """A proposal made exact by Newton's method, one step at least; None in vain.

    The gap says little of the multipliers: its error is the square of theirs.
    """
    best, least = None, math.inf
    for step in range(1, _STEPS + 1):
        try:
            center, frame, multipliers = _step(A, b, center, frame, multipliers)
        except np.linalg.LinAlgError:
            break
        found = _certified(A, b, center, frame, multipliers)
        is_exact = least <= _ACCEPTED_GAP  # Before: what is left may be rounding.
        if found and found.certified_gap < least:
            best, least = found, found.certified_gap
        if least <= _TARGET_GAP or is_exact or (step == _PATIENCE and best is None):
            break
    return best if least <= _ACCEPTED_GAP else None


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


def _certified(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> Ellipsoid | None:
    """The ellipsoid, scaled until it touches, and its certificate; None without.

    The gap gets the rounding of |B a_i| and b_i - a_i c added, which grows with the
    ratio of the longest to the shortest axis, and that of log det B.
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
    |c| <= 2 sum w_i (1 + e_i) over 1 - r - |sum w_i n_i|, for which 0.05 is taken.
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


def _interval(A: Array, b: Array) -> Ellipsoid | None:
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
