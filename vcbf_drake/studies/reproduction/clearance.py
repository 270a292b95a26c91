"""The closed-form reading of a clearance: what a method's caution is worth in metres.

While a barrier's row acts, (E7) holds with equality,

    d²h/dt² + k1 dh/dt + k2 h = n·d - Λ,

where n is the normal of the distance barrier. A steady right side keeps h at
(n·d - Λ) / k2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.safety import METHODS
from vcbf_drake.simulation.loop import make_loop
from vcbf_drake.simulation.result import Result

# A row acts when the input is this near to its face, in the row's own units [m/s^2].
_TOUCHING = 1e-6


def clearance(result: Result) -> dict[str, Any]:
    """Returns the least h of a run beside what the closed form says of it.

    Args:
        result: A run with one obstacle whose barrier is a distance.

    Returns:
        ``method``; ``law``, the quasi-static clearance; ``least`` and ``greatest``, the
        ends that the method's bounds give it [m]; ``integrated``, the least h of the
        equation, integrated through the contact in which the run came closest, None
        without contact [m]; ``measured`` [m].
    """
    bounds = make_loop(result.scenario).GetSubsystemByName("disturbance").bounds
    k2 = result.scenario.barrier.gains[1]
    caution = _caution(result, bounds)
    law, least, greatest = {
        "ignored": ("n·d / k2", -bounds.delta1, bounds.delta1),
        "worst_case": ("(n·d + δ1) / k2", 0.0, 2.0 * bounds.delta1),
        "estimated": ("(n·(d - d̂) + ε) / k2", 0.0, 2.0 * float(caution[-1])),
    }[_handling(result)]
    return {
        "method": result.scenario.method,
        "law": law,
        "least": least / k2,
        "greatest": greatest / k2,
        "integrated": _integrated(result, caution),
        "measured": result.summary["min_barrier"],
    }


def _handling(result: Result) -> str:
    return METHODS[result.scenario.method].disturbance


def _caution(result: Result, bounds: DisturbanceBounds) -> Array:
    """What a row adds to be safe against the unknown, one number a tick [m/s^2]."""
    error_bound: Array = result.log["error_bound"]
    if _handling(result) == "ignored":
        return np.zeros_like(error_bound)
    if _handling(result) == "worst_case":
        return np.full_like(error_bound, bounds.delta1)
    if result.scenario.corrections.error_floor:
        return error_bound + bounds.delta2 * result.scenario.period
    return error_bound


def _integrated(result: Result, caution: Array) -> float | None:
    log, (k1, k2) = result.log, result.scenario.barrier.gains
    h = log["barriers"][:, 0]
    contact = _closest_contact(h, _row_acts(result))
    if contact is None:
        return None
    normal = log["state"][:, :3] - np.array(result.scenario.obstacles[0].center)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    unknown = log["disturbance"]
    if _handling(result) == "estimated":
        unknown = unknown - log["disturbance_estimate"]
    right_side = np.sum(normal * unknown, axis=1) + caution
    value = h[contact.start]
    rate = float(normal[contact.start] @ log["state"][contact.start, 4:7])
    least = value
    for tick in range(contact.start, contact.stop):
        rate += result.scenario.period * (right_side[tick] - k1 * rate - k2 * value)
        value += result.scenario.period * rate
        least = min(least, value)
    return float(least)


def _row_acts(result: Result) -> NDArray[np.bool_]:
    """At which ticks the input lies on the face of the obstacle's row."""
    A, b = result.log["polytope_A"][:, -1], result.log["polytope_b"][:, -1]
    acts: NDArray[np.bool_] = b - np.sum(A * result.log["input"], axis=1) < _TOUCHING
    return acts


def _closest_contact(h: Array, acts: NDArray[np.bool_]) -> slice | None:
    """The unbroken contact in which h is least."""
    touching = np.flatnonzero(acts)
    if not len(touching):
        return None
    closest = touching[np.argmin(h[touching])]
    free = np.flatnonzero(~acts)
    before, after = free[free < closest], free[free > closest]
    start = int(before[-1]) + 1 if len(before) else 0
    return slice(start, int(after[0]) if len(after) else len(h))
