"""What rows take over a box of states and times: enclosures that are certain."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from vcbf_drake.barriers.row_functions import RowFunctions
from vcbf_drake.between_ticks.interval import Interval, as_interval
from vcbf_drake.between_ticks.interval_function import interval_function
from vcbf_drake.checks import Array
from vcbf_drake.model.compiled import CompiledFunction

_Ends = list[tuple[float, float]]


class RowEnclosures:
    """The entries [A, b, w] of N rows, their derivatives and h, over boxes [x; t].

    Each method returns the least and the greatest values; infinite ones where a row is
    singular somewhere in the box.
    """

    def __init__(self, functions: Sequence[RowFunctions], num_entries: int) -> None:
        """Takes the rows' functions.

        Args:
            functions: Of every row.
            num_entries: m + 1 + q.

        Raises:
            ModelError: One of them has no enclosure.
        """
        self._functions = functions
        self._num_entries = num_entries
        for each in functions:
            interval_function(each.row)
            interval_function(each.gradient)

    def entries(self, box: Sequence[Interval]) -> tuple[Array, Array]:
        """Encloses every row's entries, shape (N, m + 1 + q).

        Args:
            box: Where [x; t] is, n + 1 intervals.
        """
        k = self._num_entries
        rows = [_ends(each.row, box, each.constants, k) for each in self._functions]
        return _low_and_high(rows, (len(rows), k))

    def gradients(
        self, box: Sequence[Interval], rows: Sequence[int]
    ) -> tuple[Array, Array]:
        """Encloses some rows' derivatives, shape (len(rows), m + 1 + q, n + 1).

        Args:
            box: Where [x; t] is, n + 1 intervals.
            rows: Which rows.
        """
        k, size = self._num_entries, len(box)
        chosen = [self._functions[row] for row in rows]
        found = [_ends(each.gradient, box, each.constants, k * size) for each in chosen]
        return _low_and_high(found, (len(rows), k, size))

    def values(self, box: Sequence[Interval]) -> tuple[Array, Array]:
        """Encloses every h, shape (N,); infinite for a limit.

        Args:
            box: Where [x; t] is, n + 1 intervals.
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
