"""The car as a vehicle: its plant, its point-to-point controller, its steering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from vcbf_drake.barriers import Barrier, StateInputLimit, ackermann_limit
from vcbf_drake.checks import check_parameter
from vcbf_drake.plants.car import Car, CarParameters
from vcbf_drake.plants.car_controller import CarController, CarControllerParameters
from vcbf_drake.plants.shapes import Part, painted_model
from vcbf_drake.plants.vehicle import Vehicle
from vcbf_drake.typed import check_fields


@dataclass
class TurnLimit:
    """A car's steering: ``|omega| <= curvature sqrt(v^2 + smoothing_speed^2)``.

    Attributes:
        curvature: Greatest curvature of the path [1/m].
        smoothing_speed: Speed below which the limit stops shrinking [m/s]; makes it
            smooth at rest.
    """

    curvature: float = 2.0
    smoothing_speed: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self)
        check_parameter("curvature", self.curvature)
        check_parameter("smoothing_speed", self.smoothing_speed)


@dataclass
class CarVehicle(CarParameters, Vehicle):
    """A `Car` that a `CarController` drives: the parameters of both.

    Attributes:
        controller: Gains of the controller (E82, the car's controller).
        turn_limit: The steering limit, if any.
    """

    controller: CarControllerParameters = field(default_factory=CarControllerParameters)
    turn_limit: TurnLimit | None = None

    position = Car.position_indices
    heading = 3

    def make_plant(self) -> Car:
        """Returns the car."""
        return Car(self)

    def geometry(self, color: str) -> list[Part]:
        """Returns a car on its wheels with its body in a colour."""
        return [Part("car", painted_model("car", color))]

    def make_controller(self, target: Sequence[float]) -> CarController:
        """Returns the controller that drives the car to a target."""
        return CarController(target, self.controller, self)

    def barriers(self) -> list[Barrier | StateInputLimit]:
        """Returns the limits of the turn rate; none where there are none."""
        limit = self.turn_limit
        if limit is None:
            return []
        return [*ackermann_limit(limit.curvature, limit.smoothing_speed)]
