"""Controllers in Python: functions of the state, and a heading's geometry."""

from __future__ import annotations

from collections.abc import Callable
import math

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vcbf_drake.checks import finite_array, require
from vcbf_drake.typed import typed

# Nearer than this, the direction to the target is meaningless and the heading is kept
# [m] (R39).
NEAR = 0.05


class StateFeedback(LeafSystem):
    """A controller that is a function of the state, in Python.

    Ports:
        state (n): the vehicle's state.
        disturbance_estimate (q), optional, if q > 0: dhat; 0 if not connected.
        reference (m), output: the reference input.

    Args:
        law: From the state, shape (n,), to the input, shape (m,); if q > 0, from the
            state and the estimate, shape (q,).
        num_states: n.
        num_inputs: m.
        num_disturbances: q.
    """

    @typed
    def __init__(
        self,
        law: Callable[..., ArrayLike],
        num_states: int,
        num_inputs: int,
        num_disturbances: int = 0,
    ) -> None:
        super().__init__()
        self._law, self._size = law, num_inputs
        ports = [self.DeclareVectorInputPort("state", num_states)]
        if num_disturbances:
            estimate = "disturbance_estimate"
            ports.append(self.DeclareVectorInputPort(estimate, num_disturbances))
        self._ports, needs = ports, {each.ticket() for each in ports}
        self.DeclareVectorOutputPort("reference", num_inputs, self._calc, needs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state, *optional = self._ports
        estimates = (
            port.Eval(context) if port.HasValue(context) else np.zeros(port.size())
            for port in optional
        )
        found = self._law(state.Eval(context), *estimates)
        try:
            numbers = np.asarray(found, dtype=float)
        except (TypeError, ValueError):  # Words, or lists of different lengths.
            numbers = np.array(math.nan)
        is_input, rule = numbers.shape == (self._size,), f"{self._size} numbers"
        require(is_input, "what the law returns", found, rule)
        output.SetFromVector(numbers)


def checked_target(target: ArrayLike, size: int) -> list[float]:
    """Returns a target position of `size` finite numbers [m]."""
    rule = f"{size} finite numbers"
    place = finite_array(target, "target", 1, rule)
    require(place.shape == (size,), "target", target, rule)
    found: list[float] = place.tolist()
    return found


def forward_component(x: float, y: float, heading: float) -> float:
    """The component of the vector (x, y) along the heading, in the vector's unit."""
    return x * math.cos(heading) + y * math.sin(heading)


def heading_error(x: float, y: float, heading: float) -> float:
    """The angle from the direction of (x, y) to the heading, in [-π, π] [rad] (R39)."""
    return math.remainder(heading - math.atan2(y, x), 2.0 * math.pi)
