"""Formulas as graphs: each subexpression once, however often it is used.

pydrake's expressions can only be read as trees, and derivatives of trees repeat common
subexpressions. A `Node` is made once for each operation and arguments, so equal
formulas are the same node, derivatives are as long as the formula, and code computes
each part once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import count
import math
import operator
from typing import Any, TypeAlias
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

Nodes: TypeAlias = NDArray[np.object_]
_Key: TypeAlias = tuple[Any, ...]

_table: WeakValueDictionary[_Key, Node] = WeakValueDictionary()
_serial = count()
_by_serial = operator.attrgetter("serial")


def _with_number(
    function: Callable[[Node, Node], Node],
) -> Callable[[Node, Node | float], Node]:
    """An operator that also accepts numbers, and leaves arrays to NumPy."""

    def applied(self: Node, other: Node | float) -> Node:
        if isinstance(other, np.ndarray):
            return NotImplemented
        return function(self, as_node(other))

    return applied


class Node:
    """An operation on other nodes, a number, or a variable.

    Attributes:
        operation: "number", "variable", "+", "*", "/", "neg", "pow", the name of a
            function of `math`, "abs", "max", "min", "if", or a comparison.
        arguments: Its operands; the value of a number, the name of a variable.
        serial: Greater than that of every argument.
    """

    __slots__ = ("__weakref__", "arguments", "operation", "serial")
    operation: str
    arguments: tuple[Any, ...]
    serial: int

    @staticmethod
    def of(operation: str, *arguments: Any) -> Node:
        """Returns the one node of an operation on arguments."""
        key = operation, *arguments
        node = _table.get(key)
        if node is None:
            node = Node()
            node.operation, node.arguments = operation, arguments
            node.serial = next(_serial)
            _table[key] = node
        return node

    @property
    def parents(self) -> tuple[Node, ...]:
        """The nodes it is applied to."""
        is_leaf = self.operation in ("number", "variable")
        return () if is_leaf else self.arguments

    @property
    def number(self) -> float | None:
        """Its value if it is a number."""
        if self.operation != "number":
            return None
        value: float = self.arguments[0]
        return value

    @_with_number
    def __add__(self, other: Node) -> Node:
        a, b = self, other
        if a.number is not None and b.number is not None:
            return number(a.number + b.number)
        if a is ZERO:
            return b
        if b is ZERO:
            return a
        if a is b:
            return 2.0 * a
        if a.operation == "neg" and a.arguments[0] is b:
            return ZERO
        if b.operation == "neg" and b.arguments[0] is a:
            return ZERO
        return Node.of("+", *sorted((a, b), key=_by_serial))

    __radd__ = __add__

    def __neg__(self) -> Node:
        if self.number is not None:
            return number(-self.number)
        if self.operation == "neg":
            inner: Node = self.arguments[0]
            return inner
        return Node.of("neg", self)

    @_with_number
    def __sub__(self, other: Node) -> Node:
        return self + -other

    def __rsub__(self, other: float) -> Node:
        return as_node(other) + -self

    @_with_number
    def __mul__(self, other: Node) -> Node:
        a, b = self, other
        if a.number is None and b.number is not None:
            a, b = b, a
        if a.number is not None:
            if b.number is not None:
                return number(a.number * b.number)
            if a.number in (0.0, 1.0, -1.0):
                return ZERO if a is ZERO else b if a is ONE else -b
            first = b.arguments[0]
            if b.operation == "*" and first.number is not None:
                return first * a * b.arguments[1]
        if a.operation == "neg":
            return -(a.arguments[0] * b)
        if b.operation == "neg":
            return -(a * b.arguments[0])
        if a is b:
            return Node.of("pow", a, number(2.0))
        in_order = (a, b) if a.number is not None else sorted((a, b), key=_by_serial)
        return Node.of("*", *in_order)

    __rmul__ = __mul__

    @_with_number
    def __truediv__(self, other: Node) -> Node:
        a, b = self, other
        if a is ZERO or b is ONE:
            return a
        if a.number is not None and b.number:
            return number(a.number / b.number)
        if a.operation == "neg":
            return -(a.arguments[0] / b)
        if b.operation == "neg":
            return -(a / b.arguments[0])
        return Node.of("/", a, b)

    def __rtruediv__(self, other: float) -> Node:
        return as_node(other) / self

    @_with_number
    def __pow__(self, other: Node) -> Node:
        exponent, known = other, other.number
        if known == 0.0:
            return ONE
        if known == 1.0:
            return self
        if known == 0.5:
            return apply("sqrt", self)
        if known == 1.5:
            return self * apply("sqrt", self)
        if known is not None and known < 0.0:
            return ONE / self ** (-known)
        if self.number is not None and known is not None:
            return _folded(math.pow, Node.of("pow", self, exponent))
        return Node.of("pow", self, exponent)


def number(value: float) -> Node:
    """Returns a number as a node."""
    return Node.of("number", float(value) + 0.0)  # No -0, which equals 0.


def variable(name: str) -> Node:
    """Returns the variable of a name."""
    return Node.of("variable", name)


def as_node(value: Node | float) -> Node:
    """Returns a node, or the number as one."""
    return value if isinstance(value, Node) else number(value)


ZERO, ONE = number(0.0), number(1.0)

_Derivatives: TypeAlias = Callable[..., tuple[Node, ...]]


def choose(condition: Node, a: Node, b: Node) -> Node:
    """Returns a where a comparison is true, else b."""
    return a if a is b else apply("if", condition, a, b)


def _cases(a: Node, b: Node, of_a: Node, of_b: Node) -> tuple[Node, ...]:
    """The derivatives of max (1 for the greater argument) or of min (0 for it)."""
    a_is_greater = apply(">", a, b)
    return choose(a_is_greater, of_a, of_b), choose(a_is_greater, of_b, of_a)


# By the arguments of each function of `math`: f(x, ...) -> df/dx, ...
_DERIVATIVES: dict[str, _Derivatives] = {
    "sqrt": lambda x: (0.5 / apply("sqrt", x),),
    "exp": lambda x: (apply("exp", x),),
    "log": lambda x: (1.0 / x,),
    "sin": lambda x: (apply("cos", x),),
    "cos": lambda x: (-apply("sin", x),),
    "tan": lambda x: (1.0 + apply("tan", x) ** 2,),
    "asin": lambda x: (1.0 / (1.0 - x * x) ** 0.5,),
    "acos": lambda x: (-1.0 / (1.0 - x * x) ** 0.5,),
    "atan": lambda x: (1.0 / (1.0 + x * x),),
    "atan2": lambda y, x: (x / (x * x + y * y), -y / (x * x + y * y)),
    "sinh": lambda x: (apply("cosh", x),),
    "cosh": lambda x: (apply("sinh", x),),
    "tanh": lambda x: (1.0 - apply("tanh", x) ** 2,),
    "abs": lambda x: (apply("copysign", ONE, x),),
    "max": lambda a, b: _cases(a, b, ONE, ZERO),
    "min": lambda a, b: _cases(a, b, ZERO, ONE),
    "+": lambda a, b: (ONE, ONE),
    "neg": lambda a: (-ONE,),
    "*": lambda a, b: (b, a),
    "/": lambda a, b: (1.0 / b, -(a / b) / b),
}
COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
LOGIC = ("and", "or", "not")


_OPERATORS: dict[str, Callable[..., Node]] = {
    "+": operator.add,
    "*": operator.mul,
    "/": operator.truediv,
    "pow": operator.pow,
    "neg": operator.neg,
}


def apply(operation: str, *arguments: Node) -> Node:
    """Returns an operation's node, simplified where an argument is 0, 1 or a number."""
    if operation in _OPERATORS:
        return _OPERATORS[operation](*arguments)
    node = Node.of(operation, *arguments)
    function = getattr(math, operation, None)
    return node if function is None else _folded(function, node)


def _folded(function: Callable[..., float], node: Node) -> Node:
    values = [each.number for each in node.arguments]
    try:
        return node if None in values else number(function(*values))
    except (ArithmeticError, ValueError):
        return node  # Whoever evaluates it is told.


def in_order(nodes: Iterable[Node]) -> list[Node]:
    """Returns the nodes and all their subexpressions, arguments first."""
    found: set[Node] = set()
    stack = list(nodes)
    while stack:
        node = stack.pop()
        if node not in found:
            found.add(node)
            stack += node.parents
    return sorted(found, key=_by_serial)


def variables_of(nodes: Iterable[Node]) -> set[Node]:
    """Returns the variables that nodes depend on."""
    return {node for node in in_order(nodes) if node.operation == "variable"}


def along(nodes: Iterable[Node], rates: Mapping[Node, Node]) -> list[Node]:
    """Returns the derivatives of nodes whose variables have these rates, or none."""
    nodes = list(nodes)
    slope: dict[Node, Node] = {}
    for node in in_order(nodes):
        slope[node] = rates.get(node, ZERO)
        if node.operation == "if":
            condition, a, b = node.arguments
            slope[node] = choose(condition, slope[a], slope[b])
            continue
        if node.operation in COMPARISONS or node.operation in LOGIC:
            continue
        moving = [i for i, p in enumerate(node.parents) if slope[p] is not ZERO]
        if moving:
            by = _derivatives(node)
            terms = [by[i] * slope[node.arguments[i]] for i in moving]
            slope[node] = sum(terms[1:], start=terms[0])
    return [slope[node] for node in nodes]


def gradients(nodes: Iterable[Node], variables: Iterable[Node]) -> Nodes:
    """Returns the derivatives of k nodes by n variables, shape (k, n)."""
    nodes = list(nodes)
    # One robot among many occurs in few of the formulas: most columns are zero.
    known, none = variables_of(nodes), [ZERO] * len(nodes)
    columns = [along(nodes, {v: ONE}) if v in known else none for v in variables]
    return np.array(columns, dtype=object).T.reshape(len(nodes), -1)


def _derivatives(node: Node) -> Sequence[Node]:
    if node.operation == "pow":
        base, exponent = node.arguments
        by_base = exponent * base ** (exponent - 1.0)
        constant = exponent.number is not None
        return by_base, ZERO if constant else node * apply("log", base)
    derivatives = _DERIVATIVES.get(node.operation)
    if derivatives is None:
        switch = "abs" if node.operation == "copysign" else node.operation
        raise ValueError(f"{switch} has no such derivative where it switches")
    return derivatives(*node.arguments)


def substitute(nodes: Iterable[Node], values: Mapping[Node, Node]) -> list[Node]:
    """Returns nodes with other nodes in place of some variables."""
    nodes = list(nodes)
    new: dict[Node, Node] = {}
    for node in in_order(nodes):
        parents = node.parents
        if node in values:
            new[node] = values[node]
        elif all(new[p] is p for p in parents):
            new[node] = node
        else:
            new[node] = apply(node.operation, *(new[p] for p in parents))
    return [new[node] for node in nodes]
