"""A controller that steers a vehicle with a heading to a target point."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vcbf_drake.checks import finite_array, require

# Nearer than this, the direction to the target is meaningless and the heading is kept
# [m] (R39).
NEAR = 0.05


class TargetController(LeafSystem):
    """A control law from the state and the disturbance estimate to the input.

    Ports:
        state (n): the vehicle's state.
        disturbance_estimate (q), optional: dhat [m/s^2]; 0 if not connected.
        reference (m), output: the input.

    Args:
        target: The target position, shape (k,) [m].
        plant: The class of the plant, which names its position and its channels.

    Raises:
        ValueError: The target is not k finite numbers.
    """

    def __init__(self, target: ArrayLike, plant: Any) -> None:
        super().__init__()
        size = len(plant.position_indices)
        rule = f"{size} finite numbers"
        place = finite_array(target, "target", 1, rule)
        require(place.shape == (size,), "target", target, rule)
        self._target: list[float] = place.tolist()
        self._state = self.DeclareVectorInputPort("state", len(plant.state_names))
        self._estimate = self.DeclareVectorInputPort(
            "disturbance_estimate", len(plant.disturbance_names)
        )
        needs = {self._state.ticket(), self._estimate.ticket()}
        size = len(plant.input_names)
        self.DeclareVectorOutputPort("reference", size, self._calc, needs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        port, state = self._estimate, self._state.Eval(context).tolist()
        estimate = (
            port.Eval(context).tolist() if port.HasValue(context) else port.size() * [0]
        )
        output.SetFromVector(self._law(state, estimate))

    def _law(self, state: list[float], estimate: list[float]) -> list[float]:
        """Returns the reference input, m numbers."""
        raise NotImplementedError


def forward_component(x: float, y: float, heading: float) -> float:
    """The component of the vector (x, y) along the heading, in the vector's unit."""
    return x * math.cos(heading) + y * math.sin(heading)


def heading_error(x: float, y: float, heading: float) -> float:
    """The angle from the direction of (x, y) to the heading, in [-π, π] [rad] (R39)."""
    return math.remainder(heading - math.atan2(y, x), 2.0 * math.pi)
