"""Certified lower bounds of the barrier rows over a hold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from typing import TypeAlias

import numpy as np

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.between_ticks.enclosures import (
    ReachTube,
    RowEnclosures,
    nominal_rate_over,
    reach_tube,
)
from vcbf_drake.between_ticks.interval import Interval, Number
from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.decision import FilterDecision, FilterStatus, Tick
from vcbf_drake.safety.qp import DisturbanceKnowledge

_Pair: TypeAlias = tuple[Array, Array]  # Middles and radii of intervals.

# The tolerance of a row's chi below 0, as for a row at the tick itself.
_TOLERANCE = 1e-9
# The excess of a margin over a row's loss without it: the next input loses a different
# amount.
_HEADROOM = 1.1
_ATTEMPTS = 5
# Bounds the rounding of the sums below, relative to the sum of their terms' sizes.
_ROUNDING = 1e-12


class HeldRows:
    """The rows' values while an input is held, bounded from below (E83).

    Attributes:
        period: The hold period [s].
    """

    def __init__(
        self,
        model: ControlAffineModel,
        barrier_set: BarrierSet,
        period: float,
        disturbance_bound: float,
    ) -> None:
        """Makes the enclosures of the rows.

        Args:
            model: The plant.
            barrier_set: The rows.
            period: The hold period [s].
            disturbance_bound: delta1 [m/s^2].

        Raises:
            ModelError: The model or a row has no enclosure on intervals.
        """
        RowEnclosures.at(barrier_set, 0.0, np.zeros(barrier_set.obstacles_size))
        with contextlib.suppress(ArithmeticError, ValueError):  # Singular at 0.
            nominal_rate_over(
                model,
                np.zeros(model.num_states).tolist(),
                np.zeros(model.num_inputs).tolist(),
            )
        # Ticks are whole periods up to rounding.
        self.period = period * (1.0 + _ROUNDING)
        self._model = model
        self._barriers = barrier_set
        self._disturbance_bound = disturbance_bound

    def disturbances(self, known: DisturbanceKnowledge) -> list[Interval]:
        """Returns where each channel of d is: near its estimate, and within delta1.

        Args:
            known: The knowledge of the disturbance until the next tick.
        """
        ball = Interval(-known.bound, known.bound)
        return [self.bounded(ball + estimate) for estimate in known.estimate.tolist()]

    def bounded(self, channel: Interval) -> Interval:
        """Returns the part of an interval that is within delta1.

        Args:
            channel: The interval of a channel of d, by an estimate [m/s^2].
        """
        most = self._disturbance_bound
        low, high = max(channel.low, -most), min(channel.high, most)
        # An impossible estimate, too far off, is replaced by the nearest possible one.
        return Interval(min(low, most), max(high, -most))

    def tube(
        self,
        start: Sequence[Number],
        inputs: Sequence[Number],
        disturbances: Sequence[Number],
    ) -> ReachTube | None:
        """Returns a tube around the state until the next tick; None without one.

        Args:
            start: The state at the tick, n numbers or intervals.
            inputs: The held input, m of them.
            disturbances: The disturbance, q of them.
        """
        try:
            return reach_tube(self._model, start, inputs, disturbances, self.period)
        except (ArithmeticError, ValueError):
            return None

    def least(self, tick: Tick, u: Array) -> Array:
        """Returns a lower bound of every row's chi until the next tick, shape (N,).

        It is -inf where none was found.

        Args:
            tick: The data of the last tick.
            u: The input that is held, shape (m,).
        """
        d = self.disturbances(tick.known)
        tube = self.tube(tick.state.tolist(), u.tolist(), d)
        if tube is None:
            return np.full(self._barriers.size, -np.inf)
        box = [*tube.states, Interval(0.0, self.period) + tick.time]
        enclosures = RowEnclosures.at(self._barriers, tick.time, tick.obstacles)
        weights = _pair([*(-u).tolist(), 1.0, *d])
        # Far from its bound, a row is safe wherever in the tube the state is (E86) ...
        least = _least_products(_middle_and_radius(*enclosures.entries(box)), weights)
        near = np.flatnonzero(~(least >= 0.0)).tolist()
        if near:  # ... and else its rate says how much it can lose (E85).
            gradients = _middle_and_radius(*enclosures.gradients(box, near))
            rates = _least_rates(weights, gradients, _pair([*tube.rates, 1.0]))
            lasting = tick.chi(u)[near] + self.period * np.minimum(rates, 0.0)
            least[near] = np.fmax(least[near], lasting)
        return np.where(np.isnan(least), -np.inf, least)

    def can_enclose(self, state: Array, u: Array) -> bool:
        """Returns whether the motion until the next tick has a tube at all.

        Where the period times the slope of dx/dt is about 1, it has none, and every
        row's least chi is -inf.

        Args:
            state: The initial state of the motion, shape (n,).
            u: The input that is held, shape (m,).
        """
        q, most = self._model.num_disturbances, self._disturbance_bound
        d = [Interval(-most, most)] * q
        return self.tube(state.tolist(), u.tolist(), d) is not None

    def lasting_decision(
        self,
        tick: Tick,
        decision: FilterDecision,
        choose: Callable[[Array], FilterDecision],
    ) -> FilterDecision:
        """Returns a decision under which the rows hold until the next tick (E88).

        A row that would not hold gets a margin: its loss, and some more. If no input
        satisfies the margins, the decision stays, and its `row_margin` is negative.

        Args:
            tick: The tick of the decision.
            decision: The one without a margin.
            choose: Returns the decision under margins, shape (N,).
        """
        if decision.status >= FilterStatus.INFEASIBLE:
            return decision
        least, margin = self.least(tick, decision.input), np.zeros(self._barriers.size)
        found = plain = _judged(decision, least)
        for _ in range(_ATTEMPTS):
            lacking = least < -_TOLERANCE
            if not lacking.any():
                break
            loss = tick.chi(found.input) - least
            margin = np.where(lacking, _HEADROOM * loss, margin)
            found = choose(margin)
            if found.status >= FilterStatus.INFEASIBLE:
                return plain
            least = self.least(tick, found.input)
            found = _judged(found, least)
        return found


def _judged(decision: FilterDecision, least: Array) -> FilterDecision:
    return decision._replace(row_margin=float(np.min(least, initial=np.inf)))


# Singular rows have infinite ends, which become nan here.
@np.errstate(invalid="ignore")
def _least_products(entries: _Pair, weights: _Pair) -> Array:
    """Returns the least of b + w'd - A u for each row (E86), shape (N,)."""
    (middle, radius), (z, z_radius) = entries, weights
    z_most, most = np.abs(z) + z_radius, np.abs(middle) + radius
    uncertain = radius @ z_most + np.abs(middle) @ z_radius
    least: Array = middle @ z - uncertain - _ROUNDING * (most @ z_most)
    return least


@np.errstate(invalid="ignore")
def _least_rates(weights: _Pair, gradients: _Pair, rates: _Pair) -> Array:
    """Returns the least of z' G F for each row (E85), shape (N,)."""
    (z, z_radius), (G, G_radius), (F, F_radius) = weights, gradients, rates
    z_most, G_most, F_most = (
        np.abs(z) + z_radius,
        np.abs(G) + G_radius,
        np.abs(F) + F_radius,
    )
    slope = z @ G
    slope_radius = np.abs(z) @ G_radius + z_radius @ G_most
    uncertain = np.abs(slope) @ F_radius + slope_radius @ F_most
    least: Array = slope @ F - uncertain - _ROUNDING * (z_most @ G_most @ F_most)
    return least


def _pair(numbers: Sequence[Number]) -> _Pair:
    ends = [(n.low, n.high) if isinstance(n, Interval) else (n, n) for n in numbers]
    return _middle_and_radius(*np.array(ends).T)


@np.errstate(invalid="ignore")
def _middle_and_radius(low: Array, high: Array) -> _Pair:
    middle = 0.5 * (low + high)
    return middle, np.maximum(high - middle, middle - low)
