"""The inputs the actuators can produce, and the units in which they are compared."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array, require
from vcbf_drake.errors import EmptySetError, ModelError, UnboundedSetError
from vcbf_drake.safety.ellipsoid import Ellipsoid, inscribed_ellipsoid
from vcbf_drake.safety.polytope import (
    chebyshev_ball,
    minimise_linear,
    recession_direction,
)
from vcbf_drake.safety.projection import UnitRows, nearest_point
from vcbf_drake.typed import typed

# A point this many input ranges away (without limits, units away) counts as infinitely
# far.
_FARTHEST, _FARTHEST_IN_UNITS = 1e6, 1e15
# A limit this large counts as infinite: beside it a unit is close to rounding.
_AS_GOOD_AS_NONE = 1e15
# Rows are met to this, in normalised inputs, before a projection returns.
_TOLERANCE = 1e-10


class InputSet:
    """The polytope ``{u : A u <= b}`` of inputs that the actuators can deliver.

    In normalised inputs v, u = center + scale * v, its bounding box is |v_j| <= 1. An
    input that its rows fix, as of a dead actuator, has scale 0 and stays at its center
    for every v. Only a box may have infinite limits: see `InputSet.box`.

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
        is_bounded: Whether every input has a limit on either side.
        A_normalised: The rows in v, of unit length, shape (k, m); [I; -I] for a box.
        b_normalised: Their right-hand sides, shape (k,); ones for a bounded box.
        limits: Indices of the rows that limit something: not those of infinite limits.

    Raises:
        EmptySetError: The set has no interior, fixed inputs apart.
        UnboundedSetError: The set contains a ray.
        ValueError: Wrong shapes or numbers that are not finite.
    """

    is_box = False
    is_bounded = True

    @typed
    def __init__(self, A: ArrayLike, b: ArrayLike) -> None:
        rows = UnitRows.checked(A, b)
        self.A, self.b = (each[~rows.is_blank] for each in rows.given)
        if rows.conflict is not None:
            raise EmptySetError(*rows.given, -np.inf)
        A, b = rows.without_blanks()
        fixed, value = _fixed_inputs(A, b)
        b = b - A @ value
        moves = A[:, ~fixed].any(axis=1)
        if (b[~moves] < -_TOLERANCE * (1.0 + np.abs(value).max(initial=0.0))).any():
            raise EmptySetError(*rows.given, float(b.min()))
        self.center, self.scale, self.interior = value.copy(), 0.0 * value, value.copy()
        self.A_normalised, self.b_normalised = A, np.ones(len(b))
        self.limits = np.arange(len(b))
        if fixed.all() and len(fixed):
            return
        A, b = A[np.ix_(moves, ~fixed)], b[moves]
        try:
            inside, radius = chebyshev_ball(A, b)
            direction = recession_direction(A)
        except UnboundedSetError as error:
            radius, direction = np.inf, error.direction
        if radius <= 0.0:
            raise EmptySetError(*rows.given, radius)
        if direction is not None:
            ray = np.zeros(len(fixed))
            ray[~fixed] = direction
            raise UnboundedSetError(*rows.given, ray)
        lower, upper = _bounding_box(A, b, inside, radius)
        self.interior[~fixed] = inside
        self.center[~fixed] = 0.5 * (lower + upper)
        self.scale[~fixed] = 0.5 * (upper - lower)
        normals = A * self.scale[~fixed]
        length = np.linalg.norm(normals, axis=1)
        self.A_normalised = self.A_normalised.copy()
        self.A_normalised[moves] = 0.0
        self.A_normalised[np.ix_(moves, ~fixed)] = normals / length[:, None]
        self.b_normalised[moves] = (b - A @ self.center[~fixed]) / length

    @staticmethod
    @typed
    def box(lower: ArrayLike, upper: ArrayLike) -> InputSet:
        """Returns ``{u : lower <= u <= upper}``.

        A limit may be infinite where no volume barrier needs a bounded set, and one
        beyond 1e15 is taken as that: then center is the input nearest to 0 and scale
        is 1, its unit. Equal limits fix an input.

        Args:
            lower: The least inputs, shape (m,).
            upper: The greatest inputs, shape (m,), none below its least.

        Raises:
            ValueError: Wrong shapes, or limits that leave an input no value.
        """
        return _Box(lower, upper)

    @property
    def num_inputs(self) -> int:
        """The number of inputs m."""
        return len(self.center)

    def normalised(self, u: Array) -> Array:
        """Returns v of an input u, shape (m,); 0 where it is fixed."""
        v: Array = (u - self.center) / self.units
        return v

    @cached_property
    def units(self) -> Array:
        """The scale, infinite where an input is fixed, shape (m,)."""
        return np.where(self.scale > 0.0, self.scale, np.inf)

    @cached_property
    def fixed(self) -> list[int]:
        """Which inputs are fixed."""
        return np.flatnonzero(self.scale == 0.0).tolist()

    def box_limits(self) -> tuple[Array, Array]:
        """Returns the least and the greatest inputs, shape (m,) each.

        Raises:
            ModelError: The set is no box.
        """
        if not self.is_box:
            raise ModelError("a backup manoeuvre needs limits of each input alone")
        m = self.num_inputs
        return -self.b[m:], self.b[:m]

    @property
    def row_names(self) -> tuple[str, ...]:
        """The limit that each row is."""
        if not self.is_box:
            return tuple(f"input limit {i}" for i in range(len(self.b)))
        inputs = range(self.num_inputs)
        sides = ("upper", "lower")
        return tuple(f"{side} limit of input {j}" for side in sides for j in inputs)

    @cached_property
    def origin(self) -> Array:
        """The input 0, where inputs are not fixed, shape (m,)."""
        return np.where(self.scale > 0.0, 0.0, self.center)

    @cached_property
    def limiting(self) -> tuple[Array, Array]:
        """The rows that limit something, of unit length in (u - origin) / scale."""
        length = np.linalg.norm(self.A * self.scale, axis=1)
        sides = (self.b - self.A @ self.origin) / np.where(length > 0.0, length, 1.0)
        sides = np.where(length > 0.0, sides, self.b_normalised)
        return self.A_normalised[self.limits], sides[self.limits]

    @cached_property
    def largest_ellipsoid(self) -> Ellipsoid:
        """The largest ellipsoid of a bounded set, in normalised inputs."""
        m = self.num_inputs
        if self.is_box:
            halves = np.full(2 * m, 0.5)
            found = Ellipsoid(np.zeros(m), np.eye(m), 0.0, halves, 0.0)
        else:
            found = inscribed_ellipsoid(self.A_normalised, self.b_normalised)
        # Every answer on the plateau shares these.
        found.center.flags.writeable = found.frame.flags.writeable = False
        return found

    @cached_property
    def _reachable(self) -> tuple[Array, Array]:
        """The least and the greatest inputs that do not count as infinitely far."""
        is_open = np.isinf(self.farthest(np.eye(self.num_inputs)))
        farthest = np.where(is_open, _FARTHEST_IN_UNITS, _FARTHEST)
        with np.errstate(over="ignore"):
            far = farthest * self.scale
        return self.center - far, self.center + far

    def near(self, u: Array) -> Array:
        """Returns an input, clipped where it counts as infinitely far, shape (m,)."""
        least, greatest = self._reachable
        return np.minimum(np.maximum(u, least), greatest)

    def farthest(self, A: Array) -> Array:
        """Returns the greatest a_i v over the bounding box, shape (n,).

        Args:
            A: Rows in normalised inputs, shape (n, m).
        """
        farthest: Array = np.abs(A).sum(axis=1)
        return farthest

    def contains(self, u: ArrayLike, tolerance: float = 1e-9) -> bool:
        """Returns whether u, shape (m,), meets every row.

        Args:
            u: An input; one with entries that are not finite is in no set.
            tolerance: The greatest violation that still counts as inside, in normalised
                inputs.
        """
        u = np.asarray(u, dtype=float)
        if not np.all(np.isfinite(u)):
            return False
        v, is_fixed = self.normalised(u), self.scale == 0.0
        off = np.abs(u - self.center)[is_fixed]
        return bool(
            np.all(self.A_normalised @ v <= self.b_normalised + tolerance)
            and np.all(off <= tolerance * (1.0 + np.abs(self.center[is_fixed])))
        )

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
        v = self.normalised(self.near(u))
        if np.all(self.A_normalised @ v <= self.b_normalised + _TOLERANCE):
            return np.where(self.scale > 0.0, u, self.center)
        A, b = self.A_normalised, self.b_normalised
        v = nearest_point(A, b, v, num_firm=len(b))
        return self.center + self.scale * v


class _Box(InputSet):
    """Limits of every input by itself, for which everything has a closed form."""

    is_box = True

    def __init__(self, lower: ArrayLike, upper: ArrayLike) -> None:
        lower, upper = np.array(lower, dtype=float), np.array(upper, dtype=float)
        if lower.ndim != 1 or lower.shape != upper.shape or len(lower) == 0:
            raise ValueError(
                f"lower has shape {lower.shape} and upper {upper.shape}; both must be"
                " (m,) with m >= 1"
            )
        for j, (least, most) in enumerate(zip(lower, upper, strict=True)):
            if not (least <= most and least < np.inf and most > -np.inf):
                raise ValueError(
                    f"input {j} has lower bound {least:g} and upper bound {most:g};"
                    " they must be numbers or infinite, and lower <= upper"
                )
        lower = np.where(lower < -_AS_GOOD_AS_NONE, -np.inf, lower)
        upper = np.where(upper > _AS_GOOD_AS_NONE, np.inf, upper)
        identity = np.eye(len(lower))
        self.A = self.A_normalised = np.concatenate([identity, -identity])
        self.b = np.concatenate([upper, -lower])
        self.limits = np.isfinite(self.b).nonzero()[0]
        # Halved before they are added: bounds may be as large as a float can be.
        with np.errstate(invalid="ignore"):
            self.center, self.scale = (
                0.5 * lower + 0.5 * upper,
                0.5 * upper - 0.5 * lower,
            )
        self.interior = self.center
        self.b_normalised = np.ones(len(self.A))
        self._lower, self._upper = lower, upper
        self._is_open = ~(np.isfinite(lower) & np.isfinite(upper))
        if self._is_open.any():
            self._widen()

    def _widen(self) -> None:
        """Normalises the inputs with an infinite limit by their unit."""
        is_open = self._is_open
        self.is_bounded = False
        self.center[is_open] = np.clip(0.0, self._lower, self._upper)[is_open]
        self.scale[is_open] = 1.0
        room = np.concatenate([self._upper - self.center, self.center - self._lower])
        both = np.tile(is_open, 2)
        self.b_normalised[both] = room[both]
        inward = np.clip(self.center, self._lower + 1.0, self._upper - 1.0)
        self.interior = np.where(is_open, inward, self.center)

    def farthest(self, A: Array) -> Array:
        farthest = super().farthest(A)
        if not self.is_bounded:
            farthest[A[:, self._is_open].any(axis=1)] = np.inf
        return farthest

    def project(self, u: ArrayLike) -> Array:
        u = np.asarray(u, dtype=float)
        if not np.isfinite(u).all():
            return self.interior.copy()
        inside: Array = np.minimum(np.maximum(u, self._lower), self._upper)
        return inside


def check_inputs(input_set: InputSet, num_inputs: int, effort_limits: Array) -> None:
    """Checks that a plant can follow all inputs of a set.

    Args:
        input_set: The set.
        num_inputs: The plant's.
        effort_limits: The limit at which the plant clamps each input, shape (m,).

    Raises:
        InvalidValueError: It cannot.
    """
    size = input_set.num_inputs
    is_open = np.isinf(input_set.farthest(np.eye(size)))
    reach = np.abs(input_set.center) + np.where(is_open, np.inf, input_set.scale)
    require(size == num_inputs, "input_set", size, f"{num_inputs} inputs")
    for j, (most, limit) in enumerate(zip(reach, effort_limits, strict=True)):
        rule = f"at most {limit:g}, the effort limit that clamps it"
        require(bool(most <= limit), ("input_set", f"input {j}"), float(most), rule)


def _fixed_inputs(A: Array, b: Array) -> tuple[NDArray[np.bool_], Array]:
    """Finds inputs whose own limits coincide; returns which, and their value or 0.

    Args:
        A: Rows of unit length, shape (k, m).
        b: Their right-hand sides, shape (k,).
    """
    m = A.shape[1]
    upper, lower = np.full(m, np.inf), np.full(m, -np.inf)
    for i in ((A != 0.0).sum(axis=1) == 1).nonzero()[0].tolist():
        j = int(A[i].nonzero()[0][0])
        if A[i, j] > 0.0:
            upper[j] = min(upper[j], b[i] / A[i, j])
        else:
            lower[j] = max(lower[j], b[i] / A[i, j])
    is_limited = np.isfinite(upper) & np.isfinite(lower)
    fixed = is_limited & (np.abs(upper - lower) <= 4e-16 * np.abs(upper))
    return fixed, np.where(fixed, upper, 0.0)


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
