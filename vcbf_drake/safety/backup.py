"""Gate: what a filter asks of its inputs so that it never runs out of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.manoeuvre import Manoeuvre
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


def manoeuvres_of(
    model: ControlAffineModel,
    input_set: InputSet,
    period: float,
    disturbance_bound: float,
) -> Sequence[Manoeuvre]:
    """Returns a plant's backup manoeuvres, one at least.

    Args:
        model: The plant.
        input_set: What the actuators can do, a box.
        period: For how long an input is held [s].
        disturbance_bound: delta1 [m/s^2].

    Raises:
        ModelError: The plant has none, or none that is safe under these limits, or the
            limits are no box.
    """
    if not input_set.is_box:
        raise ModelError("a backup manoeuvre needs limits of each input alone")
    if model.make_manoeuvres is None:
        raise ModelError(
            f"{model.name} has no backup manoeuvre: give the plant a method"
            " make_manoeuvres"
        )
    m = model.num_inputs
    lower, upper = -input_set.b[m:], input_set.b[:m]
    found = model.make_manoeuvres(lower, upper, disturbance_bound, period)
    if not found:
        raise ModelError(
            f"no backup manoeuvre of {model.name} is safe with these input limits and"
            f" |d| <= {disturbance_bound:g} m/s^2"
        )
    return found
