"""Backup manoeuvres: control laws that lead a plant to safety, and their tubes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from vcbf_drake.checks import Array
from vcbf_drake.model.formulas import Expressions

Box: TypeAlias = list[tuple[float, float]]
"""Least and greatest value of every state and, last, of the time [s]: n + 1 pairs."""

# The bound that represents infinity: intervals have finite ends.
FOREVER = 1e9
ANYWHERE = 1e6


@dataclass(frozen=True)
class Plan:
    """The tube of a plant while an input is held, and on a manoeuvre after it.

    It holds for every disturbance within its bound, for all time (E89). The motion is
    cut into cells; every cell of the next tick's plan lies in one of these.

    Attributes:
        num_cells: The number of cells, at most.
        box: ``box(first, last)`` encloses [x; t] in the cells from `first` to before
            `last`. A wider span's box contains a narrower one's.
        beyond: ``beyond(cell)`` encloses [x; t] from the start of a cell on, for all
            time; None if there is nothing beyond the cells, or no enclosure.
    """

    num_cells: int
    box: Callable[[int, int], Box]
    beyond: Callable[[int], Box | None] | None = None


class Manoeuvre(ABC):
    """A control law that leads the plant to safety, with a tube around the motion.

    Attributes:
        horizon: The time for which method backup follows the law [s]; 0 without a law.
        obeys_limits: Whether the law satisfies limits of the input that depend on the
            state, as one of a car's steering; if not, it is used only without them.
        first: The indices of the inputs that give way first where a plan is not safe:
            the others keep the filter's values, if that suffices.
        aside: The indices of other inputs that may go to a limit, so that the first
            ones give way less: a car steers around an obstacle before it brakes.
    """

    first: tuple[int, ...]
    aside: tuple[int, ...] = ()
    horizon = 0.0
    obeys_limits = True

    @abstractmethod
    def input(self, state: Array) -> Array:
        """Returns the manoeuvre's input u_b(x), inside the input set, shape (m,).

        Args:
            state: x at a tick, shape (n,).
        """

    @abstractmethod
    def plan(self, state: Array, time: float, u: Array) -> Plan | None:
        """Returns the plan of an input, held for a period, and the manoeuvre after it.

        None where the manoeuvre does not lead to safety from there.

        Args:
            state: x at a tick, shape (n,).
            time: The time of that tick [s].
            u: The input, shape (m,).
        """

    def detour(self, state: Array) -> float:
        """Returns how far it leads from the way at a state: the least comes first.

        Args:
            state: x at a tick, shape (n,).
        """
        return 0.0

    def law(self, x: Expressions) -> Sequence[Any]:
        """Returns a smooth form of the law, for method backup: m expressions.

        Args:
            x: The state's symbols, shape (n,).
        """
        raise NotImplementedError


MakeManoeuvres: TypeAlias = Callable[[Array, Array, float, float], Sequence[Manoeuvre]]
"""Makes a plant's manoeuvres of its least and greatest inputs, (m,) each, the bound
delta1 of the disturbance [m/s^2] and the period [s]; none where none is safe."""
