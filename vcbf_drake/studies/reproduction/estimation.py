"""How well the observer knows the disturbance, along one run."""

from __future__ import annotations

from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import RiseGains
from vcbf_drake.simulation.loop import make_loop
from vcbf_drake.simulation.result import Result

_SETTLED = 1.0  # The transient from dhat(0) = 0 is over [s].
_ROUNDING = 1e-9


def estimation(result: Result) -> dict[str, Any]:
    """Returns the estimate's errors and how often they exceed their bounds.

    Args:
        result: A run; the observer runs with every method.

    Returns:
        ``greatest_disturbance``; ``greatest_error`` and ``rms_error`` after the first
        second [m/s^2]; the shares of all ticks with an error above the printed bound
        delta1 exp(-lambda_V t / 2) (E13) and above the certified one (E39).
    """
    log, observer = result.log, result.scenario.observer
    time = log["time"]
    error = np.linalg.norm(log["disturbance"] - log["disturbance_estimate"], axis=1)
    gains = RiseGains(observer.alpha, gamma=observer.gamma)
    delta1 = make_loop(result.scenario).GetSubsystemByName("disturbance").bounds.delta1
    printed = delta1 * np.exp(-0.5 * gains.decay_rate * time)
    settled = error[time >= _SETTLED]
    return {
        "greatest_disturbance": float(np.linalg.norm(log["disturbance"], axis=1).max()),
        "greatest_error": float(settled.max()),
        "rms_error": float(np.sqrt(np.mean(settled**2))),
        "above_printed_bound": _share_above(error, printed),
        "above_certified_bound": _share_above(error, log["error_bound"]),
    }


def _share_above(error: Array, bound: Array) -> float:
    return float(np.mean(error > bound + _ROUNDING))
