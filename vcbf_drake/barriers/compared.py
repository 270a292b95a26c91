"""Numerical comparison of compiled barriers and limits with the user's functions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.chain import as_expressions
from vcbf_drake.barriers.limits import StateInputLimit
from vcbf_drake.barriers.rows import RowFunctions
from vcbf_drake.checks import Array
from vcbf_drake.model.agreement import (
    FEW_SCALES,
    MANY_SCALES,
    require_agreement,
    sample_points,
)
from vcbf_drake.model.control_affine import ControlAffineModel


def require_same_numbers(
    model: ControlAffineModel,
    compiled: Iterable[tuple[Barrier | StateInputLimit, RowFunctions]],
) -> None:
    """Compares each compiled barrier with its ``function(x, t, p)``.

    Args:
        model: The plant.
        compiled: Barriers and limits, each with its functions.

    Raises:
        ModelError: A compiled barrier differs from its function; the message names it.
    """
    formulas, vectors = set(), set()
    for barrier, functions in compiled:
        # Closures of one code may differ in their cells, so each is looked at.
        code = getattr(barrier.function, "__code__", type(barrier.function))
        kinds = [getattr(f, "inner", f) for f in (functions.value, functions.row)]
        formula = *kinds, code
        vector = functions.row, *formula, barrier.function, functions.parameters
        if vector not in vectors:
            # A formula at many points once, with other parameters at a few.
            scales = FEW_SCALES if formula in formulas else MANY_SCALES
            _compare(model, barrier, functions, scales)
        formulas.add(formula)
        vectors.add(vector)


def _compare(
    model: ControlAffineModel,
    barrier: Barrier | StateInputLimit,
    functions: RowFunctions,
    scales: Sequence[float],
) -> None:
    is_barrier = isinstance(barrier, Barrier)
    compiled = functions.value if is_barrier else functions.row
    size = 1 if is_barrier else model.num_inputs + 1
    parameters = functions.parameters

    def derived(point: Array) -> list[float]:
        *x, t = point.tolist()
        return compiled(*x, abs(t), *parameters)[:size]

    def written(point: Array) -> list[Any]:
        x: Any = point[:-1]
        if isinstance(barrier, Barrier) and barrier.of_position is not None:
            x = model.position_of(x, barrier.of_position)
        return _written(barrier, x, abs(point[-1]))

    def describe(point: Array) -> str:
        x = ", ".join(f"{value:.6g}" for value in point[:-1])
        return f"x = [{x}], t = {abs(point[-1]):.6g}"

    kind = "barrier" if is_barrier else "limit"
    points = sample_points(model.num_states + 1, parameters, scales)
    name = f"{kind} '{barrier.name}': function(x, t, p)"
    require_agreement(derived, written, points, describe, [name])


def _written(barrier: Barrier | StateInputLimit, x: Array, t: float) -> list[Any]:
    """The values of ``function(x, t, p)`` itself: h, or a limit's row and bound."""
    function, p = barrier.function, barrier.parameters
    try:
        values = function(np.array(x), np.float64(t), np.array(p))
    except (AttributeError, TypeError, RuntimeError):
        # The function takes expressions only; without variables they are numbers.
        values = function(as_expressions(x), Expression(t), as_expressions(p))
    if isinstance(barrier, Barrier):
        return [np.asarray(values, dtype=object).item()]
    row, bound = values
    return [*row, bound]
