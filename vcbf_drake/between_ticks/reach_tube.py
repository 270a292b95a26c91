"""Where a state can be while an input is held: an enclosure that is certain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vcbf_drake.between_ticks.interval import Interval, Number, as_interval, hull
from vcbf_drake.model.control_affine import ControlAffineModel

# How much wider than needed a guess is, relative to how far the state moves.
_INFLATION = 0.1
_ATTEMPTS = 10


@dataclass(frozen=True)
class ReachTube:
    """A box that holds the state for a while, and its rates there.

    Attributes:
        states: Where the state is, n intervals.
        rates: Where dx/dt is, n intervals or numbers.
    """

    states: list[Interval]
    rates: list[Number]


def reach_tube(
    model: ControlAffineModel,
    start: Sequence[Number],
    inputs: Sequence[Number],
    disturbances: Sequence[Number],
    duration: float,
) -> ReachTube:
    """Returns a tube that the state does not leave for a while (E73).

    By Picard and Lindeloef: where the rates inside a box lead from the start, in any
    time up to the duration, to points of that box only, no run leaves it.

    Args:
        model: The plant.
        start: Where the state is at the beginning, n intervals or numbers.
        inputs: Where the input is, m of them.
        disturbances: Where the disturbance is, q of them.
        duration: For how long [s].

    Raises:
        ModelError: The model has no enclosure.
        ArithmeticError: The model is singular there, or moves too far for a box.
        ValueError: The model has no real value there.
    """
    elapsed = Interval(0.0, duration)
    box = [as_interval(x) for x in start]
    for _ in range(_ATTEMPTS):
        rates = _rates(model, box, inputs, disturbances)
        reached = [elapsed * rate + x for rate, x in zip(rates, start, strict=True)]
        if all(new in old for new, old in zip(reached, box, strict=True)):
            return ReachTube(reached, rates)
        box = [_widened(*each) for each in zip(box, reached, strict=True)]
    raise ArithmeticError(f"{model.name} moves too far in {duration:g} s for a box")


def _widened(box: Interval, reached: Interval) -> Interval:
    margin = _INFLATION * (reached.high - reached.low)
    return hull(box, Interval(reached.low - margin, reached.high + margin))


def _rates(
    model: ControlAffineModel,
    box: Sequence[Number],
    inputs: Sequence[Number],
    disturbances: Sequence[Number],
) -> list[Number]:
    """Encloses dx/dt = f + g u + E d over a box (E1)."""
    rates = model.nominal_rate_over(box, inputs)
    for i, row in enumerate(model.disturbance_matrix.tolist()):
        for factor, value in zip(row, disturbances, strict=True):
            if factor != 0.0:  # Most are, and each product costs.
                rates[i] = rates[i] + factor * value
    return rates
