"""Times on a link: a peer's clock, round trips, a motion's time, missed deadlines."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
import math
from typing import NamedTuple

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import ScenarioError
from vcbf_drake.hil.bus import Clock
from vcbf_drake.simulation.scenario import Scenario

_REMEMBERED = 65_536
_LONGEST = 60_000_000  # [us]
# How fast two clocks may drift apart.
_DRIFT = 200e-6
# How far a message may be from what is known of its sender's clock [us].
_TOLERANCE = 100_000
# So many messages in a row must agree on a step of a clock before it is believed.
_WITNESSES = 3
# How long messages stay late before that is taken for a clock that was set back [us].
_PATIENCE = 500_000

# No sender numbers messages faster than this [s].
SHORTEST_PERIOD = 1e-4


class Exchange(NamedTuple):
    """Four times of a message and of ours that it tells of, as in NTP [us].

    Attributes:
        sent: When it was sent, by the peer's clock.
        received: When it came, by ours.
        ours_sent: When ours was sent, by ours; None if it tells of none.
        ours_age: How long before it ours had come to the peer.
    """

    sent: int
    received: int
    ours_sent: int | None = None
    ours_age: int | None = None


class PeerClock:
    """By how much a peer's clock is ahead of ours, from the messages exchanged.

    A message takes time, so a message from the peer says that its clock is ahead by at
    least ``sent - received``, and one of ours, by the time it came there, by at most
    that difference. The offset is in the middle of the tightest such interval, which
    widens with the drift of two clocks. Before a round trip is known only the first
    half counts: the fastest message is taken to need no time.

    A message that contradicts the interval by more than 0.1 s is not believed: a forged
    one must not move the clock. When three in a row agree with each other, the clock
    has been set, and everything begins anew.

    Source: D. L. Mills, RFC 5905, section 8 (the four times); the interval is ours.

    Attributes:
        steps: How often the peer's clock was set.
        last_step: By how much the last time [us].
    """

    def __init__(self) -> None:
        self.steps, self.last_step = 0, 0
        self._low: float = -math.inf
        self._high: float = math.inf
        self._at = 0
        self._witnesses: list[Exchange] = []
        self._behind_since: int | None = None

    @property
    def offset(self) -> int:
        """By how much the peer's clock is ahead [us]; 0 before the first message."""
        if math.isinf(self._low):
            return 0
        return round(self._low if math.isinf(self._high) else self._middle())

    @property
    def uncertainty(self) -> float:
        """How far off the offset may be [us]; infinite before the first round trip."""
        return (self._high - self._low) / 2

    def listen(self, exchange: Exchange) -> bool:
        """Takes a message's times; returns whether they fit what is known."""
        low, high = _bounds(exchange)
        widening = _DRIFT * (exchange.received - self._at)
        least, most = self._low - widening, self._high + widening
        if math.isinf(self._low) or self._fits(low, high, least, most):
            self._low, self._high = max(least, low), min(most, high)
            if self._low > self._high:  # By less than the tolerance.
                self._low = self._high = self._middle()
            self._at = exchange.received
            self._witnesses.clear()
            self._look_behind(exchange, least - low)
            return True
        return self._hear_witness(exchange)

    def _fits(self, low: float, high: float, least: float, most: float) -> bool:
        """Whether it neither comes from before the fastest, nor from the future."""
        ahead = low - most if math.isfinite(most) else low - least
        return ahead <= _TOLERANCE and least - high <= _TOLERANCE

    def _look_behind(self, exchange: Exchange, behind: float) -> None:
        """Before a round trip is known: takes what stays late for a clock set back."""
        if behind <= _TOLERANCE or math.isfinite(self._high):
            self._behind_since = None
        elif self._behind_since is None:
            self._behind_since = exchange.received
        elif exchange.received - self._behind_since > _PATIENCE:
            self._begin_anew([exchange])

    def _hear_witness(self, exchange: Exchange) -> bool:
        """Whether this message is the third in a row that says the same."""
        if self._witnesses:
            last = self._witnesses[-1]
            moved = _bounds(exchange)[0] - _bounds(last)[0]
            if abs(moved) > _TOLERANCE:
                self._witnesses.clear()
        self._witnesses.append(exchange)
        if len(self._witnesses) < _WITNESSES:
            return False
        self._begin_anew(self._witnesses)
        return True

    def _begin_anew(self, witnesses: list[Exchange]) -> None:
        before = self.offset
        self._low = max(_bounds(each)[0] for each in witnesses)
        # What ours_age says was measured with a clock that was set meanwhile.
        self._high = math.inf
        self._at = witnesses[-1].received
        self.steps, self.last_step = self.steps + 1, self.offset - before
        self._witnesses, self._behind_since = [], None

    def _middle(self) -> float:
        return (self._low + self._high) / 2


def _bounds(exchange: Exchange) -> tuple[float, float]:
    """The least and the greatest offset that a message allows [us]."""
    low = exchange.sent - exchange.received
    if exchange.ours_sent is None or exchange.ours_age is None:
        return low, math.inf
    high = exchange.sent - exchange.ours_age - exchange.ours_sent
    # No round trip is as long, and none takes less than no time: whoever says so has
    # not filled in those times, or has set its clock since ours came.
    return low, high if -_TOLERANCE <= high - low < _LONGEST else math.inf


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
        ScenarioError: A time limit is shorter than the control period, or that is
            shorter than an inbox believes of any sender; or obstacles are in sight only
            where a simulation looks.
    """
    if scenario.faults.sight > 0.0:
        raise ScenarioError(
            f"faults.sight: {scenario.faults.sight:g} m; it must be 0 on a bus, where a"
            " vehicle says what it sees (hardware.obstacles: perceived)"
        )
    if scenario.period < SHORTEST_PERIOD:
        raise ScenarioError(
            f"period: {scenario.period:g} s; on a bus it must be at least"
            f" {SHORTEST_PERIOD:g} s"
        )
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
