"""The largest ellipsoid inside a polytope, its multipliers, gradient and certificate.

    max log det B   subject to   |B a_i| + a_i c <= b_i,   B = B' > 0        (E48)

A cone program proposes the ellipsoid, Newton's method makes it exact and weak duality
certifies it; no ellipsoid is returned without that certificate.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError, UnboundedSetError
from vcbf_drake.safety.certified_ellipsoid import (
    ACCEPTED_GAP,
    Ellipsoid,
    certified,
    cut_box,
    interval,
    polish,
)
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import UnitRows, chebyshev_ball, recession_direction
from vcbf_drake.safety.programs import DEFAULT_SOLVER, FEW_INPUTS, EllipsoidProgram

# Of a set of unit size the cone program reaches this tolerance; one Newton step is then
# enough. With more inputs than a few, others cost less than the solver's.
_FAST_TOLERANCE = 1e-10
# Of any polytope it reaches this one; two or three Newton steps are then enough.
_CAREFUL_TOLERANCE = 1e-5
# Cut input sets thinner than this, in normalised inputs, may count as empty: there the
# rounding of their rows alone can exceed the accepted gap.
THINNEST = 1e-7
# Rows whose angle has a cosine this near to 1 are one to the cone program.
_PARALLEL = 1e-12
# Rows further away than this, in its frame, would spoil the cone program's scaling and
# are brought nearer; Newton's method and the certificate take them where they are.
_FARTHEST = 1e6
# The relative accuracy of b - A u, compared with its terms.
_ROUNDING = 1e-15


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
    if rows.conflict is not None:
        raise EmptySetError(*rows.given, -math.inf)
    found = _search(rows)
    if found is None:
        direction = recession_direction(rows.without_blanks()[0])
        if direction is not None:
            raise UnboundedSetError(*rows.given, direction)
        raise SolverError("no ellipsoid could be certified", *rows.given)
    return found._replace(multipliers=rows.as_given(found.multipliers))


def _search(rows: UnitRows) -> Ellipsoid | None:
    """Finds the largest ellipsoid from the rows alone, or None.

    The cone program's tolerance is absolute. So it is solved in the coordinates z,
    u = center + frame z, of the rows around the Chebyshev centre, and then of what it
    finds.
    """
    (center, radius), (A, b) = chebyshev_ball(*rows.given), rows.without_blanks()
    # Of the rows it touches, |b_i| = |a_i center + radius|.
    if radius <= _ROUNDING * (float(np.linalg.norm(center)) + abs(radius)):
        raise EmptySetError(*rows.given, radius)
    if A.shape[1] == 1:
        return interval(A, b)
    every, kept = np.arange(len(b)), np.sort(_tightest(A, b, 0))
    found = _around(center, A, b, every)
    if found is None and len(kept) < len(b):
        # A row beside another, a little further out, can spoil the search.
        found = _around(center, A, b, kept)
    return found


def _around(
    center: Array, A: Array, b: Array, kept: NDArray[np.intp]
) -> Ellipsoid | None:
    """The same, from an interior point; the cone program has the rows kept.

    In the frame (sum a_i a_i' / distance_i^2)^(-1/2), with distances from the point,
    rows that matter are about equally far.
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
        found = polish(A, b, center, frame, multipliers)
        if found is not None and found.certified_gap <= ACCEPTED_GAP:
            return found
    return None


class InscribedEllipsoidSolver:
    """Finds the largest ellipsoid of an input set cut by a few rows, at every tick.

    In normalised inputs v (see `InputSet`). When the input set's own largest ellipsoid
    meets every row, it is the answer: the plateau. An input of a box that no other row
    mentions is an axis of the ellipsoid, of half-length 1. A box that one row cuts has
    a closed form; what is left is the cone program's. Both need the certificate.

    Args:
        input_set: The inputs before any row cuts them.
        solver: The name of the solver that proposes; where it takes no cone programs,
            `DEFAULT_SOLVER` does.

    Attributes:
        free: That of the input set alone.
    """

    def __init__(self, input_set: InputSet, solver: str = DEFAULT_SOLVER) -> None:
        self._solver = solver
        self._A, self._b = input_set.A_normalised, input_set.b_normalised
        self._is_box = input_set.is_box
        m = input_set.num_inputs
        self.free = (
            Ellipsoid(np.zeros(m), np.eye(m), 0.0, np.full(2 * m, 0.5), 0.0)
            if self._is_box
            else inscribed_ellipsoid(self._A, self._b)
        )
        # Every answer on the plateau shares these.
        self.free.center.flags.writeable = False
        self.free.frame.flags.writeable = False

    @np.errstate(over="ignore", divide="ignore", invalid="ignore")
    def solve(self, A: Array, b: Array) -> Ellipsoid:
        """Returns the largest ellipsoid in v of the input set with ``A v <= b``.

        Its multipliers are those of the input set's rows, in the order of
        `InputSet.A_normalised` (of a box +v_1, .., +v_m, -v_1, .., -v_m), and then
        of those given.

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
        length = np.sqrt(np.vecdot(A, A))
        if self._is_free(A, b, length):
            multipliers = np.concatenate([self.free.multipliers, np.zeros(len(b))])
            return self.free._replace(multipliers=multipliers)
        lengths = length.tolist()
        is_plain = 0.0 < min(lengths) and math.isfinite(sum(lengths) + sum(b.tolist()))
        if is_plain:
            A, b = A / length[:, None], b / length
        rows, bounds = np.concatenate([self._A, A]), np.concatenate([self._b, b])
        if not is_plain:
            return inscribed_ellipsoid(rows, bounds)
        try:
            found = self._cut(rows, bounds)
        except EmptySetError as error:
            raise EmptySetError(rows, bounds, error.inradius) from None
        except SolverError:
            radius = chebyshev_ball(rows, bounds)[1]
            if radius < THINNEST:
                raise EmptySetError(rows, bounds, radius) from None
            raise
        found.multipliers[len(self._b) :] /= length
        return found

    def _is_free(self, A: Array, b: Array, length: Array) -> bool:
        """Whether the input set's own ellipsoid meets every row."""
        if not self._is_box:
            length = np.linalg.norm(A @ self.free.frame, axis=1)
            b = b - A @ self.free.center
        return bool((length <= b).all())

    def _cut(self, A: Array, b: Array) -> Ellipsoid:
        """The same, of all rows, of unit length, with only the inputs that matter."""
        k, m = self._A.shape
        matters = [any(column) for column in A[k:].T.tolist()]
        if not self._is_box or all(matters):
            return _of_rows(A, b, self._solver, self._is_box)
        cut = np.flatnonzero(matters)
        own = np.concatenate([cut, m + cut, np.arange(k, len(b))])
        found = _of_rows(A[own[:, None], cut], b[own], self._solver, True)
        center, frame = self.free.center.copy(), self.free.frame.copy()
        center[cut], frame[cut[:, None], cut] = found.center, found.frame
        multipliers = np.full(len(b), 0.5)
        multipliers[own] = found.multipliers
        return found._replace(center=center, frame=frame, multipliers=multipliers)


def _of_rows(A: Array, b: Array, solver: str, is_box: bool) -> Ellipsoid:
    """The largest ellipsoid of unit rows, of a set of about unit size."""
    m, found = A.shape[1], None
    if m == 1:
        found = interval(A, b)
    elif is_box and len(b) == 2 * m + 1 and b[-1] + np.abs(A[-1]).sum() > THINNEST:
        found = certified(A, b, *cut_box(A[-1], float(b[-1])))
    else:
        kept: NDArray[np.intp] | slice = slice(None)
        tolerance, multipliers = _FAST_TOLERANCE, np.zeros(len(b))
        if m > FEW_INPUTS:
            tolerance, kept = _CAREFUL_TOLERANCE, _tightest(A, b, 2 * m * is_box)
        rows, bounds = A[kept], b[kept]
        program = EllipsoidProgram.of_size(*rows.shape, tolerance, solver, is_box)
        if guess := program.solve(rows, bounds):
            multipliers[kept] = guess[2]
            found = polish(A, b, *guess[:2], multipliers)
    if found and found.certified_gap <= ACCEPTED_GAP:
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
