"""The numbers of a scenario: finite, of the right sign, of a size to calculate with."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
import math
from typing import Any

import numpy as np

from vcbf_drake.safety.volume_barrier import VolumeBarrier
from vcbf_drake.simulation.invalid_field import KeyPath, ask, require
from vcbf_drake.simulation.scenario import (
    BarrierGains,
    Hardware,
    Integrator,
    MeasurementNoise,
    Obstacle,
    Scenario,
    TurnLimit,
)

# No quantity is as large, in SI units; a product of a few such numbers is still finite.
_LARGEST = 1e15

_POSITIVE = {
    BarrierGains: {"gains"},
    Hardware: {"brake_rate", "command_timeout", "max_state_age", "longest_interval"},
    Obstacle: {"radius"},
    Scenario: {"duration", "arrival_tolerance"},
    TurnLimit: {"curvature", "smoothing_speed"},
    VolumeBarrier: {"threshold", "gain", "slack_penalty"},
}
_NON_NEGATIVE = {
    Hardware: {"hold_time"},
    Integrator: {"max_step"},
    MeasurementNoise: {"std", "seed"},
    Obstacle: {"margin"},
}


def check_magnitudes(value: Any, path: KeyPath = ()) -> None:
    """Checks that every number below a value is of a size to calculate with."""
    if is_dataclass(value):
        for name in (each.name for each in fields(value)):
            check_magnitudes(getattr(value, name), (*path, name))
    elif isinstance(value, list | tuple | np.ndarray):
        for index, item in enumerate(value):
            check_magnitudes(item, (*path, index))
    elif isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
        require(abs(value) <= _LARGEST, path, value, f"at most {_LARGEST:g} in size")


def check_numbers(value: Any, path: KeyPath = (), sign: str = "") -> None:
    """Checks every number below a value; parts that check themselves are asked to."""
    if hasattr(value, "validate"):
        ask(value.validate, value, path)
    elif is_dataclass(value):
        for name in (each.name for each in fields(value)):
            positive = name in _POSITIVE.get(type(value), ())
            non_negative = name in _NON_NEGATIVE.get(type(value), ())
            sign = "above 0" if positive else "not below 0" if non_negative else ""
            check_numbers(getattr(value, name), (*path, name), sign)
    elif isinstance(value, list | tuple | np.ndarray):
        for index, item in enumerate(value):
            check_numbers(item, (*path, index), sign)
    elif isinstance(value, int | float):
        require(math.isfinite(value), path, value, "finite")
        allowed = value > 0 if sign == "above 0" else value >= 0 or not sign
        require(allowed, path, value, sign)
