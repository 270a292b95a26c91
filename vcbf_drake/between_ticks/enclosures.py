"""Certified enclosures of rows over boxes, and of the state during a hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from vcbf_drake.barriers.barrier_set import BarrierSet
from vcbf_drake.barriers.rows import RowFunctions
from vcbf_drake.between_ticks.interval import (
    Interval,
    Number,
    as_interval,
    hull,
    interval_function,
)
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel
from vcbf_drake.model.formulas import CompiledFunction

_Ends = list[tuple[float, float]]

# The excess width of a guess, relative to the motion of the state.
_INFLATION = 0.1
_ATTEMPTS = 10


class RowEnclosures:
    """The entries [A, b, w] of N rows, their derivatives and h, over boxes [x; t].

    Each method returns the least and the greatest values; infinite ones where a row is
    singular somewhere in the box.
    """

    def __init__(self, functions: Sequence[RowFunctions], num_entries: int) -> None:
        """Takes the rows' functions.

        Args:
            functions: The functions of every row.
            num_entries: m + 1 + q.
        """
        self._functions = functions
        self._num_entries = num_entries

    @staticmethod
    def at(
        barriers: BarrierSet, t: float, obstacles: Array | None = None
    ) -> RowEnclosures:
        """Returns the enclosures of a set's rows.

        Args:
            barriers: The rows.
            t: The time for which obstacles are perceived [s].
            obstacles: The perceived obstacles at that time, shape (obstacles_size,).

        Raises:
            ModelError: A row has no enclosure on intervals; the message names it.
            ValueError: obstacles has another shape.
        """
        if barriers.followed:
            raise ModelError(
                f"'{barriers.followed[0]}': no enclosure between ticks, for it moves"
                " along a trajectory"
            )
        functions = barriers.functions_at(t, obstacles)
        for name, each in zip(barriers.names, functions, strict=True):
            try:
                interval_function(each.row)
                interval_function(each.gradient)
            except ModelError as error:
                raise ModelError(f"'{name}': {error}") from None
        return RowEnclosures(functions, barriers.num_entries)

    def entries(self, box: Sequence[Interval]) -> tuple[Array, Array]:
        """Encloses every row's entries, shape (N, m + 1 + q).

        Args:
            box: The box of [x; t], n + 1 intervals.
        """
        k = self._num_entries
        rows = [_ends(each.row, box, each.constants, k) for each in self._functions]
        return _low_and_high(rows, (len(rows), k))

    def gradients(
        self, box: Sequence[Interval], rows: Sequence[int]
    ) -> tuple[Array, Array]:
        """Encloses some rows' derivatives, shape (len(rows), m + 1 + q, n + 1).

        Args:
            box: The box of [x; t], n + 1 intervals.
            rows: Which rows.
        """
        k, size = self._num_entries, len(box)
        chosen = [self._functions[row] for row in rows]
        found = [_ends(each.gradient, box, each.constants, k * size) for each in chosen]
        return _low_and_high(found, (len(rows), k, size))

    def values(self, box: Sequence[Interval]) -> tuple[Array, Array]:
        """Encloses every h, shape (N,); infinite for a limit.

        Args:
            box: The box of [x; t], n + 1 intervals.
        """
        values = [
            _ends(each.value, box, each.parameters, 1)
            if each.relative_degree
            else [(-math.inf, math.inf)]
            for each in self._functions
        ]
        return _low_and_high(values, (len(values),))


def _ends(
    function: CompiledFunction,
    box: Sequence[Interval],
    constants: Sequence[float],
    size: int,
) -> _Ends:
    """Encloses a function's first numbers; infinite where it is singular."""
    try:
        numbers = interval_function(function)(*box, *constants)[:size]
    except (ArithmeticError, ValueError):
        return [(-math.inf, math.inf)] * size
    return [(n.low, n.high) for n in map(as_interval, numbers)]


def _low_and_high(rows: list[_Ends], shape: tuple[int, ...]) -> tuple[Array, Array]:
    ends = np.array(rows, dtype=float).reshape(*shape, 2)
    return ends[..., 0], ends[..., 1]


def nominal_rate_over(
    model: ControlAffineModel, box: Sequence[Number], inputs: Sequence[Number]
) -> list[Number]:
    """Encloses f(x) + g(x) u, n entries, for all states and inputs of a box.

    Args:
        model: The plant.
        box: The box of x, n intervals or numbers.
        inputs: The box of u, m of them.

    Raises:
        ModelError: f or g has no enclosure on intervals.
        ArithmeticError: f or g is singular somewhere in the box.
        ValueError: f or g has no real value somewhere in the box.
    """
    return interval_function(model.compiled_rate)(*box, *inputs)


@dataclass(frozen=True)
class ReachTube:
    """A box that holds the state for a while, and its rates there.

    Attributes:
        states: The box of the state, n intervals.
        rates: The box of dx/dt, n intervals or numbers.
    """

    states: list[Interval]
    rates: list[Number]


def reach_tube(
    model: ControlAffineModel,
    start: Sequence[Number],
    inputs: Sequence[Number],
    disturbances: Sequence[Number],
    duration: float,
) -> ReachTube:
    """Returns a tube that the state does not leave for a while (E84, the reach tube).

    By Picard and Lindeloef: where the rates inside a box lead from the start, in any
    time up to the duration, to points of that box only, no run leaves it.

    Args:
        model: The plant.
        start: The box of the initial state, n intervals or numbers.
        inputs: The box of the input, m of them.
        disturbances: The box of the disturbance, q of them.
        duration: The duration [s].

    Raises:
        ModelError: The model has no enclosure.
        ArithmeticError: The model is singular there, or moves too far for a box.
        ValueError: The model has no real value there.
    """
    elapsed = Interval(0.0, duration)
    box = [as_interval(x) for x in start]
    for _ in range(_ATTEMPTS):
        rates = _rates(model, box, inputs, disturbances)
        reached = [elapsed * rate + x for rate, x in zip(rates, start, strict=True)]
        if all(new in old for new, old in zip(reached, box, strict=True)):
            return ReachTube(reached, rates)
        box = [_widened(*each) for each in zip(box, reached, strict=True)]
    raise ArithmeticError(f"{model.name} moves too far in {duration:g} s for a box")


def _widened(box: Interval, reached: Interval) -> Interval:
    margin = _INFLATION * (reached.high - reached.low)
    return hull(box, Interval(reached.low - margin, reached.high + margin))


def _rates(
    model: ControlAffineModel,
    box: Sequence[Number],
    inputs: Sequence[Number],
    disturbances: Sequence[Number],
) -> list[Number]:
    """Encloses dx/dt = f + g u + E d over a box (E1, the plant)."""
    rates = nominal_rate_over(model, box, inputs)
    for i, row in enumerate(model.disturbance_matrix.tolist()):
        for factor, value in zip(row, disturbances, strict=True):
            if factor != 0.0:  # Most are, and each product costs.
                rates[i] = rates[i] + factor * value
    return rates
