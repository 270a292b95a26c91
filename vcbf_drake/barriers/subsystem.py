"""The subsystem that a barrier depends on: equal robots share one derivation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcbf_drake.barriers.chain import ChainFunctions, Formula
from vcbf_drake.model.control_affine import Dynamics
from vcbf_drake.model.formulas import CompiledFunction
from vcbf_drake.model.graph import ZERO, Node, substitute, variable, variables_of


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
        found: list[Node | float] = [formula.h]
        while found:
            nodes = [each for each in found if isinstance(each, Node)]
            new = {number[v] for v in variables_of(nodes) if v in number} - states
            states |= new
            found = [each for i in new for each in (f[i], *g[i], *E[i])]
        chosen = sorted(states)
        if not chosen or 2 * len(chosen) > n:
            return formula, Subsystem(tuple(range(n)), tuple(range(m + q)), (n, m, q))
        enters = [
            j
            for j in range(m + q)
            if any((*g[i], *E[i])[j] not in (ZERO, 0.0) for i in chosen)
        ]
        own = {x[i]: variable(f"x{k}") for k, i in enumerate(chosen)}

        def renamed(nodes: Sequence[Node | float]) -> tuple[Any, ...]:
            there = iter(substitute([v for v in nodes if isinstance(v, Node)], own))
            return tuple(next(there) if isinstance(v, Node) else v for v in nodes)

        columns = [[(*g[i], *E[i])[j] for j in enters] for i in chosen]
        of_inputs = sum(j < m for j in enters)
        rows = [renamed(row) for row in columns]
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

        Args:
            functions: A row, its gradient and its value.
            levels: The number of levels of the chain that follow the row's entries.
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
