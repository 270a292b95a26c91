"""Limits on the input that depend on the state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.finite_vector import finite_vector
from vcbf_drake.checks import Array
from vcbf_drake.model.compiled import Expressions

LimitFunction: TypeAlias = Callable[
    [Expressions, Expression, Expressions], tuple[Expressions, Expression]
]


class StateInputLimit:
    """The constraint row(x, t) u <= bound(x, t): a row of relative degree 0.

    Attributes:
        function: ``function(x, t, p)`` returns the row (m,) and its bound, symbolic in
            the state x (n,), the time t [s] and the parameters p (k,).
        parameters: The values of p, shape (k,).
        name: What error messages and logs call it.
    """

    def __init__(
        self,
        function: LimitFunction,
        parameters: Sequence[float] | Array = (),
        name: str = "limit",
    ) -> None:
        """Checks the parameters.

        Raises:
            ValueError: A parameter is not finite.
        """
        self.function = function
        self.parameters = finite_vector(parameters, f"parameters of limit '{name}'")
        self.name = name


def ackermann_limit(
    curvature: float,
    smoothing_speed: float,
    *,
    speed_state: int = 2,
    turn_rate_input: int = 1,
    num_inputs: int = 2,
    name: str = "turn rate",
) -> tuple[StateInputLimit, StateInputLimit]:
    """Returns both sides of ``|omega| <= curvature sqrt(v^2 + smoothing_speed^2)``.

    A car whose wheels steer turns no tighter than its smallest circle (R46). The
    smoothing speed keeps the limit differentiable at v = 0, and lets the car turn
    slightly on the spot; the defaults are those of `Car`.

    Args:
        curvature: One over the radius of the smallest circle [1/m].
        smoothing_speed: Positive [m/s].
        speed_state: Which state is the speed v [m/s].
        turn_rate_input: Which input is the turn rate omega [rad/s].
        num_inputs: How many inputs the model has.
        name: What error messages and logs call it.

    Raises:
        ValueError: The curvature or the smoothing speed is not positive and finite,
            or the model has no such input.
    """
    for value, what in (
        (curvature, "curvature"),
        (smoothing_speed, "smoothing_speed"),
    ):
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"limit '{name}': {what} must be positive, got {value}")
    if not 0 <= turn_rate_input < num_inputs:
        raise ValueError(
            f"limit '{name}': turn_rate_input must be in 0..{num_inputs - 1},"
            f" got {turn_rate_input}"
        )
    function = _turn_rate_limit(speed_state, turn_rate_input, num_inputs)
    left, right = (
        StateInputLimit(
            function, (sign, curvature, smoothing_speed), f"{name} ({side})"
        )
        for sign, side in ((1.0, "left"), (-1.0, "right"))
    )
    return left, right


def _turn_rate_limit(
    speed_state: int, turn_rate_input: int, num_inputs: int
) -> LimitFunction:
    """Returns the limit with p = (sign, curvature, smoothing speed)."""

    def limit(
        x: Expressions, t: Expression, p: Expressions
    ) -> tuple[Expressions, Expression]:
        sign, curvature, smoothing_speed = p
        row = np.zeros(num_inputs, dtype=object)
        row[turn_rate_input] = sign
        return row, curvature * (x[speed_state] ** 2 + smoothing_speed**2) ** 0.5

    return limit
