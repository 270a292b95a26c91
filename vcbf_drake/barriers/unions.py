"""Smooth minimum and maximum of several barriers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.checks import check_parameter, require
from vcbf_drake.model.formulas import Expressions


def all_of(barriers: Sequence[Barrier], smoothing: float, name: str = "all") -> Barrier:
    """Returns the smooth minimum of barriers, positive only where all are (E11).

    It keeps clear of a union of obstacles by one row. It is below each h: two barriers
    differ from the exact minimum by at most half the smoothing, and each doubling of
    their number adds another half.

    Args:
        barriers: At least one, of the same gains; without parameters that change.
        smoothing: The length e over which two of them blend, in the unit of h.
        name: Its name in error messages and logs.

    Raises:
        ValueError: There is no barrier, gains differ, or the smoothing is not positive.
    """
    return _combined(barriers, smoothing, name, smooth_minimum)


def any_of(barriers: Sequence[Barrier], smoothing: float, name: str = "any") -> Barrier:
    """Returns the smooth maximum of barriers, positive only where one of them is (E12).

    It keeps inside a union of rooms, or outside a polygon. It is never above the
    greatest h: for two barriers it is below by at most half the smoothing, and each
    doubling of their number adds another half. Arguments and errors as of `all_of`.
    """
    return _combined(barriers, smoothing, name, smooth_maximum)


def smooth_minimum(a: Any, b: Any, smoothing: Any) -> Any:
    """Returns a smooth bound of min(a, b) from below (E11)."""
    return (a + b - ((a - b) ** 2 + smoothing**2) ** 0.5) / 2


def smooth_maximum(a: Any, b: Any, smoothing: Any) -> Any:
    """Returns a smooth bound of max(a, b) from below (E12)."""
    return (a + b + ((a - b) ** 2 + smoothing**2) ** 0.5 - smoothing) / 2


def in_pairs(values: Sequence[Any], smoothing: Any, combine: Any) -> Any:
    """Combines values in pairs, then the results, which keeps the error small."""
    values = list(values)
    while len(values) > 1:
        pairs = [values[i : i + 2] for i in range(0, len(values), 2)]
        values = [
            combine(*pair, smoothing) if len(pair) == 2 else pair[0] for pair in pairs
        ]
    return values[0]


def _combined(
    barriers: Sequence[Barrier], smoothing: float, name: str, combine: Any
) -> Barrier:
    some = isinstance(barriers, Sequence) and len(barriers) > 0
    require(some, f"{name}: barriers", barriers, "a list of one at least")
    check_parameter(f"{name}: smoothing", smoothing)
    for each in barriers:
        rule = "a Barrier, as shape.barrier(gains) makes it"
        require(isinstance(each, Barrier), f"{name}: barriers", each, rule)
    first = barriers[0]
    for each in barriers:
        fixed = each.changes is None and each.early_disturbance is None
        rule = "a Barrier as its shape makes it, of fixed parameters"
        require(fixed and each.class_k is None, f"{name}: barrier", each.name, rule)
        rule = f"{first.gains.tolist()}, those of '{first.name}'"
        same = np.array_equal(each.gains, first.gains)
        require(same, f"{name}: gains of '{each.name}'", each.gains.tolist(), rule)
        rule = "given to all of them, or to none"
        alike = each.of_position == first.of_position
        require(alike, f"{name}: position of '{each.name}'", each.of_position, rule)
    functions = [each.function for each in barriers]
    ends = np.cumsum([len(each.parameters) for each in barriers]).tolist()
    spans = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        values = [f(x, t, p[span]) for f, span in zip(functions, spans, strict=True)]
        return in_pairs(values, p[-1], combine)

    parameters = [*np.concatenate([each.parameters for each in barriers]), smoothing]
    return Barrier(h, first.gains, parameters, name, of_position=first.of_position)
