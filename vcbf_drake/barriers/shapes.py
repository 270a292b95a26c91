"""Shapes in space, and their barriers for a position."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import factorial
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from pydrake.symbolic import Expression
from pydrake.trajectories import Trajectory

from vcbf_drake.barriers.barrier import (
    Barrier,
    BarrierFunction,
    arithmetic,
    is_arithmetic,
)
from vcbf_drake.checks import Array, finite_vector, require
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.model.position import Position, PositionFunction
from vcbf_drake.typed import NotNegative, Positive, check_fields, typed

if TYPE_CHECKING:
    from typing import Self  # Python 3.10 has none.

ShapeFunction: TypeAlias = BarrierFunction
"""``h(position, t, p)``: like a barrier's function, of the position (k,)."""

_AXES = "xyz"


class Shape(ABC):
    """A shape that a position stays outside of, or inside, by a margin.

    Attributes:
        kind: The name of its barriers.
        margin: The distance to keep from its surface [m].
    """

    kind: ClassVar[str]
    margin: float

    @abstractmethod
    def parts(self) -> Mapping[str, SmoothShape]:
        """Returns its smooth parts, by the suffix of each part's name."""

    @property
    def dimensions(self) -> int:
        """The number of dimensions."""
        return next(iter(self.parts().values())).formula()[0]

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return False

    @typed
    def barriers(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str | None = None,
    ) -> list[Barrier]:
        """Returns the barriers h >= 0 of its smooth parts.

        Args:
            gains: K of (E4); their number is the relative degree.
            position: The indices of the position, or a function from the symbolic state
                x to it; None for the position that the plant names (`Blimp`, `Car`,
                plants whose states are called x, y and z).
            name: Their name, before the suffix of a part; None for the kind of shape.

        Raises:
            ValueError: `position` has not one index per dimension, or bad gains.
        """
        return [
            self._barrier_of(part, gains, position, f"{name or self.kind}{end}")
            for end, part in self.parts().items()
        ]

    def _barrier_of(self, part: SmoothShape, *arguments: Any) -> Barrier:
        return part.barrier(*arguments)

    def height(self, position: Sequence[float] | Array, t: float = 0.0) -> float:
        """Returns the least h of its barriers at a position (k,) and a time [s]."""
        place, found = np.asarray(position, dtype=float), []
        for part in self.parts().values():
            _, function, parameters = part.formula()
            h: Any = function(place, Expression(t), np.array(parameters))
            found.append(float(h.Evaluate() if isinstance(h, Expression) else h))
        return min(found)

    def grown(self, distance: float) -> Self:
        """Returns the same shape with a margin that is larger by a distance [m]."""
        shape: Any = self
        changed: Self = replace(shape, margin=self.margin + distance)
        return changed


class SmoothShape(Shape):
    """A shape whose barrier is one smooth formula."""

    @abstractmethod
    def formula(self) -> tuple[int, ShapeFunction, list[float]]:
        """Returns the number k of dimensions, h(position, t, p), and p's values."""

    def parts(self) -> Mapping[str, SmoothShape]:
        """Returns the shape itself."""
        return {"": self}

    @typed
    def barrier(
        self,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str | None = None,
    ) -> Barrier:
        """Returns the barrier h >= 0 of the shape; arguments as for `barriers`."""
        size, formula, parameters = self.formula()
        return _barrier(formula, size, gains, parameters, position, name or self.kind)

    @typed
    def barrier_along(
        self,
        trajectory: Trajectory,
        gains: Sequence[float] | Array,
        position: Position | None = None,
        name: str | None = None,
    ) -> Barrier:
        """Returns the barrier of the shape, carried along a Drake `Trajectory`.

        The trajectory's value is added to the shape's own position. Between ticks its
        rows cannot be certified.

        Args:
            trajectory: (k, 1), with as many derivatives as there are gains and one more
                (PiecewisePolynomial, BsplineTrajectory, ...) [m]; the shape is at rest
                before its start and after its end.
            gains: As for `barriers`, like position and name.
            position: Likewise.
            name: Likewise.

        Raises:
            ValueError: As for `barriers`; or the trajectory does not suit the shape.
        """
        size, formula, parameters = self.formula()
        name = name or self.kind
        shape = trajectory.rows(), trajectory.cols()
        rule = f"({size}, 1), as {self.kind} is in {size} dimensions"
        require(shape == (size, 1), f"{name}: shape of the trajectory", shape, rule)
        known = trajectory.has_derivative()
        require(known, f"{name}: trajectory", trajectory, "one that has derivatives")
        order = len(gains) + 1
        changes = Followed(trajectory, order, tuple(parameters))
        h, example = carried(formula, size, order), changes.parameters_at(0.0, None)
        barrier = _barrier(h, size, gains, example, position, name)
        barrier.changes = changes
        return barrier


def _barrier(
    formula: ShapeFunction,
    size: int,
    gains: Sequence[float] | Array,
    parameters: Sequence[float],
    position: Position | None,
    name: str,
) -> Barrier:
    """The barrier of a formula of the plant's position, or of a given position."""
    if position is None:
        return Barrier(formula, gains, parameters, name, of_position=size)
    at = position_function(position, size, name)

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        return formula(at(x), t, p)

    if is_arithmetic(formula) and not callable(position):
        arithmetic(h)
    return Barrier(h, gains, parameters, name)


def position_function(position: Position, size: int, name: str) -> PositionFunction:
    """Returns the position (k,) as a function of the symbolic state."""
    if not callable(position):
        indices = list(position)
        if len(indices) != size or len(set(indices)) != size:
            raise ValueError(
                f"barrier '{name}': position must name {size} states, got {indices}"
            )
        return lambda x: x[indices]

    def checked(x: Expressions) -> Expressions:
        point = position(x)
        if len(point) != size:
            raise ValueError(
                f"position(x) must return {size} numbers, not {len(point)}"
            )
        return point

    return checked


def carried(formula: BarrierFunction, size: int, order: int) -> BarrierFunction:
    """Returns h(position - c(t), t, p) with p = (formula's, t0, coefficients of c).

    The polynomial c in t - t0 has `size` dimensions and the degree `order`.
    """

    def h(position: Expressions, t: Expression, p: Expressions) -> Expression:
        split = len(p) - 1 - size * (order + 1)
        since = t - p[split]
        coefficients = p[split + 1 :].reshape(order + 1, size)
        place = coefficients[-1]
        for row in coefficients[-2::-1]:
            place = row + since * place
        return formula(position - place, t, p[:split])

    return arithmetic(h) if is_arithmetic(formula) else h


@dataclass(frozen=True)
class Followed:
    """The parameters of a `carried` barrier whose shape follows a trajectory.

    At each tick the trajectory is replaced by its Taylor polynomial (E13), with every
    derivative that the rows and their gradients contain, so these are exact at the tick
    for any trajectory.

    Attributes:
        trajectory: The trajectory of the shape's position, in k dimensions.
        order: The degree of the polynomial.
        fixed: The shape's own parameters.
    """

    trajectory: Any
    order: int
    fixed: tuple[float, ...]

    def parameters_at(self, t: float, obstacles: Array | None) -> tuple[float, ...]:
        """Returns the parameters; outside its interval the trajectory is at rest."""
        trajectory, start = self.trajectory, self.trajectory.start_time()
        within = start <= t <= trajectory.end_time()
        place = trajectory.value(min(max(t, start), trajectory.end_time()))
        coefficients = [place.ravel()] + [
            trajectory.EvalDerivative(t, i).ravel() / factorial(i)
            if within
            else np.zeros(place.size)
            for i in range(1, self.order + 1)
        ]
        return (*self.fixed, t, *np.concatenate(coefficients).tolist())


@dataclass(frozen=True)
class HalfSpace(SmoothShape):
    """The half-space ``normal . p >= offset`` that the position p must stay in.

    With the unit normal n = normal / |normal| its barrier is the distance::

        h = n . p - offset / |normal| - margin    [m]

    Smooth everywhere. Relative degree 2 for a position that forces accelerate (`Blimp`,
    `Car`), 1 for one whose velocity is an input. Source: ours.

    Attributes:
        normal: Points to the safe side; of any length, shape (k,) with k = 2 or 3.
        offset: ``normal . p`` on the plane [m, if the normal is a unit vector].
        margin: The distance to keep from the plane [m].
    """

    kind: ClassVar[str] = "half-space"
    normal: Sequence[float] | Array
    offset: float = 0.0
    margin: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "half-space: ")
        normal = finite_vector(self.normal, "half-space: normal")
        if len(normal) not in (2, 3) or not normal.any():
            raise ValueError(
                "half-space: normal must have 2 or 3 numbers, not all 0,"
                f" got {normal.tolist()}"
            )
        finite_vector([self.offset], "half-space: offset")

    def formula(self) -> tuple[int, ShapeFunction, list[float]]:
        """Returns k, h(position, t, p) with p = (n, offset + margin), and p."""
        normal = np.asarray(self.normal, dtype=float)
        length = np.linalg.norm(normal)
        parameters = [*(normal / length), self.offset / length + self.margin]
        return len(normal), lambda z, t, p: p[:-1] @ z - p[-1], parameters


@dataclass(frozen=True)
class Geofence(Shape):
    """The box ``lower <= p <= upper`` that the position p must stay in.

    One `HalfSpace` per side, each with one smooth barrier::

        h = p_i - lower_i - margin,    h = upper_i - p_i - margin    [m]

    Relative degree as for `HalfSpace`. Source: ours.

    Attributes:
        lower: Shape (k,) with k = 2 or 3; -inf where a side is open [m].
        upper: Shape (k,); inf where a side is open [m].
        margin: The distance to keep from every side [m].
    """

    kind: ClassVar[str] = "geofence"
    lower: Sequence[float] | Array
    upper: Sequence[float] | Array
    margin: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "geofence: ")
        lower, upper = (np.asarray(v, dtype=float) for v in (self.lower, self.upper))
        if lower.shape not in ((2,), (3,)) or upper.shape != lower.shape:
            raise ValueError(
                "geofence: lower and upper must have 2 or 3 numbers each, got shapes"
                f" {lower.shape} and {upper.shape}"
            )
        if not (upper - lower > 2.0 * self.margin).all():
            raise ValueError(
                "geofence: upper must be above lower by more than twice the margin,"
                f" got {lower.tolist()} and {upper.tolist()}"
            )
        if not np.isfinite([lower, upper]).any():
            raise ValueError("geofence: at least one side must be finite")

    def parts(self) -> Mapping[str, HalfSpace]:
        """Returns its sides "x low", "x high", "y low", ..., without the open ones."""
        axes = np.eye(len(self.lower))
        sides = {}
        for letter, axis, low, high in zip(
            _AXES[: len(axes)], axes, self.lower, self.upper, strict=True
        ):
            if np.isfinite(low):
                sides[f" ({letter} low)"] = HalfSpace(axis, low, self.margin)
            if np.isfinite(high):
                sides[f" ({letter} high)"] = HalfSpace(-axis, -high, self.margin)
        return sides


@dataclass(frozen=True)
class PairDistance:
    """The minimum distance D of two positions p and q in one stacked state.

    Its barrier is::

        h = |p - q| - D    [m]

    Smooth where p and q differ. Relative degree 2 where forces accelerate both robots
    (`Blimp`, `Car`); one filter then moves both of them. Source: ours.

    Attributes:
        distance: The least distance D between the two positions [m].
    """

    distance: Positive

    def __post_init__(self) -> None:
        check_fields(self, "pair: ")

    @typed
    def barrier(
        self,
        gains: Sequence[float] | Array,
        first: Sequence[int],
        second: Sequence[int],
        name: str = "pair",
    ) -> Barrier:
        """Returns the barrier of the distance.

        Args:
            gains: K of (E4); their number is the relative degree.
            first: The indices of the position p.
            second: The indices of the position q, as many.
            name: Its name.

        Raises:
            ValueError: The positions are not of one size, or the same, or bad gains.
        """
        p = position_function(first, len(first), name)
        q = position_function(second, len(first), name)
        if list(first) == list(second):
            raise ValueError(
                f"barrier '{name}': first and second are both {list(first)}"
            )

        def h(x: Expressions, t: Expression, D: Expressions) -> Expression:
            offset = p(x) - q(x)
            return (offset @ offset) ** 0.5 - D[0]

        return Barrier(h, gains, [self.distance], name)
