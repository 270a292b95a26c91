"""Gate: what a filter asks of its inputs so that it never runs out of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeAlias

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.qp import FilterDecision
from vcbf_drake.safety.row_holder import Tick


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
    [ControlAffineModel, BarrierSet, InputSet, float, float], Gate
]
"""Makes one of the plant, its rows, the input limits, how long an input is held [s],
and delta1 [m/s^2]."""
