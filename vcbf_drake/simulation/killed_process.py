"""A filter's process that is killed now and then, and starts again knowing nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from vcbf_drake.disturbances import (
    DisturbanceObserver,
    LinearDisturbanceObserver,
    RiseObserver,
)
from vcbf_drake.safety import FilterDecision, FilterStatus
from vcbf_drake.simulation.unreliable_filter import UnreliableSafetyFilter

if TYPE_CHECKING:
    _AnyObserver = DisturbanceObserver
else:
    # Of a class's bases, one alone may be pydrake's.
    _AnyObserver = object

# Ticks are compared with this part of a period to spare.
_TO_SPARE = 1e-6


@dataclass(frozen=True)
class Outages:
    """When the process is down; that depends on the seed and the tick alone.

    Attributes:
        probability: That it is killed at a tick.
        duration: How long it then takes until it runs again [s].
        period: The time between ticks [s].
        seed: Of the generator.
    """

    probability: float
    duration: float
    period: float
    seed: int

    def is_down(self, t: float) -> bool:
        """Returns whether the process is down at a time [s]."""
        tick = math.floor(t / self.period + _TO_SPARE)
        length = max(1, math.ceil(self.duration / self.period - _TO_SPARE))
        recent = range(max(0, tick - length + 1), tick + 1)
        return any(_is_killed(self.seed, each, self.probability) for each in recent)


@lru_cache(maxsize=4096)
def _is_killed(seed: int, tick: int, probability: float) -> bool:
    return bool(np.random.default_rng([seed, tick, 1]).random() < probability)


class KilledSafetyFilter(UnreliableSafetyFilter):
    """Asks for nothing while its process is down: a vehicle's fallback is no input.

    .. pydrake_system::

        name: KilledSafetyFilter

    Its ports are the filter's.
    """

    def __init__(self, *arguments: Any, outages: Outages, **keywords: Any) -> None:
        """Declares what an `UnreliableSafetyFilter` declares.

        Args:
            *arguments: The filter's.
            outages: When the process is down.
            **keywords: The filter's.
        """
        super().__init__(*arguments, **keywords)
        self._outages = outages

    def _calc_decision(self, context: Context) -> FilterDecision:
        if not self._outages.is_down(context.get_time()):
            return super()._calc_decision(context)
        nothing = np.zeros(self.input_set.num_inputs)
        return FilterDecision(self.input_set.project(nothing), FilterStatus.FAILED)


class _Killed(_AnyObserver):
    """Forgets everything while its process is down."""

    outages: Outages

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        if not self.outages.is_down(context.get_time()):
            super()._update(context, discrete)
            return
        forgotten = np.zeros(discrete.size())
        forgotten[: self._memory_start] = np.nan
        discrete.set_value(forgotten)


class KilledRiseObserver(_Killed, RiseObserver):
    """A `RiseObserver` that starts again after every outage.

    .. pydrake_system::

        name: KilledRiseObserver
    """


class KilledLinearObserver(_Killed, LinearDisturbanceObserver):
    """A `LinearDisturbanceObserver` that starts again after every outage.

    .. pydrake_system::

        name: KilledLinearObserver
    """
