"""Shapes that a polynomial of time, or a Drake Trajectory, carries along."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import BarrierFunction, arithmetic, is_arithmetic
from vcbf_drake.checks import Array
from vcbf_drake.model.formulas import Expressions


def carried(formula: BarrierFunction, size: int, order: int) -> BarrierFunction:
    """Returns h(position - c(t), t, p) with p = (formula's, t0, coefficients of c).

    Args:
        formula: The formula of a shape.
        size: The number of dimensions.
        order: The degree of the polynomial c in t - t0.
    """

    def h(position: Expressions, t: Expression, p: Expressions) -> Expression:
        split = len(p) - 1 - size * (order + 1)
        since = t - p[split]
        coefficients = p[split + 1 :].reshape(order + 1, size)
        place = coefficients[-1]
        for row in coefficients[-2::-1]:
            place = row + since * place
        return formula(position - place, t, p[:split])

    return arithmetic(h) if is_arithmetic(formula) else h


@dataclass(frozen=True)
class Followed:
    """The parameters of a `carried` barrier whose shape follows a trajectory.

    At each tick the trajectory is replaced by its Taylor polynomial (E13), with every
    derivative that the rows and their gradients contain, so these are exact at the tick
    for any trajectory.

    Attributes:
        trajectory: The trajectory of the shape's position, in k dimensions.
        order: The degree of the polynomial.
        fixed: The shape's own parameters.
    """

    trajectory: Any
    order: int
    fixed: tuple[float, ...]

    def parameters_at(self, t: float, obstacles: Array | None) -> tuple[float, ...]:
        """Returns the parameters; outside its interval the trajectory is at rest."""
        trajectory, start = self.trajectory, self.trajectory.start_time()
        within = start <= t <= trajectory.end_time()
        place = trajectory.value(min(max(t, start), trajectory.end_time()))
        coefficients = [place.ravel()] + [
            trajectory.EvalDerivative(t, i).ravel() / factorial(i)
            if within
            else np.zeros(place.size)
            for i in range(1, self.order + 1)
        ]
        return (*self.fixed, t, *np.concatenate(coefficients).tolist())
