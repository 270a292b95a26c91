"""Lie derivatives along the extended drift [f; 1]: time counts as a state (E2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.symbolic import Expression, Jacobian

from vcbf_drake.barriers.formula import Symbols
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True, eq=False)
class LieDerivatives:
    """h and its derivatives along a model's extended drift.

    Attributes:
        symbols: The model, the time and the parameters that h is written in.
        expressions: h, L_f h, ..., L_f^r h, shape (r + 1,).
    """

    symbols: Symbols
    expressions: Expressions

    @staticmethod
    def of(h: Expression, symbols: Symbols, order: int) -> LieDerivatives:
        """Returns the derivatives of h up to an order r."""
        expressions = [h]
        for _ in range(order):
            expressions.append(drift_rate(expressions[-1], symbols))
        return LieDerivatives(symbols, np.array(expressions))

    @property
    def order(self) -> int:
        """The order r of the highest derivative."""
        return len(self.expressions) - 1

    def row(self, gains: Expressions) -> Expressions:
        """Returns [A, b, w] of the row A u <= b + w'd (E7), (E17), shape (m + 1 + q,).

        Args:
            gains: K of (E4), shape (r,).
        """
        model = self.symbols.model
        eta, highest = self.expressions[-2::-1], self.expressions[-1]
        slope = gradient(eta[0], model.state)
        A = -slope @ model.input_matrix_expressions
        b = gains @ eta + highest
        w = slope @ model.disturbance_matrix
        return np.hstack([A, b, w])

    def chain(self, decay_rates: Expressions) -> Expressions:
        """Returns phi^0, ..., phi^(r-1) of (E3), free of the disturbance (R2).

        Args:
            decay_rates: lambda_1, ..., lambda_r, of which the last has no part in it.
        """
        level = self.expressions[:-1]  # phi^k and its derivatives, here k = 0.
        chain = [level[0]]
        for rate in decay_rates[:-1]:
            level = level[1:] + rate * level[:-1]
            chain.append(level[0])
        return np.array(chain)


def drift_rate(expression: Expression, symbols: Symbols) -> Expression:
    """Returns an expression's Lie derivative along the extended drift (E2)."""
    model = symbols.model
    along: Expression = gradient(expression, model.state) @ model.drift_expressions
    return along + expression.Differentiate(symbols.time)


def gradient(expression: Expression, variables: Expressions) -> Expressions:
    """Returns the derivatives of one expression by n variables, shape (n,)."""
    derivatives: Expressions = Jacobian(np.array([expression]), variables)[0]
    return derivatives
