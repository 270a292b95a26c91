"""What a vehicle applies when no valid command comes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import InputSet

Fallback = Literal["zero", "brake"]
FALLBACKS: tuple[Fallback, ...] = ("zero", "brake")


def fallback_input(
    kind: str,
    model: ControlAffineModel,
    input_set: InputSet,
    x: Array,
    brake_rate: float,
) -> Array:
    """Returns the input of a vehicle that is left alone, inside its limits.

    ``zero`` is no input. ``brake`` takes off the speed v = E⁺ x, the states that a
    disturbance acts on, by E⁺ (f + g u) = -brake_rate v, or comes nearest to it in the
    sense of least squares. Source: ours.

    Args:
        kind: One of `FALLBACKS`.
        model: The vehicle's f, g, E.
        input_set: What its actuators can do.
        x: Its state, shape (n,).
        brake_rate: How fast the speed decays [1/s].
    """
    if kind == "zero":
        return input_set.project(np.zeros(model.num_inputs))
    speed_of = np.linalg.pinv(model.disturbance_matrix)
    f, g = model.drift_and_input_matrix(x)
    u, *_ = np.linalg.lstsq(speed_of @ g, -speed_of @ (brake_rate * x + f), rcond=None)
    return input_set.project(u)
