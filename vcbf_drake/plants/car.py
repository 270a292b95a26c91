"""The car: a point with a speed and a heading, driven by a force and a turn rate."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

from collections.abc import Sequence
import copy
from dataclasses import dataclass, field
import math
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import cos, sin
from pydrake.systems.framework import BasicVector_, LeafSystem_, System
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake.barriers import Barrier, StateInputLimit, ackermann_limit
from vcbf_drake.checks import Array
from vcbf_drake.model.manoeuvre import Manoeuvre
from vcbf_drake.plants.car_stop import car_stops
from vcbf_drake.plants.controllers import (
    NEAR,
    StateFeedback,
    checked_target,
    forward_component,
    heading_error,
)
from vcbf_drake.plants.shapes import Part, painted_model
from vcbf_drake.plants.vehicle import Vehicle
from vcbf_drake.typed import (
    Checked,
    NotNegative,
    Positive,
    check_type,
    typed,
)


@dataclass
class CarParameters(Checked):
    """Physical parameters of the car.

    Attributes:
        mass: Mass [kg].
    """

    mass: Positive = 2.0


# With the scope given, Drake need not inspect the stack for it, which is slow.
@TemplateSystem.define(  # type: ignore[untyped-decorator]
    "Car_", scope=sys.modules[__name__]
)
def Car_(T: type) -> type:
    """Makes the class Car_[T] for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """The car of the paper's experiments (E79, the car).

        Ports:
            input (2): force along the heading [N], turn rate [rad/s].
            disturbance (1), optional: acceleration along the heading [m/s^2].
            state (4): x, y [m], speed [m/s], heading [rad].

        The context holds the mass [kg] as its one parameter.
        """

        state_names = ("x", "y", "speed", "heading")
        wrapped_states = ("heading",)
        state_units = ("m", "m", "m/s", "rad")
        input_names = ("acceleration_force", "turn_rate")
        input_units = ("N", "rad/s")
        disturbance_names = ("d",)
        disturbance_units = ("m/s²",)
        position_indices = (0, 1)

        def _construct(
            self, parameters: CarParameters | None = None, converter: Any = None
        ) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            check_type("parameters", parameters, CarParameters | None)
            self._parameters = copy.deepcopy(parameters) or CarParameters()
            self.DeclareNumericParameter(BasicVector_[T]([self._parameters.mass]))
            self._input = self.DeclareVectorInputPort("input", 2)
            self._disturbance = self.DeclareVectorInputPort("disturbance", 1)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(4))

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, parameters=other._parameters, converter=converter)

        def make_manoeuvres(
            self, lower: Array, upper: Array, delta: float, period: float
        ) -> list[Manoeuvre]:
            """Returns the car's stops, if the brakes are stronger than d."""
            return car_stops(self._parameters.mass, lower, upper, delta, period)

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            _, _, v, psi = context.get_continuous_state_vector().CopyToVector().tolist()
            a, omega = self._input.Eval(context).tolist()
            disturbed = self._disturbance.HasValue(context)
            (d,) = self._disturbance.Eval(context).tolist() if disturbed else [0.0]
            (m,) = context.get_numeric_parameter(0).CopyToVector().tolist()
            derivatives.get_mutable_vector().SetFromVector(
                np.array([v * cos(psi), v * sin(psi), a / m + d, omega])
            )

    return Impl


Car = Car_[None]


@dataclass
class CarControllerParameters(Checked):
    """Gains of the car's controller (E82, the car's controller).

    Attributes:
        turn_gain: k_ω, from heading error to turn rate [1/s].
        speed_gain: k_v, from speed error to force [N s/m].
        approach_gain: k_p, from distance to speed [1/s].
    """

    turn_gain: NotNegative = 2.0
    speed_gain: NotNegative = 4.0
    approach_gain: NotNegative = 0.6


class CarController(StateFeedback):
    """Drives the car to a target and stops it there (E82).

    The heading error is taken as 0 within 5 cm of the target (R39). Its ports are those
    of `StateFeedback`.

    Args:
        target: The target position (x, y) [m].
        parameters: Gains; the defaults if None.
        plant_parameters: The car's parameters; the defaults if None.
    """

    @typed
    def __init__(
        self,
        target: ArrayLike,
        parameters: CarControllerParameters | None = None,
        plant_parameters: CarParameters | None = None,
    ) -> None:
        super().__init__(self._steer, 4, 2, 1)
        self._target = checked_target(target, 2)
        self._parameters = copy.copy(parameters) or CarControllerParameters()
        self._mass = (plant_parameters or CarParameters()).mass

    def _steer(self, state: Array, estimate: Array) -> list[float]:
        p, (x, y, speed, heading) = self._parameters, state.tolist()
        dx, dy = self._target[0] - x, self._target[1] - y
        wanted_speed = p.approach_gain * forward_component(dx, dy, heading)
        force = -p.speed_gain * (speed - wanted_speed) - self._mass * estimate[0]
        near = math.hypot(dx, dy) < NEAR
        turn_rate = 0.0 if near else -p.turn_gain * heading_error(dx, dy, heading)
        return [force, turn_rate]


@dataclass
class TurnLimit(Checked):
    """A car's steering: ``|omega| <= curvature sqrt(v^2 + smoothing_speed^2)``.

    Attributes:
        curvature: Greatest curvature of the path [1/m].
        smoothing_speed: Speed below which the limit stops shrinking [m/s]; makes it
            smooth at rest.
    """

    curvature: Positive = 2.0
    smoothing_speed: Positive = 0.1


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

    def make_plant(self) -> System:
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
