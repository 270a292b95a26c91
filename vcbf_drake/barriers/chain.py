"""The chain of a barrier: its levels up to the derivative that the input enters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import Dynamics
from vcbf_drake.model.formulas import CompiledFunction, compile_nodes
from vcbf_drake.model.graph import (
    ZERO,
    Node,
    Nodes,
    gradients,
    substitute,
    variable,
)

TIME, LEVEL = variable("t"), variable("level")


def nodes(prefix: str, size: int) -> tuple[Node, ...]:
    """Returns the variables prefix0, prefix1, ..."""
    return tuple(variable(f"{prefix}{i}") for i in range(size))


class Formula(NamedTuple):
    """The formula that a barrier's chain is derived from; equal for equal barriers.

    Attributes:
        h: The barrier.
        dynamics: The model's.
        parameters: The parameters of h.
        order: The relative degree r.
        robust: Whether the disturbance may enter before the input (E8).
        class_k: The class-K function (E10), a formula of `LEVEL`; None for lambda_r
            phi.
    """

    h: Node
    dynamics: Dynamics
    parameters: tuple[Node, ...]
    order: int
    robust: bool
    class_k: Node | None = None


@contextmanager
def _derived() -> Iterator[None]:
    """Explains, by a ModelError, that a formula has too few derivatives."""
    try:
        yield
    except ValueError as error:
        raise ModelError(
            "function(x, t, p) cannot be differentiated as often as needed: write it"
            f" without abs and without the root of a square ({error})"
        ) from None


@dataclass(frozen=True, eq=False)
class Chain:
    """The functions phi^0 = h, ..., phi^(r-1); the input enters the last one's rate.

    Each is the previous one's rate along the extended drift plus lambda times it (E3);
    a robust chain subtracts the worst case of a bounded disturbance (E8). The plain
    chain is the robust one with the bound 0.

    Attributes:
        formula: The formula that it was derived from.
        levels: phi^0, ..., phi^(r-1).
        constants: The numbers that they depend on beside x and t: the decay rates
            lambda_i, the bound and the smoothing of a robust chain, the parameters.
    """

    formula: Formula
    levels: tuple[Node, ...]
    constants: tuple[Node, ...]

    @staticmethod
    @lru_cache(maxsize=64)
    @_derived()
    def of(formula: Formula) -> Chain:
        """Derives the chain, or raises a ModelError for want of derivatives."""
        dynamics, robust = formula.dynamics, formula.robust
        rates = nodes("lambda", formula.order)
        disturbance = (variable("bound"), variable("smoothing")) if robust else ()
        levels = [formula.h]
        for rate in rates[:-1]:
            level = levels[-1]
            worst = ZERO
            if disturbance:
                bound, smoothing = disturbance
                w = [e for e in dynamics.disturbance_rates(level) if e is not ZERO]
                squares = sum((e * e for e in w), start=smoothing * smoothing)
                worst = bound * squares**0.5 if w else ZERO
            levels.append(dynamics.drift_rate(level, TIME) - worst + rate * level)
        constants = (*rates, *disturbance, *formula.parameters)
        return Chain(formula, tuple(levels), constants)

    def row(self) -> Nodes:
        """Returns [A, b, w] of the last level's row (E5), (E9), shape (m + 1 + q,)."""
        dynamics, last = self.formula.dynamics, self.levels[-1]
        pull = self.constants[self.formula.order - 1] * last
        if self.formula.class_k is not None:
            (pull,) = substitute([self.formula.class_k], {LEVEL: last})
        A = -dynamics.input_rates(last)
        b = dynamics.drift_rate(last, TIME) + pull
        return np.array([*A, b, *dynamics.disturbance_rates(last)], dtype=object)

    def compiled(
        self, outputs: Any, name: str, variables: Sequence[Node] = ()
    ) -> CompiledFunction:
        """Returns a function of x, or what replaces x, of t and the constants."""
        x = variables or self.formula.dynamics.x
        return compile_nodes([*x, TIME, *self.constants], outputs, name)

    @cached_property
    @_derived()
    def slopes(self) -> CompiledFunction:
        """A function of x, t and the constants: every level's gradient by x."""
        slopes = gradients(self.levels, self.formula.dynamics.x)
        return self.compiled(slopes.ravel(), "barrier_slopes")

    @cached_property
    def written(self) -> NDArray[np.bool_]:
        """Whether each level's rate contains each channel, shape (r, m + q)."""
        dynamics = self.formula.dynamics
        rates = [
            [*dynamics.input_rates(level), *dynamics.disturbance_rates(level)]
            for level in self.levels
        ]
        return np.array([[rate is not ZERO for rate in row] for row in rates])


class ChainFunctions(NamedTuple):
    """A barrier's chain as functions of plain floats.

    Attributes:
        row: ``row(*x, t, *constants)`` returns [A, b, w], then phi^0, ..., phi^(r-1).
        gradient: ``gradient(*x, t, *constants)`` returns the derivatives of [A, b, w]
            by [x; t], in C order.
        value: ``value(*x, t, *parameters)`` returns [h].
    """

    row: CompiledFunction
    gradient: CompiledFunction
    value: CompiledFunction


@lru_cache(maxsize=64)
@_derived()
def compiled_chain(
    formula: Formula, moving: tuple[Node, ...], of_h: tuple[Node, ...]
) -> ChainFunctions:
    """Returns the functions of a barrier's chain, for any constants.

    The x of `row` and `gradient` is `moving`, the state or the jets of its outputs;
    that of `value` is `of_h`.
    """
    chain = Chain.of(formula)
    entries = chain.row()
    slopes = gradients(entries, [*moving, TIME]).ravel()
    arguments = [*of_h, TIME, *formula.parameters]
    return ChainFunctions(
        chain.compiled([*entries, *chain.levels], "barrier_row", moving),
        chain.compiled(slopes, "barrier_gradient", moving),
        compile_nodes(arguments, [formula.h], "barrier_value"),
    )
