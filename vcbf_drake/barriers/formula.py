"""What a barrier's or limit's function says, in symbols of one model."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.symbolic import Expression, MakeVectorVariable, Variable

from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import Expressions
from vcbf_drake.model.control_affine import ControlAffineModel


@dataclass(frozen=True)
class Formula:
    """Expressions in the symbols of one model.

    Formulas are equal if they and their models read the same, so one more obstacle, or
    the same scenario built again, costs no compilation.

    Attributes:
        content: What equality compares.
        symbols: The symbols they are written in.
        expressions: Shape (k,).
    """

    content: Hashable
    symbols: Symbols = field(compare=False)
    expressions: Expressions = field(compare=False)


@dataclass(frozen=True)
class Symbols:
    """The arguments x, t and p of a barrier's or limit's function.

    Attributes:
        model: The model, whose state is x.
        time: The variable t.
        parameters: The variables p, shape (k,).
    """

    model: ControlAffineModel
    time: Variable
    parameters: Expressions

    @staticmethod
    def of(model: ControlAffineModel, num_parameters: int) -> Symbols:
        """Returns symbols for a function of one model."""
        return Symbols(model, Variable("t"), MakeVectorVariable(num_parameters, "p"))

    @property
    def variables(self) -> list[Variable]:
        """The variables x, then t, then p."""
        return [*self.model.state, self.time, *self.parameters]

    def call(self, function: Callable[..., Any]) -> Any:
        """Returns function(x, t, p).

        Raises:
            ModelError: It raises.
        """
        x, p = as_expressions(self.model.state), as_expressions(self.parameters)
        try:
            return function(x, Expression(self.time), p)
        except (
            AttributeError,
            IndexError,
            RuntimeError,
            TypeError,
            ValueError,
        ) as error:
            raise ModelError(f"function(x, t, p) fails on symbols: {error}") from error

    def formula(self, values: Iterable[Any]) -> Formula:
        """Returns the formula of what a function returned.

        Raises:
            ModelError: A value is not an expression, a variable or a number.
        """
        try:
            expressions = as_expressions(values)
        except TypeError as error:
            raise ModelError(
                "function(x, t, p) must return symbolic expressions or numbers"
            ) from error
        return Formula(self._content(expressions), self, expressions)

    def _content(self, expressions: Expressions) -> Hashable:
        names = tuple(variable.get_name() for variable in self.variables)
        if len(set(names)) < len(names):
            return object()  # Names do not tell the variables apart: equal to no other.
        return names, tuple(map(str, expressions)), self.model.content


def as_expressions(values: Iterable[Any]) -> Expressions:
    """Returns variables and numbers as expressions, shape (k,)."""
    return np.array(
        [v if isinstance(v, Expression) else Expression(v) for v in values],
        dtype=object,
    )
