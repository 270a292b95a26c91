"""Symbolic expressions compiled to one fast function of plain floats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
import re
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydrake.symbolic import Expression, Variable

from vcbf_drake.model.code_cache import cache_key, load_code, store_code
from vcbf_drake.model.generated_code import function_of

Expressions: TypeAlias = NDArray[np.object_]
CompiledFunction: TypeAlias = Callable[..., list[float]]

_PLAIN_NAME = re.compile(r"[\w$]+(\(\d+\))?")  # x, $x_0, x(0)


def compile_expressions(
    arguments: Iterable[Variable],
    expressions: Expressions | Iterable[Expression | Variable | float],
    name: str = "compiled",
) -> CompiledFunction:
    """Compiles expressions to one function of plain floats.

    The function takes one positional ``float`` per argument and returns the values
    of the expressions, in order, as a flat list: ``values = function(*x.tolist())``.
    Common subexpressions are computed once. The generated code is the same in every
    process, whatever PYTHONHASHSEED is, so its results are too, bit for bit. It is kept
    on disk (see `code_cache`).

    A singular point is the caller's to handle: the function raises what Python's own
    float arithmetic raises there, ZeroDivisionError (1 / 0), ValueError (sqrt(-1)) or
    OverflowError (exp(1000)). Arguments must be ``float``, not ``numpy.float64``, which
    is slower and warns instead.

    Args:
        arguments: The variables, in the order the function takes them.
        expressions: What to compute, of any shape; flattened in C order.
        name: The function's name, for messages.

    Raises:
        ValueError: An expression holds a variable that is not an argument.
        NotImplementedError: An expression has no counterpart in plain Python (an
            uninterpreted function, for example).
    """
    variables = list(arguments)
    flat = [
        e if isinstance(e, Expression) else Expression(e)
        for e in np.asarray(expressions, dtype=object).flat
    ]
    _require_known(variables, flat, name)
    function: CompiledFunction = function_of(_code(variables, flat), name)
    return function


def _code(variables: list[Variable], expressions: list[Expression]) -> str:
    variables, expressions = _clearly_named(variables, expressions)
    generator = Path(__file__).with_name("float_code.py").read_text(encoding="utf-8")
    names = " ".join(v.get_name() for v in variables)
    key = cache_key(generator, names, *map(str, expressions))
    code = load_code(key)
    if code is None:
        from vcbf_drake.model.float_code import float_code  # SymPy's import is slow.

        code = float_code(variables, expressions)
        store_code(key, code)
    return code


def _clearly_named(
    variables: list[Variable], expressions: list[Expression]
) -> tuple[list[Variable], list[Expression]]:
    """The same, in variables whose names make the expressions' text say what is meant.

    Renaming visits shared subexpressions as often as they are used, which takes minutes
    for some barriers, so it is done only where names are repeated or could be formulas.
    """
    names = [v.get_name() for v in variables]
    if len(set(names)) == len(names) and all(map(_PLAIN_NAME.fullmatch, names)):
        return variables, expressions
    arguments = [Variable(f"a{i}") for i in range(len(variables))]
    renamed = {v: Expression(a) for v, a in zip(variables, arguments, strict=True)}
    return arguments, [e.Substitute(renamed) for e in expressions]


def _require_known(
    variables: list[Variable], expressions: list[Expression], name: str
) -> None:
    known = {v.get_id() for v in variables}
    used = [v for e in expressions for v in e.GetVariables()]
    unknown = sorted({v.get_name() for v in used if v.get_id() not in known})
    if unknown:
        raise ValueError(f"{name}: not among its arguments: {', '.join(unknown)}")
