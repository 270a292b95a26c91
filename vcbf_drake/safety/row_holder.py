"""RowHolder and Gate: guarantees of rows and inputs beyond a tick."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers import BarrierRows, BarrierSet
from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.feasible_set import DisturbanceKnowledge, disturbance_margin
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.qp import FilterDecision


class Tick(NamedTuple):
    """The data of one tick.

    Attributes:
        rows: The barrier rows.
        state: Shape (n,).
        time: The time of the tick [s].
        known: The knowledge of the disturbance until the next tick.
        obstacles: The perceived obstacles, shape (obstacles_size,).
    """

    rows: BarrierRows
    state: Array
    time: float
    known: DisturbanceKnowledge
    obstacles: Array | None = None

    def chi(self, u: Array) -> Array:
        """Returns b + Lambda - A u, shape (N,).

        Args:
            u: An input, shape (m,).
        """
        margin = disturbance_margin(self.rows, self.known)
        chi: Array = self.rows.b + margin - self.rows.A @ u
        return chi


class RowHolder(Protocol):
    """Finds inputs under which the rows hold until the next tick.

    `vcbf_drake.between_ticks.HeldRows` is one.
    """

    def can_enclose(self, state: Array, u: Array) -> bool:
        """Returns whether the motion from a state under an input can be enclosed."""

    def lasting_decision(
        self,
        tick: Tick,
        decision: FilterDecision,
        choose: Callable[[Array], FilterDecision],
    ) -> FilterDecision:
        """Returns a decision under which the rows last, where there is one.

        Args:
            tick: The tick of the decision.
            decision: The decision for the tick alone.
            choose: Returns the decision under margins, shape (N,).
        """


MakeRowHolder: TypeAlias = Callable[
    [ControlAffineModel, BarrierSet, float, float], RowHolder
]
"""Makes one of the plant, its rows, how long an input is held [s], and delta1."""


class Gate(Protocol):
    """Lets inputs pass that a certified plan follows on.

    `vcbf_drake.between_ticks.BackupGate` is one.
    """

    def decide(self, tick: Tick, decision: FilterDecision) -> FilterDecision:
        """Returns a decision with a certified plan, where there is one.

        Args:
            tick: The tick of the decision.
            decision: The method's own.
        """


MakeGate: TypeAlias = Callable[
    [ControlAffineModel, BarrierSet, InputSet, float, float, NDArray[np.bool_]], Gate
]
"""Makes one of the plant, its rows, the input limits, how long an input is held [s],
delta1 [m/s^2], and which rows are hard, (N,)."""

_Made = TypeVar("_Made")


def given(setting: str, make: Callable[..., _Made] | None) -> Callable[..., _Made]:
    """Returns an object that `AddSafetyFilter` provides from another package.

    Args:
        setting: The setting that requires it.
        make: The function that makes it.

    Raises:
        ValueError: No function is given.
    """
    if make is None:
        raise ValueError(
            f"{setting}; it needs what vcbf_drake.between_ticks makes for it"
            " (AddSafetyFilter gives it)"
        )
    return make
