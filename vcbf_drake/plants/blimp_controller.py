"""The blimp's reference input: fly to a point."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

import copy
from dataclasses import dataclass
import math
from typing import Any

from numpy.typing import ArrayLike
from pydrake.systems.framework import LeafSystem

from vcbf_drake.checks import check_parameter
from vcbf_drake.plants.blimp import BlimpParameters
from vcbf_drake.plants.target import (
    NEAR,
    check_target,
    forward_component,
    heading_error,
)
from vcbf_drake.typed import check_fields, typed


@dataclass
class BlimpControllerParameters:
    """Gains and caps of the blimp's controller (E81, the blimp's controller).

    Attributes:
        surge_gain: k_v, from surge speed error to surge force [N s/m].
        position_gain: k_x, from distance to surge speed [1/s].
        heave_gain: k_w, from heave speed error to heave force [N s/m].
        height_gain: k_z, from height error to heave speed [1/s].
        yaw_gain: k_ψ, from heading error to yaw moment [N m/rad].
        yaw_rate_gain: k_r, from yaw rate to yaw moment [N m s/rad].
        drift_gain: k_s, how far the heading leans against sideways drift: ours. 0 is
            the law as the paper prints it, which circles its target.
        surge_speed_cap: The highest surge speed asked for [m/s].
        height_error_cap: The largest height error acted on [m].
    """

    surge_gain: float = 0.35
    position_gain: float = 0.5
    heave_gain: float = 0.35
    height_gain: float = 0.5
    yaw_gain: float = 0.03
    yaw_rate_gain: float = 0.02
    drift_gain: float = 0.0
    surge_speed_cap: float = math.inf
    height_error_cap: float = math.inf

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in vars(self).items():
            is_cap = name.endswith("_cap")
            check_parameter(
                name,
                value,
                zero_allowed=not is_cap,
                infinity_allowed=is_cap,
            )


class BlimpController(LeafSystem):
    """Steers the blimp to a target and stops it there (E81).

    With v_w = min(k_x, cap / e_d) (p_t - p) the horizontal velocity that is wanted, v
    the one there is, v_n its component across the line of sight to the target, and ψ_w
    the direction of v_w - k_s v_n::

        f_x = k_v (v_w - v) . (cos ψ, sin ψ) - m_x (dhat_x cos ψ + dhat_y sin ψ)
        f_z = -k_w (dz/dt + k_z e_z)         - m_z dhat_z
        τ   = -k_ψ wrap(ψ - ψ_w)             - k_r r

    With k_s = 0 and no caps this is the published law with signed surge and yaw damping
    (R39 - R41), which circles the target: sway has no force, and little drag. The lean
    of the heading against the drift is ours. Within 5 cm of the target ψ_w = ψ.

    Ports:
        state (8): the blimp's state.
        disturbance_estimate (3), optional: dhat [m/s^2]; 0 if not connected.
        reference (3), output: surge force [N], heave force [N], yaw moment [N m].

    Args:
        target: Where to go, (x, y, z) [m].
        parameters: Gains and caps; the defaults if None.
        plant_parameters: The blimp's parameters; the defaults if None.

    Raises:
        ValueError: A number is not finite, or out of range.
    """

    @typed
    def __init__(
        self,
        target: ArrayLike,
        parameters: BlimpControllerParameters | None = None,
        plant_parameters: BlimpParameters | None = None,
    ) -> None:
        super().__init__()
        self._target = check_target(target, 3)
        self._parameters = copy.copy(parameters) or BlimpControllerParameters()
        self._masses = (plant_parameters or BlimpParameters()).effective_masses
        self._state = self.DeclareVectorInputPort("state", 8)
        self._estimate = self.DeclareVectorInputPort("disturbance_estimate", 3)
        self.DeclareVectorOutputPort(
            "reference",
            3,
            self._calc_reference,
            {self._state.ticket(), self._estimate.ticket()},
        )

    def _calc_reference(self, context: Any, output: Any) -> None:
        state = self._state.Eval(context).tolist()
        connected = self._estimate.HasValue(context)
        estimate = self._estimate.Eval(context).tolist() if connected else 3 * [0.0]
        output.SetFromVector(self._reference(state, estimate))

    def _reference(self, state: list[float], estimate: list[float]) -> list[float]:
        """The law (E81), with its caps and the compensation of the estimate."""
        p = self._parameters
        x, y, z, yaw, vx, vy, vz, yaw_rate = state
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
