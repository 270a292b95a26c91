"""Certified lower bounds of a run's barriers, at the ticks and between them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np

from vcbf_drake.barriers import Barrier
from vcbf_drake.between_ticks.enclosures import RowEnclosures
from vcbf_drake.between_ticks.held_rows import HeldRows
from vcbf_drake.between_ticks.interval import Interval
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.safety import (
    Assumption,
    DisturbanceKnowledge,
    FilterSettings,
    SafetyFilter,
    Tick,
)

# The number of ticks processed together: a log on disk need not fit the memory.
_BLOCK = 4096
# Hypotheses that make the guarantees but no part of what is said of the rows here.
_IRRELEVANT = (
    "start inside",
    "input authority",
    "volume at the start",
    "total derivative of the volume",
)


def known_along(
    log: Mapping[str, Array], safety_filter: SafetyFilter, disturbance_bound: float
) -> tuple[Array, Array]:
    """Returns a method's estimates (T, q) of the disturbance and their bounds (T,).

    Args:
        log: The arrays of the log, one row a control tick.
        safety_filter: The filter that ran.
        disturbance_bound: delta1 [m/s^2].
    """
    handling = safety_filter.method.disturbance
    if handling == "estimated":
        return log["disturbance_estimate"], log["error_bound"]
    bound = disturbance_bound if handling == "worst_case" else 0.0
    T, q = len(log["time"]), safety_filter.model.num_disturbances
    return np.broadcast_to(0.0, (T, q)), np.broadcast_to(bound, T)


def is_certifiable(settings: FilterSettings, assumptions: Sequence[Assumption]) -> bool:
    """Returns whether knowledge of state and disturbance permits a certificate.

    Args:
        settings: The settings of the run.
        assumptions: Its hypotheses.
    """
    # The explicit step's bound is calibrated, not proven (E27).
    return settings.observer.step != "explicit" and all(
        each.holds is not False or each.name.startswith(_IRRELEVANT)
        for each in assumptions
    )


def certified_least_barrier(
    safety_filter: SafetyFilter,
    log: Mapping[str, Array],
    holds: int,
    period: float,
    disturbance_bound: float,
) -> float:
    """Returns a lower bound of every h of a run, at the ticks and between them (E87).

    It holds for every disturbance that agrees with the estimates at the ticks. -inf
    where nothing is certain, inf without a barrier.

    Args:
        safety_filter: The filter that ran.
        log: The arrays of the log, one row a control tick.
        holds: The number of ticks whose inputs were held for a whole period.
        period: The control period [s].
        disturbance_bound: delta1 [m/s^2].

    Raises:
        ModelError: The plant or a barrier has no enclosure on intervals.
    """
    run = _Holds(safety_filter, log, period, disturbance_bound)
    least = _least(log["barriers"][: holds + 1])
    spans = [(0, holds)] if holds else []
    while spans:
        first, last = spans.pop()
        # Most of a run is far from every barrier: a few large boxes show that.
        if run.least_of_many(first, last) >= least:
            continue
        if last == first + 1:
            least = min(least, run.least(first))
        else:
            middle = (first + last) // 2
            spans += [(first, middle), (middle, last)]
    return least


class _Holds:
    """The holds of a run, each from its tick to the next."""

    def __init__(
        self,
        safety_filter: SafetyFilter,
        log: Mapping[str, Array],
        period: float,
        disturbance_bound: float,
    ) -> None:
        self._model = safety_filter.model
        self._barriers = safety_filter.barrier_set
        for name, each in zip(
            safety_filter.barrier_set.names, safety_filter.barriers, strict=True
        ):
            if isinstance(each, Barrier) and each.class_k is not None:
                raise ModelError(f"'{name}': heights are certified for linear class_k")
        self._decay_rates = {
            row: each.decay_rates
            for row, each in enumerate(safety_filter.barriers)
            if isinstance(each, Barrier)
        }
        self._early: dict[int, dict[int, int]] = defaultdict(dict)
        for row in safety_filter.barrier_set.early:
            limit: Any = safety_filter.barriers[row]
            self._early[limit.row][limit.level] = row
        self._rows = HeldRows(self._model, self._barriers, period, disturbance_bound)
        self._times, self._states = log["time"], log["state"]
        self._inputs, self._period = log["input"], period
        self._estimates, self._bounds = known_along(
            log, safety_filter, disturbance_bound
        )
        is_estimated = safety_filter.method.disturbance == "estimated"
        self._hold_margin = safety_filter.hold_margin if is_estimated else 0.0

    def least_of_many(self, first: int, last: int) -> float:
        """Returns a lower bound of every h from one tick to another."""
        span = slice(first, last)
        tube = self._rows.tube(
            _hulls(self._states[span]),
            _hulls(self._inputs[span]),
            self._disturbances(first, last),
        )
        if tube is None:
            return -math.inf
        start, end = self._times[first], self._times[last - 1] + self._rows.period
        box = [*tube.states, Interval(float(start), float(end))]
        low, _ = RowEnclosures.at(self._barriers, float(start)).values(box)
        return _least(low[list(self._decay_rates)])

    def least(self, k: int) -> float:
        """Returns a lower bound of every h while the input of one tick is held."""
        x, t = self._states[k], float(self._times[k])
        tick = Tick(self._barriers.rows(x, t), x, t, self._known(k))
        chi = self._rows.least(tick, self._inputs[k])
        found = [
            least_height(
                tick.rows.chain[row],
                rates,
                float(chi[row]),
                self._period,
                {level: float(chi[early]) for level, early in self._early[row].items()},
            )
            for row, rates in self._decay_rates.items()
        ]
        # Where a barrier is singular nothing is certain.
        return -math.inf if any(map(math.isnan, found)) else min(found)

    def _known(self, k: int) -> DisturbanceKnowledge:
        """Returns the filter's knowledge of the disturbance at one tick."""
        estimate, bound = self._estimates[k], float(self._bounds[k])
        return DisturbanceKnowledge(
            estimate, np.zeros_like(estimate), bound + self._hold_margin, 0.0, 0.0
        )

    def _disturbances(self, first: int, last: int) -> list[Interval]:
        """Returns where each channel of d is from one tick to another."""
        lows, highs = [], []
        for start in range(first, last, _BLOCK):
            block = slice(start, min(start + _BLOCK, last))
            bounds = (self._bounds[block] + self._hold_margin)[:, None]
            lows.append((self._estimates[block] - bounds).min(axis=0))
            highs.append((self._estimates[block] + bounds).max(axis=0))
        least, most = np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist()
        return [
            self._rows.bounded(Interval(low, high) + 0.0)  # Rounds outwards.
            for low, high in zip(least, most, strict=True)
        ]


def least_height(
    chain: Array,
    decay_rates: Array,
    least_chi: float,
    duration: float,
    early: Mapping[int, float] | None = None,
) -> float:
    """Returns a lower bound of h while an input is held, by comparison (E87).

    Args:
        chain: phi^0, ..., phi^(r-1) at the tick, shape (r,).
        decay_rates: lambda_1, ..., lambda_r, shape (r,).
        least_chi: A lower bound of phi^(r-1)' + lambda_r phi^(r-1).
        duration: The hold period [s].
        early: Lower bounds of phi^(k-1)' + lambda_k phi^(k-1) for each derivative k
            that an input enters early (E8a).
    """
    least, r = least_chi, len(chain)
    levels = zip(
        range(r, 0, -1), chain[::-1].tolist(), decay_rates[::-1].tolist(), strict=True
    )
    for k, phi, rate in levels:
        least = (early or {}).get(k, least)
        decay = math.exp(-rate * duration)
        at_end = decay * phi + (1.0 - decay) / rate * least
        least = at_end if math.isnan(at_end) else min(phi, at_end)
    return least


def _hulls(points: Array) -> list[Interval]:
    """Returns the box that holds points, shape (k, n)."""
    ends = np.array([points.min(axis=0), points.max(axis=0)]).T.tolist()
    return [Interval(low, high) for low, high in ends]


def _least(values: Array) -> float:
    return float(np.fmin.reduce(values, axis=None, initial=np.inf))
