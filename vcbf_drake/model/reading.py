"""Conversion of pydrake's expressions to graphs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.symbolic import Expression, ExpressionKind, FormulaKind, Variable

from vcbf_drake.model.graph import LOGIC, ONE, ZERO, Node, Nodes, apply, number, rebuilt


class Reader:
    """The nodes of pydrake's expressions, with a node for each variable.

    Attributes:
        variables: The node of each variable, by its identity.
    """

    def __init__(self, variables: Mapping[Variable, Node]) -> None:
        """Stores the variables' nodes."""
        self.variables = {v.get_id(): node for v, node in variables.items()}

    def read(self, values: Any) -> Nodes:
        """Returns expressions, variables and numbers as nodes, of the same shape.

        Raises:
            KeyError: A variable is not known; it has the name.
            TypeError: A value is none of these.
            NotImplementedError: An expression has no counterpart here.
        """
        given = np.asarray(values, dtype=object)
        nodes = np.empty(given.shape, dtype=object)
        for index in np.ndindex(given.shape):
            nodes[index] = self._value(given[index])
        return nodes

    def _value(self, value: Any) -> Node:
        if isinstance(value, Node):
            return value
        if isinstance(value, Variable):
            return self._variable(value)
        if isinstance(value, Expression):
            return self._expression(value)
        return number(float(value))

    def _variable(self, variable: Variable) -> Node:
        node = self.variables.get(variable.get_id())
        if node is None:
            raise KeyError(variable.get_name())
        return node

    def _expression(self, e: Expression) -> Node:
        kind = e.get_kind()
        if kind == ExpressionKind.Constant:
            return number(e.Evaluate())
        if kind == ExpressionKind.Var:
            (variable,) = e.GetVariables()
            return self._variable(variable)
        _, arguments = e.Unapply()
        if kind == ExpressionKind.Add:
            return self._sum(arguments)
        if kind == ExpressionKind.Mul:
            return self._product(arguments)
        if kind == ExpressionKind.IfThenElse:
            condition, *values = arguments
            nodes = [self._formula(condition), *map(self._value, values)]
            return apply("if", *nodes)
        operation = _KINDS.get(kind)
        if operation is None:
            raise NotImplementedError(f"{kind.name} has no counterpart in plain Python")
        return rebuilt(operation, *map(self._value, arguments))

    def _sum(self, arguments: Sequence[Any]) -> Node:
        total = ZERO
        for term in arguments:
            total = total + self._value(term)
        return total

    def _product(self, arguments: Sequence[Any]) -> Node:
        product, below = ONE, ONE
        for factor in arguments:
            node = self._value(factor)
            if node.operation == "/" and node.arguments[0] is ONE:
                below = below * node.arguments[1]
            else:
                product = product * node
        return product / below

    def _formula(self, formula: Any) -> Node:
        kind = formula.get_kind()
        operation = _FORMULAS.get(kind)
        if operation is None:
            raise NotImplementedError(f"{kind.name} has no counterpart in plain Python")
        _, arguments = formula.Unapply()
        if operation in LOGIC:
            return Node.of(operation, *map(self._formula, arguments))
        return Node.of(operation, *map(self._value, arguments))


_KINDS = {
    ExpressionKind.Div: "/",
    ExpressionKind.Pow: "pow",
    **{
        getattr(ExpressionKind, name.capitalize()): name
        for name in (
            *("abs", "exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos"),
            *("atan", "atan2", "sinh", "cosh", "tanh", "min", "max", "ceil", "floor"),
        )
    },
}
_FORMULAS = {
    FormulaKind.And: "and",
    FormulaKind.Or: "or",
    FormulaKind.Not: "not",
    FormulaKind.Lt: "<",
    FormulaKind.Leq: "<=",
    FormulaKind.Gt: ">",
    FormulaKind.Geq: ">=",
    FormulaKind.Eq: "==",
    FormulaKind.Neq: "!=",
}
