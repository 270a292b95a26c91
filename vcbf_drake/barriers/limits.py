"""Limits of one state, and limits of the input that depend on the state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.checks import Array, check_parameter, finite_vector, require
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.typed import Positive, check_fields, check_type, typed

LimitFunction: TypeAlias = Callable[
    [Expressions, Expression, Expressions], tuple[Expressions, Expression]
]


class StateInputLimit:
    """The constraint row(x, t) u <= bound(x, t): a row of relative degree 0.

    Attributes:
        function: ``function(x, t, p)`` returns the row (m,) and its bound, symbolic in
            the state x (n,), the time t [s] and the parameters p (k,).
        parameters: The values of p, shape (k,).
        name: Its name in error messages and logs.
    """

    def __init__(
        self,
        function: LimitFunction,
        parameters: Sequence[float] | Array = (),
        name: str = "limit",
    ) -> None:
        check_type("name", name, str)
        rule = "a function of x, t and p"
        require(callable(function), f"function of limit '{name}'", function, rule)
        self.function = function
        self.parameters = finite_vector(parameters, f"parameters of limit '{name}'")
        self.name = name


@dataclass(frozen=True)
class EarlyInputLimit:
    """The limit for a level of a barrier's chain that an input enters early (E8a).

    `BarrierSet` makes it where the relative degree of a barrier is mixed.

    Attributes:
        barrier: The barrier.
        level: The number k of the derivative, below r.
        row: The number of the barrier's own row.
    """

    barrier: Barrier
    level: int
    row: int

    @property
    def name(self) -> str:
        """Its name in error messages and logs."""
        return f"{self.barrier.name} (derivative {self.level})"


@typed
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
        speed_state: The index of the speed v [m/s].
        turn_rate_input: The index of the turn rate omega [rad/s].
        num_inputs: The number of inputs of the model.
        name: Its name in error messages and logs.
    """
    check_parameter(f"limit '{name}': curvature", curvature)
    check_parameter(f"limit '{name}': smoothing_speed", smoothing_speed)
    if not 0 <= turn_rate_input < num_inputs:
        raise ValueError(
            f"limit '{name}': turn_rate_input must be in 0..{num_inputs - 1},"
            f" got {turn_rate_input}"
        )

    def limit(
        x: Expressions, t: Expression, p: Expressions
    ) -> tuple[Expressions, Expression]:
        sign, curvature, smoothing_speed = p
        row = np.zeros(num_inputs, dtype=object)
        row[turn_rate_input] = sign
        return row, curvature * (x[speed_state] ** 2 + smoothing_speed**2) ** 0.5

    left, right = (
        StateInputLimit(limit, (sign, curvature, smoothing_speed), f"{name} ({side})")
        for sign, side in ((1.0, "left"), (-1.0, "right"))
    )
    return left, right


@dataclass(frozen=True)
class StateLimit:
    """The range ``lower <= x_i <= upper`` of one state, such as a speed or a height.

    One smooth barrier per side, in the state's unit::

        h = x_i - lower,    h = upper - x_i

    The relative degree is the number of gains: 1 for a speed that a force changes, 2
    for a position or a joint angle. Source: ours.

    Attributes:
        state: The state's name, in a scenario; its index i elsewhere.
        lower: Least value, in the state's unit; -.inf for none.
        upper: Greatest value; .inf for none.
        gains: K of (E4), one per derivative of the state until the input appears.
    """

    state: str | int
    lower: float = -np.inf
    upper: float = np.inf
    gains: Sequence[Positive] | Array = (1.0,)

    def __post_init__(self) -> None:
        check_fields(self, "state limit: ")
        if not self.lower < self.upper:
            raise ValueError(
                "state limit: lower must be below upper,"
                f" got {self.lower} and {self.upper}"
            )
        if not np.isfinite([self.lower, self.upper]).any():
            raise ValueError("state limit: give lower, upper or both")

    @typed
    def barriers(
        self, gains: Sequence[float] | Array | None = None, name: str = "state limit"
    ) -> list[Barrier]:
        """Returns one barrier per side.

        Args:
            gains: K of (E4) in place of the limit's own.
            name: Its name in error messages and logs; "low" or "high" is added.
        """
        rule = "an index; a scenario alone knows names"
        require(isinstance(self.state, int), "state limit: state", self.state, rule)
        i = int(self.state)

        def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
            sign, limit = p
            return sign * (x[i] - limit)

        sides = (("low", 1.0, self.lower), ("high", -1.0, self.upper))
        gains = self.gains if gains is None else gains
        return [
            Barrier(h, gains, (sign, limit), f"{name} ({side})")
            for side, sign, limit in sides
            if np.isfinite(limit)
        ]
