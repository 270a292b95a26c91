"""The largest ellipsoid inside a polytope, its multipliers, gradient and certificate.

    max log det B   subject to   |B a_i| + a_i c <= b_i,   B = B' > 0        (E20)

A cone program proposes the ellipsoid. Newton's method on the optimality conditions
(E42), in the ellipsoid's own coordinates, makes it and its multipliers exact. Weak
duality then bounds what is left of the error; nothing leaves here without that bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike
from pydrake.solvers import (
    Binding,
    ClarabelSolver,
    EvaluatorBase,
    MathematicalProgram,
    SolverOptions,
)

from vcbf_drake.errors import Array, EmptySetError, SolverError, UnboundedSetError
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import (
    UnitRows,
    chebyshev_ball,
    dikin_frame,
    largest_ball,
    recession_direction,
)

# Largest certified error of log det B, hence of the volume's relative error.
_ACCEPTED_GAP = 1e-7
# Newton's method stops below this gap.
_TARGET_GAP = 1e-9
# Tolerances of the cone program. Of a box cut by rows it reaches the first, and one
# Newton step is enough; of any polytope it reaches the second, and two or three are.
_FAST_TOLERANCE, _CAREFUL_TOLERANCE = 1e-10, 1e-7
# Rows further away than this, in its frame, would spoil the cone program's scaling and
# are brought nearer; Newton's method and the certificate take them where they are.
_FARTHEST = 1e6
# Cut input sets thinner than this, in normalised inputs, may count as empty: there the
# rounding of their rows alone can exceed the accepted gap.
_THINNEST = 1e-7


@dataclass(frozen=True)
class Ellipsoid:
    """The largest ellipsoid ``{B v + c : |v| <= 1}`` inside ``{u : A u <= b}``.

    Attributes:
        center: c, shape (m,).
        shape: B, symmetric and positive definite, shape (m, m).
        log_det: log det B.
        multipliers: lambda >= 0 of (E42), d(log det B)/db, in the units of the rows
            as given and exactly 0 for rows that do not touch, shape (n,).
        certified_gap: No ellipsoid inside has a log det larger by more than this.
        rows: A as given, shape (n, m).
    """

    center: Array
    shape: Array
    log_det: float
    multipliers: Array
    certified_gap: float
    rows: Array

    @property
    def volume(self) -> float:
        """The volume: that of the unit m-ball times det B."""
        half = 0.5 * len(self.center)
        return math.pi**half / math.gamma(half + 1.0) * math.exp(self.log_det)

    @property
    def contact_points(self) -> Array:
        """The points p_i = c + B^2 a_i / |B a_i| furthest along each row, (n, m) (E43).

        Rows with a positive multiplier touch the ellipsoid there. A row of zeros has no
        such point and gets the centre.
        """
        reach = self.rows @ self.shape
        length = np.linalg.norm(reach, axis=1, keepdims=True)
        return self.center + reach / np.where(length > 0.0, length, 1.0) @ self.shape

    def volume_gradient(self) -> tuple[Array, Array]:
        """Returns dV/dA (n, m) and dV/db (n,) of the volume V (E43).

        dV = V sum_i lambda_i (db_i - da_i p_i), p_i the contact points. Where more rows
        touch than determine the ellipsoid, as with a row given twice, V has one-sided
        derivatives only, and this is a supergradient of log V in b.
        """
        dV_db = self.volume * self.multipliers
        return -dV_db[:, None] * self.contact_points, dV_db


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
    rows = UnitRows(A, b)
    if rows.conflict is not None:
        raise EmptySetError(*rows.given, -math.inf)
    found = _search(rows)
    if found is None:
        direction = recession_direction(rows.A)
        if direction is not None:
            raise UnboundedSetError(*rows.given, direction)
        raise SolverError("no ellipsoid could be certified", *rows.given)
    multipliers = np.zeros(len(rows.given[1]))
    multipliers[rows.index] = found.multipliers / rows.length
    return Ellipsoid(
        found.center,
        found.shape,
        found.log_det,
        multipliers,
        found.certified_gap,
        rows.given[0],
    )


class InscribedEllipsoidSolver:
    """Finds the largest ellipsoid of an input set cut by a few rows, at every tick.

    In normalised inputs v (see `InputSet`). Exact shortcuts come first. When the input
    set's own largest ellipsoid meets every row, it is the answer: the plateau. A row
    with b_i > |a_i|_1 cuts nothing off the bounding box |v_j| <= 1. And an input of a
    box that no other row mentions is an axis of the ellipsoid, of half-length 1.

    Args:
        input_set: The inputs before any row cuts them.
    """

    def __init__(self, input_set: InputSet) -> None:
        self._A, self._b = input_set.A_normalised, input_set.b_normalised
        self._is_box = input_set.is_box
        self._all_rows, self._all_inputs = map(np.arange, self._A.shape)
        m = input_set.num_inputs
        self._free = (
            Ellipsoid(np.zeros(m), np.eye(m), 0.0, np.full(2 * m, 0.5), 0.0, self._A)
            if self._is_box
            else inscribed_ellipsoid(self._A, self._b)
        )
        # Every answer on the plateau shares these.
        self._free.center.flags.writeable = False
        self._free.shape.flags.writeable = False

    def solve(self, A: Array, b: Array) -> Ellipsoid:
        """Returns the largest ellipsoid in v of the input set with ``A v <= b``.

        Its rows and multipliers are those of the input set, in the order of
        `InputSet.A_normalised` (of a box +v_1, .., +v_m, -v_1, .., -v_m), and then
        those given.

        Args:
            A: The rows in normalised inputs, shape (N, m).
            b: The right-hand sides, shape (N,).

        Raises:
            EmptySetError: Input set and rows have no interior in common, or one too
                thin (an inradius below 1e-7) to be certified.
            SolverError: No ellipsoid could be certified.
            ValueError: Wrong shapes or numbers that are not finite.
        """
        if A.shape != (len(b), self._A.shape[1]):
            raise ValueError(
                f"A has shape {A.shape} and b {b.shape}; they must be (N, m) and (N,)"
                f" with m = {self._A.shape[1]}"
            )
        rows = np.concatenate([self._A, A])
        if self._is_free(A, b):
            multipliers = np.concatenate([self._free.multipliers, np.zeros(len(b))])
            return Ellipsoid(
                self._free.center,
                self._free.shape,
                self._free.log_det,
                multipliers,
                self._free.certified_gap,
                rows,
            )
        bounds = np.concatenate([self._b, b])
        try:
            return self._cut(A, b, rows, bounds)
        except EmptySetError as error:
            raise EmptySetError(rows, bounds, error.inradius) from None
        except SolverError:
            radius = chebyshev_ball(rows, bounds)[1]
            if radius < _THINNEST:
                raise EmptySetError(rows, bounds, radius) from None
            raise

    def _is_free(self, A: Array, b: Array) -> bool:
        """Whether the input set's own ellipsoid meets every row."""
        if self._is_box:
            return bool((np.sqrt(np.einsum("ij,ij->i", A, A)) <= b).all())
        length = np.linalg.norm(A @ self._free.shape, axis=1)
        return bool((length + A @ self._free.center <= b).all())

    def _cut(self, A: Array, b: Array, rows: Array, bounds: Array) -> Ellipsoid:
        """The input set cut by rows, with only the rows and the inputs that matter."""
        k, m = self._A.shape
        # The margin: the bounding box of a general set has a solver's accuracy.
        cutting = (~(np.abs(A).sum(axis=1) * (1.0 + 1e-6) <= b)).nonzero()[0]
        normals, distance = A[cutting], b[cutting]
        cut, own = self._all_inputs, self._all_rows
        if self._is_box:
            cut = normals.any(axis=0).nonzero()[0]
            own = np.concatenate([cut, m + cut])
        normals = normals[:, cut]
        length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        if not (length.all() and np.isfinite(length + distance).all()):
            return inscribed_ellipsoid(rows, bounds)
        block_A = np.concatenate(
            [self._A[own[:, None], cut], normals / length[:, None]]
        )
        block_b = np.concatenate([self._b[own], distance / length])
        found: _Found | Ellipsoid | None = _fast(block_A, block_b)
        if found is None or found.certified_gap > _ACCEPTED_GAP:
            found = inscribed_ellipsoid(block_A, block_b)
        center, shape = self._free.center.copy(), self._free.shape.copy()
        center[cut], shape[cut[:, None], cut] = found.center, found.shape
        multipliers = np.zeros(len(rows))
        multipliers[:k] = self._free.multipliers
        multipliers[own] = found.multipliers[: len(own)]
        multipliers[k + cutting] = found.multipliers[len(own) :] / length
        return Ellipsoid(
            center, shape, found.log_det, multipliers, found.certified_gap, rows
        )


@dataclass(frozen=True)
class _Found:
    """An ellipsoid with what is known of it; see `Ellipsoid`, for rows of length 1."""

    center: Array
    shape: Array
    log_det: float
    multipliers: Array
    certified_gap: float


def _search(rows: UnitRows) -> _Found | None:
    """Finds the largest ellipsoid from nothing but the rows, or None.

    The cone program's tolerance is absolute. So it is solved in the coordinates z,
    u = center + frame z, of the rows around the Chebyshev centre, and then of what it
    finds.
    """
    A, b, ball = rows.A, rows.b, largest_ball(rows)
    if ball.radius <= ball.rounding:
        raise EmptySetError(*rows.given, ball.radius)
    if A.shape[1] == 1:
        return _interval(A, b)
    center, frame = ball.center, dikin_frame(A, ball.slack)
    for _ in range(4):
        normals, distance = A @ frame, b - A @ center
        length = np.linalg.norm(normals, axis=1)
        program = _cone_program(*A.shape, _CAREFUL_TOLERANCE)
        guess = program.solve(
            normals / length[:, None], np.minimum(distance / length, _FARTHEST)
        )
        if guess is None:
            return None
        center, frame = center + frame @ guess[0], frame @ guess[1]
        found = _newton(A, b, center, frame, guess[2] / length)
        if found is not None and found.certified_gap <= _ACCEPTED_GAP:
            return found
    return None


def _fast(A: Array, b: Array) -> _Found | None:
    """Finds the largest ellipsoid of a set of about unit size around the origin."""
    if A.shape[1] == 1:
        return _interval(A, b)
    guess = _cone_program(*A.shape, _FAST_TOLERANCE).solve(A, b)
    return guess and _newton(A, b, *guess)


def _newton(
    A: Array, b: Array, center: Array, frame: Array, multipliers: Array
) -> _Found | None:
    """Semismooth Newton's method on the optimality conditions (E42).

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
    """
    best, least = None, math.inf
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        for step in range(8):
            n = A @ frame
            length = np.sqrt(np.einsum("ij,ij->i", n, n))
            n /= length[:, None]
            e = (b - A @ center) / length - 1.0
            w = multipliers * length
            w[w <= e] = 0.0
            # The cone program's own multipliers are never exact enough to stop at.
            if step > 0:
                gap = _gap(n, e, w)
                if gap < least:
                    best, least = (center, frame, w / length, e), gap
                if gap <= _TARGET_GAP:
                    break
            on = ((w > 0.0) | (e < 0.0)).nonzero()[0]
            n, e, w = n[on], e[on], w[on]
            cosine = n @ n.T
            square = cosine * cosine
            matrix = 0.5 * square - cosine
            # Rows given twice make it singular; shifted, they share their weight.
            matrix.flat[:: len(on) + 1] += 1e-10
            we = w * e
            try:
                v = np.linalg.solve(matrix, 0.5 - e + 0.5 * (square @ we))
            except np.linalg.LinAlgError:
                break
            d = v @ n
            multipliers = np.zeros(len(b))
            multipliers[on] = np.maximum(v - w * (n @ d), 0.0) / length[on]
            center = center + frame @ d
            frame = 1.5 * frame - 0.5 * frame @ ((n.T * (v - we)) @ n)
    return best and _inside(*best, least)


def _gap(n: Array, e: Array, w: Array) -> float:
    """Bounds log det B* - log det B by weak duality, in the coordinates of `_newton`.

    There B = (1 + min e) I. For every ellipsoid (B, c) inside and S = sum w_i n_i n_i',

        sum w_i (1 + e_i) >= sum w_i (|B n_i| + n_i c) >= tr(S B) + c' sum w_i n_i

    and tr(S B) >= m (det S det B)^(1/m). At the optimum sum w_i n_i vanishes; until
    then |c| is bounded by c'S c = sum w_i (n_i c)^2 with -|c| <= n_i c <= 1 + e_i, to
    2 sum w_i (1 + e_i) over the least eigenvalue of S less |sum w_i n_i|.
    """
    m = n.shape[1]
    reach, total = 1.0 + float(e.min()), float(w @ (1.0 + e))
    det = float(np.linalg.det((n.T * w) @ n))
    imbalance = math.hypot(*(w @ n).tolist())
    # Then the least eigenvalue of S is above 0.09 for up to 8 inputs.
    if not (0.0 < total < 1.1 * m * reach and det > 0.5 and imbalance < 0.04):
        return math.inf
    farthest = 2.0 * total / 0.05
    return m * math.log((total + imbalance * farthest) / (m * reach)) - math.log(det)


def _inside(
    center: Array, frame: Array, multipliers: Array, e: Array, gap: float
) -> _Found:
    """Scales the ellipsoid until it touches, and takes its symmetric shape (F F')^1/2.

    The gap gets the rounding of |B a_i| and b_i - a_i c added, which grows with the
    ratio of the longest to the shortest axis.
    """
    axes, lengths, _ = np.linalg.svd(frame)
    lengths *= 1.0 + e.min()
    longest, shortest = lengths[0] + math.sqrt(center @ center), lengths[-1]
    rounding = 4e-16 * len(lengths) * float(longest / shortest)
    log_det = float(np.log(lengths).sum())
    half = axes * (0.5 * lengths) @ axes.T
    return _Found(center, half + half.T, log_det, multipliers, gap + rounding)


def _interval(A: Array, b: Array) -> _Found | None:
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
    return _Found(center, np.array([[half]]), math.log(half), multipliers, rounding)


class _ConeProgram:
    """max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i, L lower triangular.

    Built once per size. A solve overwrites every coefficient, so that its answer
    depends on its own data only.
    """

    def __init__(self, num_rows: int, num_inputs: int, tolerance: float) -> None:
        m = num_inputs
        self._row, self._column = np.tril_indices(m)
        self._k = len(self._row)
        self._slot, self._entry = 1 + self._column, np.arange(self._k)
        # Drake pads the geometric mean with ones to a power of two.
        self._power = 2 ** math.ceil(math.log2(m))
        self._program = MathematicalProgram()
        x = self._program.NewContinuousVariables(self._k + m)
        diagonal = x[: self._k][self._row == self._column]
        self._program.AddMaximizeGeometricMeanCost(diagonal, 1.0)
        dense = np.ones((m + 1, self._k + m))
        cones = [
            self._program.AddLorentzConeConstraint(dense, np.ones(m + 1), x)
            for _ in range(num_rows)
        ]
        self._cones = [cone.evaluator() for cone in cones]
        # Of this type a binding is read many times faster than of its own.
        self._bindings = [
            Binding[EvaluatorBase](cone.evaluator(), cone.variables()) for cone in cones
        ]
        self._F = np.zeros((num_rows, m + 1, self._k + m))
        self._g = np.zeros((num_rows, m + 1))
        self._options = SolverOptions()
        for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
            self._options.SetOption(ClarabelSolver.id(), name, tolerance)
        self._solver = ClarabelSolver()
        self._lock = Lock()

    def solve(self, A: Array, b: Array) -> tuple[Array, Array, Array] | None:
        """Returns d, L and the multipliers d(log det L)/db, or None."""
        m, k = A.shape[1], self._k
        with self._lock:
            self._F[:, 0, k:], self._g[:, 0] = -A, b
            self._F[:, self._slot, self._entry] = A[:, self._row]
            for cone, F, g in zip(self._cones, self._F, self._g, strict=True):
                cone.UpdateCoefficients(F, g)
            result = self._solver.Solve(self._program, None, self._options)
        if not result.is_success():
            return None
        x = result.get_x_val()
        L = np.zeros((m, m))
        L[self._row, self._column] = x[:k]
        diagonal = L.diagonal().tolist()
        if not min(diagonal) > 0.0:
            return None
        duals = [result.GetDualSolution(binding)[0] for binding in self._bindings]
        # The cost's multipliers are those of (det L)^(1/P) = exp(log det L / P).
        mean = math.prod(diagonal) ** (1.0 / self._power)
        return x[k : k + m], L, np.array(duals) * (self._power / mean)


@lru_cache(maxsize=128)
def _cone_program(num_rows: int, num_inputs: int, tolerance: float) -> _ConeProgram:
    return _ConeProgram(num_rows, num_inputs, tolerance)
