"""The chain of a barrier that the disturbance reaches before the input does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.formula import Symbols
from vcbf_drake.barriers.lie_derivatives import drift_rate, gradient
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True, eq=False)
class RobustChain:
    """The chain (E3) less the worst that a bounded disturbance does to it (E70).

    Attributes:
        symbols: The model, the time and the parameters that h is written in.
        levels: h and its successors phi^1, ..., phi^(r-1), shape (r,).
        last_rate: lambda_r.
    """

    symbols: Symbols
    levels: Expressions
    last_rate: Expression

    @staticmethod
    def of(
        h: Expression,
        symbols: Symbols,
        decay_rates: Expressions,
        bound: Expression,
        smoothing: Expression,
    ) -> RobustChain:
        """Derives the chain.

        Args:
            h: The barrier.
            symbols: What it is written in.
            decay_rates: lambda_1, ..., lambda_r, shape (r,), symbols or numbers.
            bound: The disturbance's bound, a symbol or a number.
            smoothing: What keeps the norms' roots off 0, likewise.
        """
        levels = [h]
        for rate in decay_rates[:-1]:
            level = levels[-1]
            w = _along_disturbance(level, symbols)
            worst = bound * (w @ w + smoothing**2) ** 0.5 if len(w) else 0.0
            levels.append(drift_rate(level, symbols) - worst + rate * level)
        return RobustChain(symbols, np.array(levels), decay_rates[-1])

    def row(self) -> Expressions:
        """Returns [A, b, w] of the last level's row (E71), shape (m + 1 + q,)."""
        model, last = self.symbols.model, self.levels[-1]
        slope = gradient(last, model.state)
        A = -slope @ model.input_matrix_expressions
        b = drift_rate(last, self.symbols) + self.last_rate * last
        return np.hstack([A, b, slope @ model.disturbance_matrix])


def _along_disturbance(level: Expression, symbols: Symbols) -> Expressions:
    """Returns the entries of E' grad_x phi that are not zero."""
    model = symbols.model
    w = gradient(level, model.state) @ model.disturbance_matrix
    zero = Expression(0.0)
    return np.array([e for e in w if not e.EqualTo(zero)], dtype=object)
