"""Barriers of shapes that a Drake Trajectory carries along."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import factorial
from typing import Any

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import BarrierFunction, ChangingBarrier
from vcbf_drake.checks import Array
from vcbf_drake.model.compiled import Expressions


class TrajectoryBarrier(ChangingBarrier):
    """A barrier whose shape is where a trajectory is; its `parameters` are those at 0.

    At each tick the trajectory is its Taylor polynomial there (E13): place, velocity,
    acceleration and as many derivatives as rows and their gradients have, so these are
    exact at the tick, whatever the trajectory is made of.

    Attributes:
        trajectory: The trajectory.
    """

    def __init__(
        self,
        function: BarrierFunction,
        gains: Sequence[float] | Array,
        parameters: Sequence[float],
        trajectory: Any,
        name: str,
        of_position: int | None,
    ) -> None:
        """Takes a trajectory.

        Args:
            function: h(x, t, p), with p = (parameters, time, coefficients).
            gains: K of (E4, gains and decay rates).
            parameters: The shape's.
            trajectory: Of the shape's place, in k dimensions.
            name: What error messages and logs call it.
            of_position: As of a `Barrier`.

        Raises:
            ValueError: Bad gains.
        """
        self.trajectory = trajectory
        self._order = len(gains) + 1
        self._fixed = tuple(parameters)
        at_start = self.parameters_at(0.0, None)
        super().__init__(function, gains, at_start, name, of_position=of_position)

    def parameters_at(self, t: float, obstacles: Array | None) -> tuple[float, ...]:
        """Returns the parameters; before its start and after its end it stands."""
        trajectory, start = self.trajectory, self.trajectory.start_time()
        within = start <= t <= trajectory.end_time()
        place = trajectory.value(min(max(t, start), trajectory.end_time()))
        coefficients = [place.ravel()] + [
            trajectory.EvalDerivative(t, i).ravel() / factorial(i)
            if within
            else np.zeros(place.size)
            for i in range(1, self._order + 1)
        ]
        return (*self._fixed, t, *np.concatenate(coefficients).tolist())


def carried(
    formula: BarrierFunction, size: int, order: int
) -> Callable[[Expressions, Expression, Expressions], Expression]:
    """Returns h(position - c(t), t, p) with p = (shape's, t0, coefficients of c).

    Args:
        formula: The shape's.
        size: In how many dimensions.
        order: The degree of the Taylor polynomial.
    """

    def h(position: Expressions, t: Expression, p: Expressions) -> Expression:
        split = len(p) - 1 - size * (order + 1)
        since = t - p[split]
        coefficients = p[split + 1 :].reshape(order + 1, size)
        place = coefficients[-1]
        for row in coefficients[-2::-1]:
            place = row + since * place
        return formula(position - place, t, p[:split])

    return h
