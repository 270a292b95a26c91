"""The largest ellipsoid inside a polytope, its multipliers, gradient and certificate.

    max log det B   subject to   |B a_i| + a_i c <= b_i,   B = B' > 0        (E20)

A cone program proposes the ellipsoid, Newton's method makes it exact and weak duality
certifies it; nothing leaves here without that certificate.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError, UnboundedSetError
from vcbf_drake.safety.certified_ellipsoid import (
    ACCEPTED_GAP,
    CertifiedEllipsoid,
    interval,
    polish,
)
from vcbf_drake.safety.chebyshev import dikin_frame, largest_ball
from vcbf_drake.safety.cone_program import cone_program
from vcbf_drake.safety.recession import recession_direction
from vcbf_drake.safety.unit_rows import UnitRows

# Of any polytope the cone program reaches this tolerance; two or three Newton steps
# are then enough.
_CAREFUL_TOLERANCE = 1e-7
# Rows further away than this, in its frame, would spoil the cone program's scaling and
# are brought nearer; Newton's method and the certificate take them where they are.
_FARTHEST = 1e6


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


def _search(rows: UnitRows) -> CertifiedEllipsoid | None:
    """Finds the largest ellipsoid from nothing but the rows, or None.

    The cone program's tolerance is absolute. So it is solved in the coordinates z,
    u = center + frame z, of the rows around the Chebyshev centre, and then of what it
    finds.
    """
    A, b, ball = rows.A, rows.b, largest_ball(rows)
    if ball.radius <= ball.rounding:
        raise EmptySetError(*rows.given, ball.radius)
    if A.shape[1] == 1:
        return interval(A, b)
    center, frame = ball.center, dikin_frame(A, ball.slack)
    for _ in range(4):
        normals, distance = A @ frame, b - A @ center
        length = np.linalg.norm(normals, axis=1)
        program = cone_program(*A.shape, _CAREFUL_TOLERANCE)
        guess = program.solve(
            normals / length[:, None], np.minimum(distance / length, _FARTHEST)
        )
        if guess is None:
            return None
        center, frame = center + frame @ guess[0], frame @ guess[1]
        found = polish(A, b, center, frame, guess[2] / length)
        if found is not None and found.certified_gap <= ACCEPTED_GAP:
            return found
    return None
