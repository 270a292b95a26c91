"""RowHolder and Gate: what a filter asks beyond its tick, of rows and of inputs."""

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
    """What is known at one tick.

    Attributes:
        rows: The barrier rows.
        state: Shape (n,).
        time: When it is [s].
        known: What is known of the disturbance until the next tick.
        obstacles: What is perceived, shape (obstacles_size,).
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
            tick: Where it is made.
            decision: The one that asks for the tick alone.
            choose: Returns the decision under margins, shape (N,).
        """


MakeRowHolder: TypeAlias = Callable[
    [ControlAffineModel, BarrierSet, float, float], RowHolder
]
"""Makes one of the plant, its rows, how long an input is held [s], and delta1."""


class Gate(Protocol):
    """Lets inputs pass that a certified way to safety follows on.

    `vcbf_drake.between_ticks.BackupGate` is one.
    """

    def decide(self, tick: Tick, decision: FilterDecision) -> FilterDecision:
        """Returns a decision with a certified way to safety, where there is one.

        Args:
            tick: Where it is made.
            decision: The method's own.
        """


MakeGate: TypeAlias = Callable[
    [ControlAffineModel, BarrierSet, InputSet, float, float, NDArray[np.bool_]], Gate
]
"""Makes one of the plant, its rows, the input limits, how long an input is held [s],
delta1 [m/s^2], and which rows are hard, (N,)."""

_Made = TypeVar("_Made")


def given(setting: str, make: Callable[..., _Made] | None) -> Callable[..., _Made]:
    """Returns what `AddSafetyFilter` gives, of a room that the filter does not know.

    Args:
        setting: What asks for it.
        make: Makes it.

    Raises:
        ValueError: There is none.
    """
    if make is None:
        raise ValueError(
            f"{setting}; it needs what vcbf_drake.between_ticks makes for it"
            " (AddSafetyFilter gives it)"
        )
    return make
