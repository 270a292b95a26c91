"""Obstacles in a scenario's own words, and points of a robot's body."""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import ClassVar, TypeAlias

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.barriers import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    PolygonObstacle,
    StateLimit,
)
from vcbf_drake.checks import (
    Array,
    check_finite,
    check_parameter,
    finite_array,
    require,
)
from vcbf_drake.typed import check_fields


@dataclass
class Obstacle:
    """A sphere, or in the plane a disc, to keep out of, standing or moving.

    Attributes:
        center: Centre at time zero [m], one number a dimension.
        radius: Radius [m].
        velocity: Velocity of the centre [m/s]; empty for an obstacle that stands.
        margin: Distance to keep from the surface [m].
    """

    TAG: ClassVar[str] = "!Sphere"

    center: list[float]
    radius: float
    velocity: list[float] = field(default_factory=list)
    margin: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_finite("center", self.center, size=len(self.center))
        check_parameter("radius", self.radius)
        if len(self.velocity):
            check_finite("velocity", self.velocity, size=len(self.center))
        check_parameter("margin", self.margin, zero_allowed=True)


@dataclass
class StateRange:
    """A range that one state keeps to, such as a speed or a height.

    Attributes:
        state: The state's name.
        lower: Least value, in the state's unit; -.inf for none.
        upper: Greatest value; .inf for none.
        gains: K of (E4), one a derivative of the state until the input appears.
    """

    TAG: ClassVar[str] = "!StateLimit"

    state: str
    lower: float = -math.inf
    upper: float = math.inf
    gains: list[float] = field(default_factory=lambda: [1.0])

    def __post_init__(self) -> None:
        check_fields(self)
        StateLimit(0, self.lower, self.upper)
        check_parameter("gains", self.gains, size=len(self.gains))


CarriedShape: TypeAlias = (
    Obstacle | EllipsoidObstacle | CapsuleObstacle | BoxObstacle | PolygonObstacle
)


@dataclass
class MovingObstacle:
    """A shape that goes from waypoint to waypoint, along a cubic spline.

    It stands before the first and after the last of them. Its velocity is continuous,
    its acceleration between the two.

    Attributes:
        shape: The shape; without a velocity of its own.
        times: When it is at each waypoint, increasing, two at least [s].
        waypoints: How far it is from its own place there, (T, k) [m]: the place itself
            where its center is 0.
    """

    TAG: ClassVar[str] = "!Moving"

    shape: CarriedShape
    times: list[float]
    waypoints: list[list[float]]

    def __post_init__(self) -> None:
        check_fields(self)
        own = getattr(self.shape, "velocity", None)
        stands = own is None or not np.any(own)
        require(stands, ("shape", "velocity"), own, "left out: waypoints move it")
        times = finite_array(self.times, "times", 1, "a list of finite numbers")
        rises = len(times) >= 2 and bool(np.all(np.diff(times) > 0.0))
        require(rises, "times", self.times, "two at least, increasing")
        rule = f"{len(times)} rows, one a time, of {self.size} finite numbers each"
        places = finite_array(self.waypoints, "waypoints", 2, rule)
        fits = places.shape == (len(times), self.size)
        require(fits, "waypoints", self.waypoints, rule)

    @property
    def size(self) -> int:
        """In how many dimensions it moves."""
        if isinstance(self.shape, Obstacle):
            return len(self.shape.center)
        return self.shape.formula()[0]

    def trajectory(self) -> PiecewisePolynomial:
        """Returns how far it is from its own place, (k, 1) [m], at rest at its ends."""
        rest = np.zeros(self.size)
        return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            self.times, np.transpose(self.waypoints), rest, rest
        )

    def offset_at(self, time: float) -> Array:
        """Returns how far it is from its own place at a time [s], shape (k,) [m]."""
        start, end = self.times[0], self.times[-1]
        offset: Array = self.trajectory().value(min(max(time, start), end)).ravel()
        return offset


@dataclass
class BodyPoint:
    """A point of the robot that keeps clear of every obstacle, with a ball around it.

    Attributes:
        point: Where it is, from the vehicle's position, forwards and to the left where
            it has a heading; or in the frame [m]. Empty for the position, or the
            frame's origin.
        frame: The frame of a robot from a file that it moves with; empty for that of
            its position.
        radius: How much of the body around it is meant [m].
    """

    point: list[float] = field(default_factory=list)
    frame: str = ""
    radius: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_finite("point", self.point, size=len(self.point))
        check_parameter("radius", self.radius, zero_allowed=True)
