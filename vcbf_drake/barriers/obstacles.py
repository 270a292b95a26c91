"""Obstacles to stay clear of, standing or moving."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import arithmetic
from vcbf_drake.barriers.shapes import ShapeFunction, SmoothShape, carried
from vcbf_drake.checks import (
    Array,
    check_finite,
    check_parameter,
    finite_array,
    finite_vector,
    require,
)
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.typed import NotNegative, Positive, check_fields

SphereForm = Literal["distance", "squared"]
_TOLERANCE = 1e-9


class Obstacle(SmoothShape):
    """A shape to stay clear of, which moves at a constant velocity.

    Attributes:
        center: Its centre at t = 0, shape (k,) with k = 2 or 3 [m].
        velocity: Shape (k,) [m/s]; None or empty for an obstacle at rest.
    """

    center: Sequence[float] | Array
    velocity: Sequence[float] | Array | None

    def __post_init__(self) -> None:
        check_fields(self, f"{self.kind}: ")
        size = len(finite_vector(self.center, f"{self.kind}: center"))
        require(size in (2, 3), f"{self.kind}: center", self.center, "2 or 3 numbers")
        if self.velocity is not None and len(self.velocity):
            check_finite(f"{self.kind}: velocity", self.velocity, size=size)

    @abstractmethod
    def centered(self) -> tuple[ShapeFunction, list[float]]:
        """Returns h(z, t, p), for the position z from the centre, and p's values."""

    def formula(self) -> tuple[int, ShapeFunction, list[float]]:
        """Returns k, h(position, t, p) with p = (of `centered`, path), and p."""
        h, parameters = self.centered()
        path = self.motion[: 1 + self.moves]
        size, order = path.shape[1], len(path) - 1
        return size, carried(h, size, order), [*parameters, 0.0, *path.flat]

    @property
    def motion(self) -> Array:
        """The centre at t = 0 and the velocity, shape (2, k) [m, m/s]."""
        center = np.array(self.center, dtype=float)
        is_given = self.velocity is not None and len(self.velocity)
        return np.array([center, self.velocity if is_given else 0.0 * center])

    @property
    def moves(self) -> bool:
        """Whether its velocity is not zero."""
        return bool(self.motion[1].any())

    def center_at(self, t: float | Array) -> Array:
        """Returns the centre at time t [s], shape (k,); for times (T,), (T, k) [m]."""
        center, velocity = self.motion
        return center + np.multiply.outer(t, velocity)


@dataclass
class SphereObstacle(Obstacle):
    """A sphere, or in the plane a disc, that moves at a constant velocity.

    With the position p, the centre c(t) and the safety distance R = radius + margin,
    its barrier is one of::

        distance:  h = |p - c(t)| - R        [m]    (E77, the sphere's barrier)
        squared:   h = |p - c(t)|^2 - R^2    [m^2]  (E80, the car's barrier)

    Attributes:
        center: The centre at t = 0, shape (k,) with k = 2 or 3 [m].
        radius: The obstacle's own radius [m].
        velocity: The centre's velocity, shape (k,) [m/s]; None or empty for an obstacle
            at rest.
        margin: Distance to keep from the obstacle's surface [m].
        form: "distance" or "squared"; None for "distance", in a scenario for the form
            of its other spheres (`barrier.form`).
    """

    kind: ClassVar[str] = "obstacle"
    center: Sequence[float] | Array
    radius: NotNegative
    velocity: Sequence[float] | Array | None = None
    margin: NotNegative = 0.0
    form: SphereForm | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_parameter("obstacle: radius + margin", self.safety_distance)

    @property
    def safety_distance(self) -> float:
        """The distance R = radius + margin to keep from the centre [m]."""
        return self.radius + self.margin

    def centered(self) -> tuple[ShapeFunction, list[float]]:
        """Returns h(z, t, p) with p = (R,), and p."""
        squared = self.form == "squared"

        @arithmetic
        def h(z: Expressions, t: Expression, p: Expressions) -> Expression:
            return z @ z - p[0] ** 2 if squared else (z @ z) ** 0.5 - p[0]

        return h, [self.safety_distance]


@dataclass(frozen=True)
class EllipsoidObstacle(Obstacle):
    """An ellipsoid, or in the plane an ellipse, that moves at a constant velocity.

    With the semi-axes a_i along the columns of R, Q = R diag(1 / a_i^2) R' and the
    centre c(t), its barrier is::

        h = min(a) (sqrt((p - c(t))' Q (p - c(t))) - 1) - margin    [m]

    The factor min(a) makes h a length: outside it never exceeds the distance to the
    surface less the margin, and equals it along the shortest axis. The set h = 0 is the
    ellipsoid scaled by 1 + margin / min(a). Smooth except at the centre. Relative
    degree 2 for a position that forces accelerate (`Blimp`, `Car`). Source: ours.

    Attributes:
        center: The centre at t = 0, shape (k,) with k = 2 or 3 [m].
        semi_axes: a, shape (k,) [m].
        rotation: R, whose columns are the axes' directions, shape (k, k); None for the
            coordinate axes.
        velocity: The centre's velocity, shape (k,) [m/s]; None or empty for an obstacle
            at rest.
        margin: The distance to keep from the surface, at least [m].
    """

    kind: ClassVar[str] = "ellipsoid"
    center: Sequence[float] | Array
    semi_axes: Sequence[float] | Array
    rotation: Sequence[Sequence[float]] | Array | None = None
    velocity: Sequence[float] | Array | None = None
    margin: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        size = len(self.center)
        check_parameter("ellipsoid: semi_axes", self.semi_axes, size=size)
        rotation_matrix(self.rotation, size, "ellipsoid")

    def centered(self) -> tuple[ShapeFunction, list[float]]:
        """Returns h(z, t, p) with p = (scaled axes, min(a), margin), and p."""
        R = rotation_matrix(self.rotation, len(self.center), "ellipsoid")
        axes = (R / self.semi_axes).T

        @arithmetic
        def h(z: Expressions, t: Expression, p: Expressions) -> Expression:
            # Scaled by the semi-axes, |z|^2 is (p - c)' Q (p - c).
            scaled, (shortest, margin) = p[:-2].reshape(axes.shape) @ z, p[-2:]
            return shortest * ((scaled @ scaled) ** 0.5 - 1.0) - margin

        return h, [*axes.flat, min(self.semi_axes), self.margin]


@dataclass(frozen=True)
class BoxObstacle(Obstacle):
    """A box, or in the plane a rectangle, that moves at a constant velocity.

    With z = R' (p - c(t)), the position along the box's own axes, the half-widths a
    and how far s(z_i) the position is beyond each of them (`smooth_excess`)::

        h = |s| - gap - margin    [m]

    h is smooth everywhere and conservative: it never exceeds the exact distance to the
    box less the margin, and is less by at most the gap, sqrt(k) e / 2 for a box much
    wider than e. Inside the box h is negative but flat, so a position deep inside is
    hardly pushed out. Relative degree 2 for a position that forces accelerate (`Blimp`,
    `Car`). Source: ours.

    Attributes:
        center: The centre at t = 0, shape (k,) with k = 2 or 3 [m].
        half_widths: a, shape (k,); 0 for a plate [m].
        rotation: R, whose columns are the box's own axes, shape (k, k); None for the
            coordinate axes.
        velocity: The centre's velocity, shape (k,) [m/s]; None or empty for an obstacle
            at rest.
        margin: The distance to keep from the surface [m].
        smoothing: The length e [m].
    """

    kind: ClassVar[str] = "box"
    center: Sequence[float] | Array
    half_widths: Sequence[float] | Array
    rotation: Sequence[Sequence[float]] | Array | None = None
    velocity: Sequence[float] | Array | None = None
    margin: NotNegative = 0.0
    smoothing: Positive = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        size = len(self.center)
        check_parameter(
            "box: half_widths", self.half_widths, size=size, zero_allowed=True
        )
        rotation_matrix(self.rotation, size, "box")

    @property
    def gap(self) -> float:
        """The largest amount by which h is below the exact distance [m]."""
        a = np.asarray(self.half_widths, dtype=float)
        return float(np.linalg.norm(smooth_excess(a, a, self.smoothing)))

    def centered(self) -> tuple[ShapeFunction, list[float]]:
        """Returns h(z, t, p) with p = (a, e, gap + margin, R' if turned), and p."""
        k, R = len(self.center), self.rotation
        turn = () if R is None else rotation_matrix(R, k, "box").T.flat

        @arithmetic
        def h(z: Expressions, t: Expression, p: Expressions) -> Expression:
            half_widths, (smoothing, clear), axes = p[:k], p[k : k + 2], p[k + 2 :]
            z = axes.reshape(k, k) @ z if len(axes) else z
            s = smooth_excess(z, half_widths, smoothing)
            return (s @ s) ** 0.5 - clear

        clear = self.gap + self.margin
        return h, [*self.half_widths, self.smoothing, clear, *turn]


@dataclass(frozen=True)
class CapsuleObstacle(Obstacle):
    """All points within a radius of a segment that moves at a constant velocity.

    With the segment's middle c(t) and half-length a, the position z along the segment
    and y across it, both from c(t), and how far s(z) the position is beyond the ends
    (`smooth_excess`)::

        h = sqrt(|y|^2 + s(z)^2) - gap - radius - margin    [m]

    h is smooth everywhere and conservative: it never exceeds the exact signed distance
    to the capsule less the margin, and is less by at most the gap, e / 2 for a capsule
    much longer than e. Relative degree 2 for a position that forces accelerate
    (`Blimp`, `Car`). Source: ours.

    Attributes:
        start: One end of the segment at t = 0, shape (k,) with k = 2 or 3 [m].
        end: The other end at t = 0, shape (k,) [m].
        radius: The distance of the surface from the segment [m].
        velocity: The segment's velocity, shape (k,) [m/s]; None or empty for an
            obstacle at rest.
        margin: The distance to keep from the surface [m].
        smoothing: The length e [m].
    """

    kind: ClassVar[str] = "capsule"
    start: Sequence[float] | Array
    end: Sequence[float] | Array
    radius: NotNegative
    velocity: Sequence[float] | Array | None = None
    margin: NotNegative = 0.0
    smoothing: Positive = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.shape(self.start) != np.shape(self.end) or not self.half_length:
            start, end = (np.array(each).tolist() for each in (self.start, self.end))
            raise ValueError(
                "capsule: start and end must be two different points of one size,"
                f" got {start} and {end}"
            )

    @property
    def center(self) -> Array:  # type: ignore[override]
        """The segment's middle at t = 0, shape (k,) [m]."""
        start = finite_vector(self.start, "capsule: start")
        end = finite_vector(self.end, "capsule: end")
        return (start + end) / 2.0 if start.shape == end.shape else start

    @property
    def half_length(self) -> float:
        """Half the length of the segment [m]."""
        return float(np.linalg.norm(np.subtract(self.end, self.start))) / 2.0

    @property
    def gap(self) -> float:
        """The largest amount by which h is below the exact distance [m]."""
        a = self.half_length
        return float(smooth_excess(a, a, self.smoothing))

    def centered(self) -> tuple[ShapeFunction, list[float]]:
        """Returns h(z, t, p) with p = (axes, a, e, clearance), and p."""
        # Orthonormal rows, the first along the segment.
        _, _, axes = np.linalg.svd(np.subtract(self.end, self.start)[None])

        @arithmetic
        def h(z: Expressions, t: Expression, p: Expressions) -> Expression:
            (along, *across), constants = p[:-3].reshape(axes.shape) @ z, p[-3:]
            half_length, smoothing, clear = constants
            s = smooth_excess(along, half_length, smoothing)
            return (np.dot(across, across) + s**2) ** 0.5 - clear

        clear = self.gap + self.radius + self.margin
        return h, [*axes.flat, self.half_length, self.smoothing, clear]


def rotation_matrix(
    rotation: Sequence[Sequence[float]] | Array | None, size: int, name: str
) -> Array:
    """Returns R, whose columns are a shape's own axes, shape (k, k)."""
    if rotation is None:
        return np.eye(size)
    rule = f"{size} rows of {size} finite numbers each"
    matrix = finite_array(rotation, f"{name}: rotation", 2, rule)
    require(matrix.shape == (size, size), f"{name}: rotation", rotation, rule)
    if not np.abs(matrix.T @ matrix - np.eye(size)).max() <= _TOLERANCE:
        raise ValueError(
            f"{name}: rotation must have orthonormal columns, got {matrix.tolist()}"
        )
    return matrix


def smooth_excess(z: Any, half: Any, smoothing: Any) -> Any:
    """Returns a smooth bound from above on how far z is beyond [-half, half].

    The sum of a smooth positive part at either end, with the smoothing length e::

        s(z) = (sqrt((z - a)^2 + e^2) + sqrt((z + a)^2 + e^2)) / 2 - a

    It is positive and has all derivatives. It exceeds max(|z| - a, 0) everywhere, most
    at the ends, by s(a), which is between e/2 and e. Source: ours.
    """
    below = ((z + half) ** 2 + smoothing**2) ** 0.5
    above = ((z - half) ** 2 + smoothing**2) ** 0.5
    return (below + above) / 2 - half
