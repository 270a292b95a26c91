"""The car: a point with a speed and a heading, driven by a force and a turn rate."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

import copy
from dataclasses import dataclass
import sys
from typing import Any

import numpy as np
from pydrake.common.containers import namedview
from pydrake.math import cos, sin
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake.checks import Array, check_parameter
from vcbf_drake.model.manoeuvre import Manoeuvre
from vcbf_drake.plants.car_stop import CarStop
from vcbf_drake.typed import check_fields, check_type

# Position [m], signed forward speed [m/s], heading [rad].
CarState = namedview("CarState", ["x", "y", "speed", "heading"])
# Force along the heading [N], rate of the heading [rad/s].
CarInput = namedview("CarInput", ["acceleration_force", "turn_rate"])


@dataclass
class CarParameters:
    """Physical parameters of the car.

    Attributes:
        mass: Mass [kg].
    """

    mass: float = 2.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_parameter("mass", self.mass)


# Told its scope, Drake need not look for it by inspecting the stack, which is slow.
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

        state_names = CarState.get_fields()
        wrapped_states = ("heading",)
        state_units = ("m", "m", "m/s", "rad")
        input_names = CarInput.get_fields()
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
            """Returns the car's backup manoeuvre, if the brakes are stronger than d."""
            mass = self._parameters.mass
            if not CarStop.is_possible(lower, upper, mass, delta):
                return []
            return [CarStop(mass, lower, upper, delta, period)]

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
