"""Where things are: the vehicle, the obstacles, the start and the target, in 3-D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.plants.channels import channels_of
from vcbf_drake.plants.shapes import bounding_box, of_body
from vcbf_drake.plants.vehicle import Vehicle, tag

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result


@dataclass(frozen=True)
class Geometry:
    """A vehicle's place in space, its size, and the names of its channels.

    Attributes:
        vehicle: What kind it is.
        robot: The vehicle itself.
        dimensions: How many coordinates its position has.
        angles: Which states are angles.
        length: The vehicle's length [m].
        rise: How far the vehicle reaches above its position [m].
        inputs: The inputs' names with units.
        disturbances: The disturbed channels' names with units.
    """

    vehicle: str
    robot: Vehicle
    dimensions: int
    angles: tuple[int, ...]
    length: float
    rise: float
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]

    def position(self, state: Array) -> Array:
        """The vehicle's position, shape (T, 3) [m], from states of shape (T, n)."""
        return _in_space(self.robot.positions(state))

    def point(self, values: list[float]) -> Array:
        """A point of the scenario, shape (3,) [m], from its leading entries."""
        place: Array = _in_space(np.atleast_2d(values)[:, : self.dimensions])[0]
        return place


@dataclass(frozen=True)
class Sphere:
    """An obstacle: a ball, or a disc where the plant moves in the plane.

    Attributes:
        center: Its place at time 0, shape (3,) [m].
        velocity: How fast it moves, shape (3,) [m/s].
        radius: Its own radius [m].
        reach: The distance the vehicle's centre has to keep, its margin included [m].
    """

    center: Array
    velocity: Array
    radius: float
    reach: float

    @property
    def moves(self) -> bool:
        """Whether it moves at all."""
        return bool(np.any(self.velocity))

    def center_at(self, time: float) -> Array:
        """Its centre at a time [s], shape (3,) [m]."""
        return self.center + time * self.velocity


def geometry_of(result: Result) -> Geometry:
    """The geometry of a result's vehicle."""
    scenario = result.scenario
    vehicle, channels = scenario.vehicle, channels_of(scenario.vehicle.make_plant())
    _, high = bounding_box(of_body(vehicle.geometry("#000000")))
    return Geometry(
        vehicle=tag(type(vehicle)).removeprefix("!").lower(),
        robot=vehicle,
        dimensions=len(scenario.target),
        angles=channels.angles,
        length=vehicle.length,
        rise=float(high[2]),
        inputs=channels.input_labels,
        disturbances=channels.disturbance_labels,
    )


def spheres_of(result: Result) -> list[Sphere]:
    """The obstacles of a result's scenario."""
    return [
        Sphere(
            center=_in_space(np.atleast_2d(obstacle.center))[0],
            velocity=_in_space(np.atleast_2d(obstacle.velocity or [0.0]))[0],
            radius=float(obstacle.radius),
            reach=float(obstacle.radius + obstacle.margin),
        )
        for obstacle in result.scenario.spheres
    ]


def drawn_fraction(geometry: Geometry, spheres: list[Sphere]) -> int:
    """The whole number k such that the vehicle is drawn at the scale 1:k.

    The barriers guard a point. Where the obstacles are smaller than the vehicle that
    carries it, its true size would hide them, and it is drawn smaller.
    """
    least = min((sphere.reach for sphere in spheres), default=np.inf)
    return max(1, int(np.ceil(0.5 * geometry.length / (0.75 * least))))


def _in_space(points: Array) -> Array:
    """Points of one to three coordinates with the missing ones 0, shape (T, 3)."""
    space = np.zeros((len(points), 3))
    space[:, : points.shape[1]] = points
    return space
