"""Compilation of formulas to one fast function of plain floats."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
import linecache
import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.model.graph import COMPARISONS, Node, variables_of

Expressions: TypeAlias = NDArray[np.object_]
CompiledFunction: TypeAlias = Callable[..., list[float]]

# The functions that generated code may call.
_NAMES: dict[str, Any] = {
    **{name: value for name, value in vars(math).items() if name[0] != "_"},
    "abs": abs,
    "max": max,
    "min": min,
}
# Python's parser does not take parentheses nested much deeper than this.
_DEEPEST = 30


def compile_nodes(
    arguments: Sequence[Node], outputs: Iterable[Node], name: str = "compiled"
) -> CompiledFunction:
    """Compiles a graph's nodes to one function of plain floats.

    The function takes one positional ``float`` per argument and returns the values of
    the outputs as a list: ``values = function(*x.tolist())``. Common subexpressions are
    computed once. Its results are the same in every process, whatever PYTHONHASHSEED
    is, bit for bit. The caller handles singular points: the function raises what
    Python's own float arithmetic raises there, ZeroDivisionError (1 / 0), ValueError
    (sqrt(-1)) or OverflowError (exp(1000)). Arguments must be ``float``, not
    ``numpy.float64``, which is slower and warns instead.

    Args:
        arguments: Variables, in the order the function takes them.
        outputs: The nodes to compute, in the order in which the function returns them.
        name: The function's name, for messages.

    Raises:
        ValueError: An output depends on a variable that is not an argument.
    """
    outputs = list(outputs)
    unknown = sorted(v.arguments[0] for v in variables_of(outputs) - set(arguments))
    if unknown:
        raise ValueError(f"{name}: not among its arguments: {', '.join(unknown)}")
    function: CompiledFunction = function_of(_code(arguments, outputs), name)
    return function


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


def _code(arguments: Sequence[Node], outputs: Sequence[Node]) -> str:
    """The function's source code, with a name for every repeated subexpression."""
    order = _depth_first(outputs)
    uses = Counter(parent for node in order for parent in node.parents)
    uses.update(outputs)
    text = {node: f"a{i}" for i, node in enumerate(arguments)}
    depth = dict.fromkeys(text, 0)
    lines: list[str] = []
    for node in order:
        if node in text:
            continue
        text[node] = _text(node, text)
        depth[node] = 1 + max((depth[p] for p in node.parents), default=-1)
        shared = uses[node] > 1 and node.number is None
        if shared or depth[node] > _DEEPEST:
            lines.append(f"    t{len(lines)} = {text[node]}\n")
            text[node], depth[node] = f"t{len(lines) - 1}", 0
    head = f"def function({', '.join(f'a{i}' for i in range(len(arguments)))}):\n"
    values = ", ".join(text[node] for node in outputs)
    return f"{head}{''.join(lines)}    return [{values}]\n"


def _depth_first(outputs: Sequence[Node]) -> list[Node]:
    """All nodes, arguments first, in an order that depends on the formula alone."""
    order: dict[Node, None] = {}
    stack = list(reversed(outputs))
    while stack:
        node = stack[-1]
        new = [p for p in node.parents if p not in order]
        if new and node not in order:
            stack += reversed(new)
        else:
            order[stack.pop()] = None
    return list(order)


def _text(node: Node, text: Mapping[Node, str]) -> str:
    operation = node.operation
    if operation == "number":
        return repr(node.arguments[0])
    parts = [text[p] for p in node.parents]
    if operation == "+":
        a, b = node.arguments
        if b.operation == "neg" and text[b].startswith("(-"):
            return f"({parts[0]} - {text[b.arguments[0]]})"
        if a.operation == "neg" and text[a].startswith("(-"):
            return f"({parts[1]} - {text[a.arguments[0]]})"
    if operation in ("+", "*", "/", "and", "or") or operation in COMPARISONS:
        return f"({f' {operation} '.join(parts)})"
    if operation == "neg":
        return f"(-{parts[0]})"
    if operation == "not":
        return f"(not {parts[0]})"
    if operation == "if":
        return f"({parts[1]} if {parts[0]} else {parts[2]})"
    if operation == "pow":
        exponent = node.arguments[1].number
        if exponent is not None and exponent.is_integer():
            return f"(({parts[0]})**{exponent:.0f})"
    return f"{operation}({', '.join(parts)})"
