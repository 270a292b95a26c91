"""Formulas: pydrake's expressions read as graphs, and graphs compiled to Python."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
import linecache
import math
import re
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydrake.symbolic import (
    Expression,
    ExpressionKind,
    Formula,
    FormulaKind,
    Variable,
)

from vcbf_drake.model.graph import (
    COMPARISONS,
    ONE,
    ZERO,
    Node,
    Nodes,
    apply,
    in_order,
    number,
    variables_of,
)

Expressions: TypeAlias = NDArray[np.object_]
CompiledFunction: TypeAlias = Callable[..., list[float]]

_OPERATIONS = {
    ExpressionKind.Div: "/",
    ExpressionKind.IfThenElse: "if",
    FormulaKind.And: "and",
    FormulaKind.Or: "or",
    FormulaKind.Not: "not",
    FormulaKind.Lt: "<",
    FormulaKind.Leq: "<=",
    FormulaKind.Gt: ">",
    FormulaKind.Geq: ">=",
    FormulaKind.Eq: "==",
    FormulaKind.Neq: "!=",
    **{
        getattr(ExpressionKind, name.capitalize()): name
        for name in (
            *("pow", "abs", "exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos"),
            *("atan", "atan2", "sinh", "cosh", "tanh", "min", "max", "ceil", "floor"),
        )
    },
}


def read(values: Any, variables: Mapping[Variable, Node]) -> Nodes:
    """Returns expressions, variables and numbers as nodes, of the same shape.

    Raises:
        KeyError: A variable is not known.
        TypeError: A value is none of these.
        NotImplementedError: An expression has no counterpart here.
    """
    known = {each.get_id(): node for each, node in variables.items()}
    given = np.asarray(values, dtype=object)
    nodes = np.empty(given.shape, dtype=object)
    for index in np.ndindex(given.shape):
        if isinstance(given[index], Formula):
            raise TypeError("a formula is neither an expression nor a number")
        nodes[index] = _node(given[index], known)
    return nodes


def _node(value: Any, known: Mapping[int, Node]) -> Node:
    if isinstance(value, Node):
        return value
    if isinstance(value, Variable):
        if value.get_id() not in known:
            raise KeyError(f"not among its arguments: {value.get_name()}")
        return known[value.get_id()]
    if not isinstance(value, Expression | Formula):
        return number(float(value))
    kind = value.get_kind()
    if kind == ExpressionKind.Constant:
        return number(value.Evaluate())
    if kind == ExpressionKind.Var:
        (value,) = value.GetVariables()
        return _node(value, known)
    is_sum, is_product = kind == ExpressionKind.Add, kind == ExpressionKind.Mul
    if not (is_sum or is_product or kind in _OPERATIONS):
        raise NotImplementedError(f"{kind.name} has no counterpart in plain Python")
    nodes = (_node(each, known) for each in value.Unapply()[1])
    if is_sum:
        return sum(nodes, start=ZERO)
    return _product(nodes) if is_product else apply(_OPERATIONS[kind], *nodes)


def _product(factors: Iterable[Node]) -> Node:
    """The product of factors, with all that divides in one denominator."""
    product, below = ONE, ONE
    for node in factors:
        if node.operation == "/" and node.arguments[0] is ONE:
            below = below * node.arguments[1]
        else:
            product = product * node
    return product / below


# What an error on symbols says, and the remedy.
_REMEDIES = (
    (
        "__bool__",
        "if, max, np.clip, np.where, np.maximum and comparisons need to know what"
        " symbols cannot tell: write a smooth formula, (e + (e**2 + c**2)**0.5) / 2"
        " for max(e, 0) with a small c, or one barrier for each case",
    ),
    (
        "(?s)(?=.*pydrake.symbolic.Expression).*(real number|float)",
        "float() and the functions of math take numbers only: write NumPy's (np.cos),"
        " which take symbols too",
    ),
    (
        "(attribute '|callable )hypot",
        "np.hypot does not know symbols: write (a**2 + b**2)**0.5",
    ),
    (
        r"Expression(?:' object has no attribute '| which has no callable )(\w+)",
        "'{0}' does not know symbols: write it with cos, sin, tan, arctan2, exp, log,"
        " tanh, sqrt and powers",
    ),
    (
        r"entry for the variable (\S+)",
        "Drake's code looks at the number of {0}, as that of a BallRpy or universal"
        " joint does (is it near a singular angle?): model the joint by revolute joints"
        " in a row, or a free body by its quaternion",
    ),
    (
        "geometry_query_input_port",
        "the plant is connected to a SceneGraph, and contact has no formula: derive the"
        " model from the same plant parsed on its own, and give that as model",
    ),
)


def explained(error: BaseException) -> str:
    """Returns an error that a function raised on symbols, with a remedy if known."""
    for pattern, remedy in _REMEDIES:
        if found := re.search(pattern, str(error)):
            return remedy.format(*found.groups())
    return first_line(error)


def first_line(error: BaseException) -> str:
    """Returns the first informative line of an error's text."""
    lines = (line.strip(" :") for line in str(error).splitlines())
    return next(filter(None, lines), type(error).__name__)


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
    """Returns the one function that the code defines, under a name.

    Its code stays readable: in tracebacks and by ``inspect.getsource``. The functions
    that it calls have the given meaning; by default those on floats.
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
    order = in_order(outputs)
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
