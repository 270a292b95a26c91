"""Functions made from generated Python code that does arithmetic and nothing else."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
import linecache
import math
from typing import Any

# All that generated code may name beside its arguments and its own variables.
_NAMES: dict[str, Any] = {
    **{name: value for name, value in vars(math).items() if name[0] != "_"},
    "abs": abs,
    "max": max,
    "min": min,
}
_ARITHMETIC = (
    *(ast.Module, ast.FunctionDef, ast.arguments, ast.arg, ast.Assign, ast.Return),
    *(ast.Name, ast.Load, ast.Store, ast.List, ast.IfExp),
    *(ast.BinOp, ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow),
    *(ast.UnaryOp, ast.USub, ast.UAdd, ast.Not, ast.BoolOp, ast.And, ast.Or),
    *(ast.Compare, ast.Eq, ast.NotEq, ast.Lt, ast.LtE, ast.Gt, ast.GtE),
)


def is_arithmetic(source: str) -> bool:
    """Whether code is one function that only calculates with floats.

    Such code assigns to local names, calls functions of `math`, and returns a list: it
    can neither import nor reach an attribute, whoever wrote it.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    nodes = list(ast.walk(tree))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return (
        functions == tree.body
        and len(functions) == 1
        and not functions[0].decorator_list
        and all(map(_is_arithmetic, nodes))
    )


def _is_arithmetic(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and callable(_NAMES.get(node.func.id))
    if isinstance(node, ast.Constant):
        return type(node.value) in (int, float)
    return isinstance(node, _ARITHMETIC)


def function_of(
    source: str, name: str, meaning: Mapping[str, Callable[..., Any]] | None = None
) -> Any:
    """Returns the function that the code defines, under a name.

    Its code stays readable: in tracebacks and by ``inspect.getsource``.

    Args:
        source: The definition of one function.
        name: The function's name, for messages.
        meaning: The functions that the code calls, by name; those on floats by
            default.
    """
    file = f"<{name} {hash(source):x}>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file
    scope: dict[str, Any] = {}
    names = _NAMES if meaning is None else meaning
    exec(compile(source, file, "exec"), {**names, "__builtins__": {}}, scope)
    (function,) = scope.values()
    function.__name__ = name
    return function
