"""Times on a link: round trips, a motion's time by the clock, time limits."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import ScenarioError
from vcbf_drake.hil.bus import Clock
from vcbf_drake.simulation.scenario import Scenario

_REMEMBERED = 65_536
_LONGEST = 60_000_000  # [us]


class RoundTrip:
    """Collects durations of round trips; the last 65 536 of them count.

    Attributes:
        milliseconds: What was collected [ms].
    """

    def __init__(self) -> None:
        self.milliseconds: deque[float] = deque(maxlen=_REMEMBERED)

    def add(self, duration: int) -> None:
        """Adds a duration [us], unless it makes no sense: stamps may be forged."""
        if 0 <= duration < _LONGEST:
            self.milliseconds.append(1e-3 * duration)


class Timeline:
    """Ties a simulation's time to a clock.

    Args:
        clock: The clock.

    Attributes:
        start: The clock's time at the simulation's time 0 [us].
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.start = clock.utime()

    def restart(self) -> None:
        """Makes now the simulation's time 0."""
        self.start = self._clock.utime()

    def utime(self, time: float) -> int:
        """Returns the clock's time at a simulation's time [us]."""
        return self.start + round(1e6 * time)

    def time(self) -> float:
        """Returns the simulation's time now, by the clock [s]."""
        return 1e-6 * (self._clock.utime() - self.start)


def check_timing(scenario: Scenario) -> None:
    """Checks that no watchdog bites between one message and the next.

    Raises:
        ScenarioError: A time limit is shorter than the control period.
    """
    for name in ("command_timeout", "max_state_age"):
        limit = getattr(scenario.hardware, name)
        if limit <= scenario.period:
            raise ScenarioError(
                f"hardware.{name}: {limit:g} s; it must be above the control period,"
                f" {scenario.period:g} s"
            )


def median_and_p99(values: Collection[float] | Array) -> dict[str, float | None]:
    """Returns both percentiles of the values, None where there are none."""
    if not len(values):
        return {"median": None, "p99": None}
    median, p99 = np.percentile(list(values), [50.0, 99.0])
    return {"median": float(median), "p99": float(p99)}
