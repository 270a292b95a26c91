"""The car's reference input: drive to a point."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

import copy
from dataclasses import dataclass
import math
from typing import Any

from numpy.typing import ArrayLike
from pydrake.systems.framework import LeafSystem

from vcbf_drake.checks import check_parameter
from vcbf_drake.plants.car import CarParameters
from vcbf_drake.plants.target import (
    NEAR,
    check_target,
    forward_component,
    heading_error,
)
from vcbf_drake.typed import check_fields, typed


@dataclass
class CarControllerParameters:
    """Gains of the car's controller (E82, the car's controller).

    Attributes:
        turn_gain: k_ω, from heading error to turn rate [1/s].
        speed_gain: k_v, from speed error to force [N s/m].
        approach_gain: k_p, from distance to speed [1/s].
    """

    turn_gain: float = 2.0
    speed_gain: float = 4.0
    approach_gain: float = 0.6

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in vars(self).items():
            check_parameter(name, value, zero_allowed=True)


class CarController(LeafSystem):
    """Drives the car to a target and stops it there (E82).

    With p_r - p and e_ψ the offset and the heading error to the target::

        a = -k_v (v - k_p |p_r - p| cos e_ψ) - m dhat
        ω = -k_ω e_ψ

    e_ψ is taken as 0 within 5 cm of the target (R39).

    Ports:
        state (4): the car's state.
        disturbance_estimate (1), optional: dhat [m/s^2]; 0 if not connected.
        reference (2), output: force [N], turn rate [rad/s].

    Args:
        target: Where to go, (x, y) [m].
        parameters: Gains; the defaults if None.
        plant_parameters: The car's parameters; the defaults if None.

    Raises:
        ValueError: A number is not finite, or out of range.
    """

    @typed
    def __init__(
        self,
        target: ArrayLike,
        parameters: CarControllerParameters | None = None,
        plant_parameters: CarParameters | None = None,
    ) -> None:
        super().__init__()
        self._target = check_target(target, 2)
        self._parameters = copy.copy(parameters) or CarControllerParameters()
        self._mass = (plant_parameters or CarParameters()).mass
        self._state = self.DeclareVectorInputPort("state", 4)
        self._estimate = self.DeclareVectorInputPort("disturbance_estimate", 1)
        self.DeclareVectorOutputPort(
            "reference",
            2,
            self._calc_reference,
            {self._state.ticket(), self._estimate.ticket()},
        )

    def _calc_reference(self, context: Any, output: Any) -> None:
        x, y, speed, heading = self._state.Eval(context).tolist()
        connected = self._estimate.HasValue(context)
        (estimate,) = self._estimate.Eval(context).tolist() if connected else [0.0]
        p = self._parameters
        dx, dy = self._target[0] - x, self._target[1] - y
        wanted_speed = p.approach_gain * forward_component(dx, dy, heading)
        force = -p.speed_gain * (speed - wanted_speed) - self._mass * estimate
        near = math.hypot(dx, dy) < NEAR
        turn_rate = 0.0 if near else -p.turn_gain * heading_error(dx, dy, heading)
        output.SetFromVector([force, turn_rate])
