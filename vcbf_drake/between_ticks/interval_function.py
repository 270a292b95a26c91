"""Compiled functions evaluated on intervals: their ranges, enclosed with certainty."""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import lru_cache
import inspect
from typing import TypeAlias

from vcbf_drake.between_ticks.interval import FUNCTIONS, Number
from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import CompiledFunction
from vcbf_drake.model.generated_code import function_of

IntervalFunction: TypeAlias = Callable[..., list[Number]]

_CASES = (ast.IfExp, ast.Compare, ast.BoolOp)


@lru_cache(maxsize=256)
def interval_function(function: CompiledFunction) -> IntervalFunction:
    """Returns a compiled function's code as a function of intervals and floats.

    It encloses the values of the formula for all arguments inside the intervals, and
    raises where it cannot (see `vcbf_drake.between_ticks.interval`).

    Args:
        function: What `compile_expressions` returned.

    Raises:
        ModelError: The code tells cases apart, or calls what has no enclosure here.
    """
    source = inspect.getsource(function)
    nodes = list(ast.walk(ast.parse(source)))
    called = {
        node.func.id
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    obstacles = sorted(called - FUNCTIONS.keys())
    if any(isinstance(node, _CASES) for node in nodes):
        obstacles.append("cases (if-then-else, abs, min, max or their derivatives)")
    if obstacles:
        raise ModelError(
            f"{function.__name__}: no enclosure on intervals, for it has"
            f" {', '.join(obstacles)}"
        )
    name = f"{function.__name__}, on intervals"
    enclosure: IntervalFunction = function_of(source, name, FUNCTIONS)
    return enclosure
