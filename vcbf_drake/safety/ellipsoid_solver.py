"""The largest ellipsoid of an input set cut by a few rows, once per control tick."""

from __future__ import annotations

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.certified_ellipsoid import (
    ACCEPTED_GAP,
    TARGET_GAP,
    CertifiedEllipsoid,
    interval,
    polish,
)
from vcbf_drake.safety.chebyshev import chebyshev_ball
from vcbf_drake.safety.cone_program import cone_program
from vcbf_drake.safety.cut_box import box_cut_by_row
from vcbf_drake.safety.cut_ellipsoid import cut_ellipsoid
from vcbf_drake.safety.ellipsoid import Ellipsoid, inscribed_ellipsoid
from vcbf_drake.safety.input_set import InputSet

# Of a set of unit size the cone program reaches this tolerance; one Newton step is then
# enough.
_FAST_TOLERANCE = 1e-10
# Cut input sets thinner than this, in normalised inputs, may count as empty: there the
# rounding of their rows alone can exceed the accepted gap.
_THINNEST = 1e-7


class InscribedEllipsoidSolver:
    """Finds the largest ellipsoid of an input set cut by a few rows, at every tick.

    In normalised inputs v (see `InputSet`). Exact shortcuts come first. When the input
    set's own largest ellipsoid meets every row, it is the answer: the plateau. A row
    with b_i > |a_i|_1 cuts nothing off the bounding box |v_j| <= 1. An input of a box
    that no other row mentions is an axis of the ellipsoid, of half-length 1. A box that
    a single row cuts has its ellipsoid in closed form, and when that meets the other
    rows too it is theirs. Else the other rows cut it down, and Newton's method starts
    from what they leave; a cone program is asked only when it does not get there. All
    of it needs the same certificate.

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
            return bool((np.sqrt(np.vecdot(A, A)) <= b).all())
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
        length = np.sqrt(np.vecdot(normals, normals))
        if not (length.all() and np.isfinite(length + distance).all()):
            return inscribed_ellipsoid(rows, bounds)
        block_A = np.concatenate(
            [self._A[own[:, None], cut], normals / length[:, None]]
        )
        block_b = np.concatenate([self._b[own], distance / length])
        found = self._of_rows(block_A, block_b)
        center, shape = self._free.center.copy(), self._free.shape.copy()
        center[cut], shape[cut[:, None], cut] = found.center, found.shape
        multipliers = np.zeros(len(rows))
        multipliers[:k] = self._free.multipliers
        multipliers[own] = found.multipliers[: len(own)]
        multipliers[k + cutting] = found.multipliers[len(own) :] / length
        return Ellipsoid(
            center, shape, found.log_det, multipliers, found.certified_gap, rows
        )

    def _of_rows(self, A: Array, b: Array) -> CertifiedEllipsoid | Ellipsoid:
        """The largest ellipsoid of unit rows, by the first way that makes it exact."""
        ways = [self._of_cut_set, _by_cone_program] if A.shape[1] > 1 else [interval]
        best: CertifiedEllipsoid | None = None
        for way in ways:
            found = way(A, b)
            if best is None or (found and found.certified_gap < best.certified_gap):
                best = found
            if best and best.certified_gap <= TARGET_GAP:
                return best
        if best and best.certified_gap <= ACCEPTED_GAP:
            return best
        return inscribed_ellipsoid(A, b)

    def _of_cut_set(self, A: Array, b: Array) -> CertifiedEllipsoid | None:
        if self._is_box:
            return _of_cut_box(A, b)
        return _cut_down(A, b, self._free.center, self._free.shape)


def _of_cut_box(A: Array, b: Array) -> CertifiedEllipsoid | None:
    """Finds the largest ellipsoid of a box, the first 2 m rows, cut by the others."""
    k, m = 2 * A.shape[1], A.shape[1]
    deepest = k + int(b[k:].argmin())
    exact = box_cut_by_row(A[deepest], float(b[deepest]))
    if exact is None:
        return _cut_down(A, b, np.zeros(m), np.eye(m))
    center, frame, touching = exact
    if len(b) > k + 1 and not _meets(A[k:], b[k:], center, frame):
        return _cut_down(A, b, center, frame)
    multipliers = np.zeros(len(b))
    multipliers[:k], multipliers[deepest] = touching[:-1], touching[-1]
    return polish(A, b, center, frame, multipliers, is_exact=True)


def _meets(A: Array, b: Array, center: Array, frame: Array) -> bool:
    """Whether an ellipsoid meets every row, but for the rounding where it touches."""
    normals = A @ frame
    length = np.sqrt(np.vecdot(normals, normals))
    return bool((length + A @ center <= b + 1e-12 * (length + np.abs(b))).all())


def _cut_down(
    A: Array, b: Array, center: Array, frame: Array
) -> CertifiedEllipsoid | None:
    """Finds the largest ellipsoid from that of a set which the rows cut further."""
    start = cut_ellipsoid(A, b, center, frame)
    return start and polish(A, b, *start)


def _by_cone_program(A: Array, b: Array) -> CertifiedEllipsoid | None:
    """Finds the largest ellipsoid of a set of about unit size around the origin."""
    guess = cone_program(*A.shape, _FAST_TOLERANCE).solve(A, b)
    return guess and polish(A, b, *guess)
