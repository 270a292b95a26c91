"""The blimp: a small indoor airship with surge and heave thrust and a yaw moment."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

from collections.abc import Sequence
import copy
from dataclasses import dataclass, field, replace
import math
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import cos, sin
from pydrake.systems.framework import BasicVector_, LeafSystem_, System
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake.checks import Array, check_parameter
from vcbf_drake.model.manoeuvre import Manoeuvre
from vcbf_drake.plants.blimp_climb import blimp_climbs
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
    PositiveOrInfinite,
    check_fields,
    check_type,
    typed,
)


@dataclass
class BlimpParameters(Checked):
    """Physical parameters of a neutrally buoyant blimp.

    The defaults are those of the Georgia Tech miniature autonomous blimp as published
    in github.com/evannsm/blimp_work, utilities.py.

    Attributes:
        mass: Mass of the blimp, its gas included [kg].
        added_mass: Mass of the air that moves along in surge, sway and heave [kg].
        drag: Linear drag in surge, sway and heave [N s/m].
        yaw_inertia: Moment of inertia about the vertical, the air's included [kg m^2].
        yaw_drag: Linear drag about the vertical [N m s/rad].
    """

    mass: Positive = 0.1249
    added_mass: list[float] = field(default_factory=lambda: [0.0466, 0.0466, 0.0545])
    drag: list[float] = field(default_factory=lambda: [0.0125, 0.0125, 0.0480])
    yaw_inertia: Positive = 0.005821
    yaw_drag: NotNegative = 0.000862

    def __post_init__(self) -> None:
        check_fields(self)
        check_parameter("added_mass", self.added_mass, size=3, zero_allowed=True)
        check_parameter("drag", self.drag, size=3, zero_allowed=True)

    @property
    def effective_masses(self) -> tuple[float, float, float]:
        """The masses (m_x, m_y, m_z) that surge, sway and heave forces move [kg]."""
        m_x, m_y, m_z = (self.mass + added for added in self.added_mass)
        return m_x, m_y, m_z

    def to_vector(self) -> list[float]:
        """The parameters as the context holds them, in the order of the fields."""
        return [
            self.mass,
            *self.added_mass,
            *self.drag,
            self.yaw_inertia,
            self.yaw_drag,
        ]


# With the scope given, Drake need not inspect the stack for it, which is slow.
@TemplateSystem.define(  # type: ignore[untyped-decorator]
    "Blimp_", scope=sys.modules[__name__]
)
def Blimp_(T: type) -> type:
    """Makes the class Blimp_[T] for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """The blimp benchmark (E76): neutrally buoyant, upright, no roll or pitch.

        Ports:
            input (3): surge force [N], heave force [N], yaw moment [N m].
            disturbance (3), optional: acceleration along x, y and z [m/s^2].
            state (8): x, y, z [m], yaw [rad], their inertial rates [m/s, rad/s].

        The context holds the physical parameters, in the order of BlimpParameters.
        """

        state_names = ("x", "y", "z", "yaw", "vx", "vy", "vz", "yaw_rate")
        wrapped_states = ("yaw",)
        state_units = (*3 * ("m",), "rad", *3 * ("m/s",), "rad/s")
        input_names = ("surge_force", "heave_force", "yaw_moment")
        input_units = ("N", "N", "N m")
        disturbance_names = ("d_x", "d_y", "d_z")
        disturbance_units = 3 * ("m/s²",)
        position_indices = (0, 1, 2)

        def _construct(
            self, parameters: BlimpParameters | None = None, converter: Any = None
        ) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            check_type("parameters", parameters, BlimpParameters | None)
            self._parameters = copy.deepcopy(parameters) or BlimpParameters()
            self.DeclareNumericParameter(BasicVector_[T](self._parameters.to_vector()))
            self._input = self.DeclareVectorInputPort("input", 3)
            self._disturbance = self.DeclareVectorInputPort("disturbance", 3)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(4, 4, 0))

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, parameters=other._parameters, converter=converter)

        def make_manoeuvres(
            self, lower: Array, upper: Array, delta: float, period: float
        ) -> list[Manoeuvre]:
            """Returns the backup manoeuvres, if heave is stronger than d."""
            return blimp_climbs(self._parameters, lower, upper, delta, period)

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            """The right-hand side of (E76), for unequal surge and sway too."""
            state = context.get_continuous_state_vector().CopyToVector()
            _, _, _, yaw, vx, vy, vz, r = state.tolist()
            f_x, f_z, tau = self._input.Eval(context).tolist()
            disturbed = self._disturbance.HasValue(context)
            d = self._disturbance.Eval(context).tolist() if disturbed else 3 * [0.0]
            p = context.get_numeric_parameter(0).CopyToVector().tolist()
            mass, added_x, added_y, added_z, D_x, D_y, D_z, I_z, D_r = p
            m_x, m_y, m_z = mass + added_x, mass + added_y, mass + added_z
            c, s = cos(yaw), sin(yaw)

            # What unequal surge and sway add to (E76), in body axes: surge and sway
            # accelerations and the Munk moment. Equal ones make the factors exact
            # zeros, so that a symbolic f is then free of yaw and yaw rate.
            surge, sway = c * vx + s * vy, c * vy - s * vx
            a_surge = (m_y - m_x) / m_x * (r * sway)
            a_sway = (m_y - m_x) / m_y * (r * surge) + (D_x / m_x - D_y / m_y) * sway
            munk_moment = (m_x - m_y) * (surge * sway)

            thrust = f_x / m_x + a_surge
            rate = [
                *(vx, vy, vz, r),
                c * thrust - s * a_sway - D_x / m_x * vx + d[0],
                s * thrust + c * a_sway - D_x / m_x * vy + d[1],
                (f_z - D_z * vz) / m_z + d[2],
                (tau + munk_moment - D_r * r) / I_z,
            ]
            derivatives.get_mutable_vector().SetFromVector(np.array(rate))

    return Impl


Blimp = Blimp_[None]


@dataclass
class BlimpControllerParameters(Checked):
    """Gains and caps of the blimp's controller (E81, the blimp's controller).

    Attributes:
        surge_gain: k_v, from surge speed error to surge force [N s/m].
        position_gain: k_x, from distance to surge speed [1/s].
        heave_gain: k_w, from heave speed error to heave force [N s/m].
        height_gain: k_z, from height error to heave speed [1/s].
        yaw_gain: k_ψ, from heading error to yaw moment [N m/rad].
        yaw_rate_gain: k_r, from yaw rate to yaw moment [N m s/rad].
        drift_gain: k_s, from sideways drift to the lean of the heading against it:
            ours. 0 is the law as the paper prints it, which circles its target.
        surge_speed_cap: The largest surge speed reference [m/s].
        height_error_cap: The largest height error that the law uses [m].
    """

    surge_gain: NotNegative = 0.35
    position_gain: NotNegative = 0.5
    heave_gain: NotNegative = 0.35
    height_gain: NotNegative = 0.5
    yaw_gain: NotNegative = 0.03
    yaw_rate_gain: NotNegative = 0.02
    drift_gain: NotNegative = 0.0
    surge_speed_cap: PositiveOrInfinite = math.inf
    height_error_cap: PositiveOrInfinite = math.inf


class BlimpController(StateFeedback):
    """Steers the blimp to a target and stops it there (E81).

    With k_s = 0 and no caps this is the published law with signed surge and yaw damping
    (R39 - R41), which circles the target: sway has no force, and little drag. The lean
    of the heading against the drift is ours. Its ports are those of `StateFeedback`.

    Args:
        target: The target position (x, y, z) [m].
        parameters: Gains and caps; the defaults if None.
        plant_parameters: The blimp's parameters; the defaults if None.
    """

    @typed
    def __init__(
        self,
        target: ArrayLike,
        parameters: BlimpControllerParameters | None = None,
        plant_parameters: BlimpParameters | None = None,
    ) -> None:
        super().__init__(self._steer, 8, 3, 3)
        self._target = checked_target(target, 3)
        self._parameters = copy.copy(parameters) or BlimpControllerParameters()
        self._masses = (plant_parameters or BlimpParameters()).effective_masses

    def _steer(self, state: Array, estimate: Array) -> list[float]:
        p = self._parameters
        x, y, z, yaw, vx, vy, vz, yaw_rate = state.tolist()
        dx, dy = self._target[0] - x, self._target[1] - y
        distance = max(math.hypot(dx, dy), NEAR)

        approach_rate = min(p.position_gain, p.surge_speed_cap / distance)
        wanted_x, wanted_y = approach_rate * dx, approach_rate * dy
        surge_speed_error = forward_component(vx - wanted_x, vy - wanted_y, yaw)

        drift_rate = (dx * vy - dy * vx) / distance**2
        lean = p.drift_gain * drift_rate
        yaw_error = heading_error(wanted_x + lean * dy, wanted_y - lean * dx, yaw)

        height_error = z - self._target[2]
        height_error = max(-p.height_error_cap, min(height_error, p.height_error_cap))
        heave_speed_error = vz + p.height_gain * height_error

        m_x, _, m_z = self._masses
        estimate_ahead = forward_component(estimate[0], estimate[1], yaw)
        return [
            -p.surge_gain * surge_speed_error - m_x * estimate_ahead,
            -p.heave_gain * heave_speed_error - m_z * estimate[2],
            -p.yaw_gain * (yaw_error if distance > NEAR else 0.0)
            - p.yaw_rate_gain * yaw_rate,
        ]


@dataclass
class BlimpVehicle(BlimpParameters, Vehicle):
    """A `Blimp` that a `BlimpController` flies: the parameters of both.

    Attributes:
        controller: Gains and caps of the controller (E81, the blimp's controller).
    """

    controller: BlimpControllerParameters = field(
        default_factory=BlimpControllerParameters
    )

    position = Blimp.position_indices
    heading = 3
    length = 0.77  # The length of the envelope, without the fins [m].

    def make_plant(self) -> System:
        """Returns the blimp."""
        return Blimp(self)

    def geometry(self, color: str) -> list[Part]:
        """Returns an airship with its envelope in a colour."""
        return [Part("airship", painted_model("blimp", color))]

    def make_controller(self, target: Sequence[float]) -> BlimpController:
        """Returns the controller that flies the blimp to a target."""
        return BlimpController(target, self.controller, self)

    def altered(self, mass: float, drag: float) -> "BlimpVehicle":
        """Returns a blimp of other mass, inertia and drag; see `Vehicle`."""
        return replace(
            self,
            mass=mass * self.mass,
            added_mass=[mass * each for each in self.added_mass],
            drag=[drag * each for each in self.drag],
            yaw_inertia=mass * self.yaw_inertia,
            yaw_drag=drag * self.yaw_drag,
        )
