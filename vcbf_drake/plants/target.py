"""A target point, as seen from a vehicle with a heading."""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from vcbf_drake.checks import finite_array, require

# Nearer than this the direction to the target means nothing, and the heading is left
# as it is [m] (R39).
NEAR = 0.05


def check_target(target: ArrayLike, size: int) -> tuple[float, ...]:
    """Checks that a target has the given number of finite coordinates [m].

    Raises:
        ValueError: It does not.
    """
    rule = f"{size} finite numbers"
    array = finite_array(target, "target", 1, rule)
    require(array.shape == (size,), "target", target, rule)
    return tuple(array.tolist())


def forward_component(x: float, y: float, heading: float) -> float:
    """The component of the vector (x, y) along the heading, in the vector's unit."""
    return x * math.cos(heading) + y * math.sin(heading)


def heading_error(x: float, y: float, heading: float) -> float:
    """The angle from the direction of (x, y) to the heading, in [-π, π] [rad] (R39)."""
    return math.remainder(heading - math.atan2(y, x), 2.0 * math.pi)
