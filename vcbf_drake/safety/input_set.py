"""The inputs the actuators can produce, and the units in which they are compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, UnboundedSetError, VcbfError
from vcbf_drake.safety.polytope import UnitRows, chebyshev_ball, recession_direction
from vcbf_drake.safety.projection import minimise_linear, nearest_point

# A point this many input ranges away is as good as one infinitely far.
_FARTHEST = 1e6
# Rows are met to this, in normalised inputs, before a projection returns.
_TOLERANCE = 1e-10


class InputSet:
    """A bounded polytope ``{u : A u <= b}`` of inputs, with an interior.

    In normalised inputs v, u = center + scale * v, its bounding box is |v_j| <= 1.

    Args:
        A: The rows, shape (k, m). Rows of zeros with b_i >= 0 are dropped.
        b: The right-hand sides, shape (k,).

    Attributes:
        A: The rows, shape (k, m); [I; -I] for a box.
        b: The right-hand sides, shape (k,); [upper; -lower] for a box.
        num_inputs: m.
        center: The centre of the bounding box, shape (m,); not always inside the set.
        scale: The half-widths of the bounding box, shape (m,).
        interior: A point well inside: the Chebyshev centre, shape (m,).
        is_box: Whether the set was made by `InputSet.box`.
        A_normalised: The rows in v, of unit length, shape (k, m); [I; -I] for a box.
        b_normalised: Their right-hand sides, shape (k,); ones for a box.

    Raises:
        EmptySetError: The set has no interior.
        UnboundedSetError: The set contains a ray.
        ValueError: Wrong shapes or numbers that are not finite.
    """

    is_box = False

    def __init__(self, A: ArrayLike, b: ArrayLike) -> None:
        rows = UnitRows.checked(A, b)
        given_A, given_b = rows.given
        self.interior, radius = chebyshev_ball(given_A, given_b)
        if radius <= 0.0:
            raise EmptySetError(given_A, given_b, radius)
        direction = recession_direction(given_A)
        if direction is not None:
            raise UnboundedSetError(given_A, given_b, direction)
        self.A, self.b = given_A[~rows.is_blank], given_b[~rows.is_blank]
        unit_A, unit_b = rows.without_blanks()
        lower, upper = _bounding_box(unit_A, unit_b, self.interior, radius)
        self.center, self.scale = 0.5 * (lower + upper), 0.5 * (upper - lower)
        normals = unit_A * self.scale
        length = np.linalg.norm(normals, axis=1)
        self.A_normalised = normals / length[:, None]
        self.b_normalised = (unit_b - unit_A @ self.center) / length

    @staticmethod
    def box(lower: ArrayLike, upper: ArrayLike) -> InputSet:
        """Returns ``{u : lower <= u <= upper}``.

        Args:
            lower: The least inputs, shape (m,).
            upper: The greatest inputs, shape (m,), each greater than its least.

        Raises:
            ValueError: Wrong shapes, numbers that are not finite, or an input without
                room between its bounds.
        """
        return _Box(lower, upper)

    @property
    def num_inputs(self) -> int:
        """The number of inputs m."""
        return len(self.center)

    def contains(self, u: ArrayLike, tolerance: float = 1e-9) -> bool:
        """Returns whether u, shape (m,), meets every row.

        Args:
            u: An input; one with entries that are not finite is in no set.
            tolerance: How far outside still counts, in normalised inputs.
        """
        u = np.asarray(u, dtype=float)
        if not np.all(np.isfinite(u)):
            return False
        v = (u - self.center) / self.scale
        return bool(np.all(self.A_normalised @ v <= self.b_normalised + tolerance))

    def project(self, u: ArrayLike) -> Array:
        """Returns the input of the set nearest to u in normalised inputs, shape (m,).

        Always finite, and inside to 1e-9. An input already inside comes back as it is;
        for one that is not finite the answer is `interior`; entries further away than a
        million half-widths are brought that near first.

        Args:
            u: Any input, shape (m,).
        """
        u = np.array(u, dtype=float)
        if not np.all(np.isfinite(u)):
            return self.interior.copy()
        with np.errstate(over="ignore"):
            v = np.clip((u - self.center) / self.scale, -_FARTHEST, _FARTHEST)
        if np.all(self.A_normalised @ v <= self.b_normalised):
            return u
        try:
            v = nearest_point(self.A_normalised, self.b_normalised, v).point
        except VcbfError:
            pass  # Without a verified nearest point, what follows still ends inside.
        return self.center + self.scale * self._pulled_inside(v)

    def _pulled_inside(self, v: Array) -> Array:
        """Returns the last point inside on the segment from the interior to v."""
        if np.all(self.A_normalised @ v <= self.b_normalised + _TOLERANCE):
            return v
        start = (self.interior - self.center) / self.scale
        room = self.b_normalised - self.A_normalised @ start
        approach = self.A_normalised @ (v - start)
        return start + (v - start) / np.max(approach / room)


class _Box(InputSet):
    """Bounds on every input by itself, for which everything has a closed form."""

    is_box = True

    def __init__(self, lower: ArrayLike, upper: ArrayLike) -> None:
        lower, upper = np.array(lower, dtype=float), np.array(upper, dtype=float)
        if lower.ndim != 1 or lower.shape != upper.shape or len(lower) == 0:
            raise ValueError(
                f"lower has shape {lower.shape} and upper {upper.shape}; both must be"
                " (m,) with m >= 1"
            )
        for j, (least, most) in enumerate(zip(lower, upper, strict=True)):
            if not (np.isfinite([least, most]).all() and least < most):
                raise ValueError(
                    f"input {j} has lower bound {least:g} and upper bound {most:g};"
                    " they must be finite, and lower < upper"
                )
        identity = np.eye(len(lower))
        self.A = self.A_normalised = np.concatenate([identity, -identity])
        self.b, self.b_normalised = (
            np.concatenate([upper, -lower]),
            np.ones(len(self.A)),
        )
        # Halved before they are added: bounds may be as large as a float can be.
        self.center, self.scale = 0.5 * lower + 0.5 * upper, 0.5 * upper - 0.5 * lower
        self.interior = self.center
        self._lower, self._upper = lower, upper

    def project(self, u: ArrayLike) -> Array:
        u = np.asarray(u, dtype=float)
        if not np.isfinite(u).all():
            return self.interior.copy()
        inside: Array = np.minimum(np.maximum(u, self._lower), self._upper)
        return inside


def _bounding_box(
    A: Array, b: Array, center: Array, radius: float
) -> tuple[Array, Array]:
    """Returns the least and the greatest input by one linear program each."""
    distance = (b - A @ center) / radius
    directions = np.eye(len(center))
    least, greatest = (
        np.array([minimise_linear(s * e, A, distance) @ e for e in directions])
        for s in (1.0, -1.0)
    )
    return center + radius * least, center + radius * greatest
