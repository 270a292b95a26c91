"""How far a coordinate is beyond an interval, smoothly."""

from __future__ import annotations

from typing import Any


def smooth_excess(z: Any, half: Any, smoothing: Any) -> Any:
    """Returns a smooth bound from above on how far z is beyond [-half, half].

    The sum of a smooth positive part at either end, with the smoothing length e::

        s(z) = (sqrt((z - a)^2 + e^2) + sqrt((z + a)^2 + e^2)) / 2 - a

    It is positive and has all derivatives. It exceeds max(|z| - a, 0) everywhere, most
    at the ends, by s(a), which is between e/2 and e. Source: ours.

    Args:
        z: The coordinate, a number, an expression or an array of either [m].
        half: The half-width a [m].
        smoothing: The length e over which an end is rounded [m].
    """
    below = ((z + half) ** 2 + smoothing**2) ** 0.5
    above = ((z - half) ** 2 + smoothing**2) ** 0.5
    return (below + above) / 2 - half
