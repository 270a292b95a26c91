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
    variables_of,
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


@dataclass(frozen=True)
class PlacedFunction:
    """A function of a subsystem, extended by zeros to a function of the plant.

    Attributes:
        inner: The function of the subsystem.
        states: The indices of its states in the plant.
        num_states: The number of states of the plant.
        places: The indices of the inner function's numbers in the result.
        size: The number of numbers in the result.
    """

    inner: CompiledFunction
    states: tuple[int, ...]
    num_states: int
    places: tuple[int, ...]
    size: int

    def __call__(self, *arguments: float) -> list[float]:
        """Returns the numbers at (x, t, constants)."""
        few = [arguments[i] for i in self.states]
        found = [0.0] * self.size
        numbers = self.inner(*few, *arguments[self.num_states :])
        for place, number in zip(self.places, numbers, strict=True):
            found[place] = number
        return found


@dataclass(frozen=True)
class Subsystem:
    """The states that a barrier's chain depends on, with the channels that enter them.

    Attributes:
        states: Their indices.
        channels: The inputs and, after all inputs, the disturbances that enter there.
        shape: n, m and q of the plant.
    """

    states: tuple[int, ...]
    channels: tuple[int, ...]
    shape: tuple[int, int, int]

    @staticmethod
    def of(formula: Formula) -> tuple[Formula, Subsystem]:
        """Returns a formula of the subsystem's own states, and the subsystem.

        Equal robots have equal formulas. A subsystem of more than half of the plant, or
        of no state, is replaced by the plant.
        """
        x, f, g, E = formula.dynamics
        n, m, q = len(x), len(g[0]), len(E[0])
        number = {node: i for i, node in enumerate(x)}
        states: set[int] = set()
        found = [formula.h]
        while found:
            new = {number[v] for v in variables_of(found) if v in number} - states
            states |= new
            found = [each for i in new for each in (f[i], *g[i], *E[i])]
        chosen = sorted(states)
        if not chosen or 2 * len(chosen) > n:
            return formula, Subsystem(tuple(range(n)), tuple(range(m + q)), (n, m, q))
        enters = [
            j
            for j in range(m + q)
            if any((*g[i], *E[i])[j] is not ZERO for i in chosen)
        ]
        own = {x[i]: variable(f"x{k}") for k, i in enumerate(chosen)}

        def renamed(nodes: Sequence[Node]) -> tuple[Node, ...]:
            return tuple(substitute(nodes, own))

        rows = [renamed([(*g[i], *E[i])[j] for j in enters]) for i in chosen]
        of_inputs = sum(j < m for j in enters)
        dynamics = Dynamics(
            tuple(own.values()),
            renamed([f[i] for i in chosen]),
            tuple(row[:of_inputs] for row in rows),
            tuple(row[of_inputs:] for row in rows),
        )
        (h,) = renamed([formula.h])
        part = Subsystem(tuple(chosen), tuple(enters), (n, m, q))
        return formula._replace(h=h, dynamics=dynamics), part

    def placed(self, functions: ChainFunctions, levels: int) -> ChainFunctions:
        """Returns functions of the subsystem's states as the plant's.

        The row's entries are followed by `levels` levels of the chain.
        """
        n, m, q = self.shape
        if len(self.states) == n:
            return functions
        size = m + 1 + q
        entries = [
            *(j for j in self.channels if j < m),
            m,
            *(j + 1 for j in self.channels if j >= m),
        ]
        columns = [*self.states, n]
        slopes = np.add.outer(np.multiply(entries, n + 1), columns).ravel().tolist()

        def place(
            inner: CompiledFunction, places: Sequence[int], size: int
        ) -> PlacedFunction:
            return PlacedFunction(inner, self.states, n, tuple(places), size)

        levels_after = range(size, size + levels)
        return ChainFunctions(
            place(functions.row, [*entries, *levels_after], size + levels),
            place(functions.gradient, slopes, size * (n + 1)),
            place(functions.value, [0], 1),
        )
