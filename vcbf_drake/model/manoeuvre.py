"""Backup manoeuvre: how a plant gets to safety by itself, and where that leads it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from vcbf_drake.checks import Array
from vcbf_drake.model.compiled import Expressions

Box: TypeAlias = list[tuple[float, float]]
"""Least and greatest value of every state and, last, of the time [s]: n + 1 pairs."""

# Stands for "for ever" and "anywhere": intervals have finite ends.
FOREVER = 1e9
ANYWHERE = 1e6


@dataclass(frozen=True)
class Plan:
    """Where a plant can be while an input is held, and on a manoeuvre after it.

    It holds for every disturbance within its bound, for ever (E89). The motion is cut
    into cells; the plan of the next tick has none that do not lie in one of these.

    Attributes:
        num_cells: How many cells it is cut into, at most.
        box: ``box(first, last)`` encloses [x; t] in the cells from `first` to before
            `last`. A wider span's box contains a narrower one's.
        beyond: ``beyond(cell)`` encloses [x; t] from the start of a cell on for ever;
            None if the cells are all there is, or if nothing encloses it.
    """

    num_cells: int
    box: Callable[[int, int], Box]
    beyond: Callable[[int], Box | None] | None = None


class Manoeuvre(ABC):
    """A law that leads the plant to safety, with a tube around where it leads.

    Attributes:
        horizon: For how long method backup follows the law [s]; 0 where it has none.
        first: Which inputs give way first where a plan is not safe: the others keep
            what the filter chose, if that helps.
        aside: Which of the others may go to a limit instead, where the first ones then
            give way less: a car steers round what it would brake before.
    """

    first: tuple[int, ...]
    aside: tuple[int, ...] = ()
    horizon = 0.0

    @abstractmethod
    def input(self, state: Array) -> Array:
        """Returns the manoeuvre's input u_b(x), inside the input set, shape (m,).

        Args:
            state: x at a tick, shape (n,).
        """

    @abstractmethod
    def plan(self, state: Array, time: float, u: Array) -> Plan:
        """Returns where an input leads, held for a period, and the manoeuvre after it.

        Args:
            state: x at a tick, shape (n,).
            time: When that is [s].
            u: The input, shape (m,).
        """

    def law(self, x: Expressions) -> Sequence[Any]:
        """Returns a smooth form of the law, for method backup: m expressions.

        Args:
            x: The state's symbols, shape (n,).
        """
        raise NotImplementedError


MakeManoeuvres: TypeAlias = Callable[[Array, Array, float, float], Sequence[Manoeuvre]]
"""Makes a plant's manoeuvres of its least and greatest inputs, (m,) each, the bound
delta1 of the disturbance [m/s^2] and the period [s]; none where none is safe."""
