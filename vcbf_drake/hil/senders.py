"""Senders on the bus: sequence numbers, time of the motion, and clock.

Most reasons to reject a message are found here.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum
import math
from typing import Any

from vcbf_drake.checks import require
from vcbf_drake.simulation.scenario import Scenario

# The shortest period of a sender's messages [s].
SHORTEST_PERIOD = 1e-4
# The number of sequence numbers back that tell a late message from a repeated one.
_WINDOW = 64
# The number of messages that may be faster than `SHORTEST_PERIOD`.
_BURST = 100
# The most by which a motion's time may run ahead of the clock [us].
_TIME_AHEAD = 100_000

# The bound of a round trip [us].
LONGEST_ROUND_TRIP = 60_000_000
# The relative drift of two clocks, and the greatest rate of a correction.
_DRIFT, _FASTEST = 200e-6, 0.1
# The most by which a message may contradict the estimate of its sender's clock [us].
_TOLERANCE = 100_000
# Messages in a row that must agree on a step of a clock before it is accepted, and the
# time [us] until the next step may be: a clock that keeps stepping is refused.
_WITNESSES, _BETWEEN_STEPS = 3, 5_000_000
# The time for which messages stay late before the clock counts as set back [us].
_PATIENCE = 500_000


class Reason(Enum):
    """The reason for which a message is rejected."""

    LENGTH = "wrong length"
    TYPE = "another type"
    SIGNATURE = "not signed with our key"
    VERSION = "unknown version"
    SIZE = "array of another size"
    NUMBER = "not a finite number of sensible size"
    CODE = "unknown code"
    STAMPS = "contradictory time stamps or sequence"
    TIME = "its motion's time leaps"
    FUTURE = "from the future"
    PAST = "from the past"
    CLOCK = "contradicts its sender's clock"
    ADDRESS = "meant for another"
    SESSION = "of another sender than the one followed"
    REPEATED = "repeated"
    OVERTAKEN = "overtaken by a newer one"
    OLD = "too old"


@dataclass(frozen=True)
class Rejection:
    """The result in place of a rejected message."""

    reason: Reason
    detail: str = field(default="", compare=False)

    @property
    def words(self) -> str:
        """The reason and its details."""
        reason = self.reason.value
        return f"{reason} ({self.detail})" if self.detail else reason


class Sender:
    """The record of one session: message order, time of the motion, and clock.

    Attributes:
        session: The session.
        heard_at: The time its last message was accepted [us].
        clock: Its clock.
        skipped: The number of sequence numbers that the last message skipped; -1 if it
            was a skipped one.
    """

    def __init__(self, first: Any, now: int) -> None:
        self.session = first.session
        self.heard_at = now
        self.clock = PeerClock()
        self.skipped = 0
        self._is_known = False
        self._sequence, self._numbered_at = first.sequence - 1, now
        # Bit i stands for the sequence number i before the last one.
        self._seen = 0
        # The last motion's time, and a pair of it and our clock that it runs with.
        self._time = 0.0
        self._start = 0.0, now
        self._leaps = False

    def fault(
        self, message: Any, now: int, echo: tuple[int, int] | None, max_age: int
    ) -> Rejection | None:
        """Records the message's number and times; returns its fault."""
        self.skipped = 0
        contradiction = None if self._is_known else _contradiction(message)
        if contradiction is not None:
            return contradiction
        order = self._order(message, now)
        if order is not None:
            return Rejection(order)
        off = self.clock.listen(message.utime, now, echo)
        if off:
            return Rejection(Reason.CLOCK, f"by {1e-6 * off:.2f} s")
        measured = getattr(message, "utime_measured", message.utime)
        age = now + self.clock.offset - measured
        if age > max_age:
            return Rejection(Reason.OLD, f"{1e-6 * age:.2f} s")
        leap = self._leap_of_time(message, now, max_age)
        if leap is not None:
            return leap
        self._is_known, self.heard_at = True, now
        return None

    def _order(self, message: Any, now: int) -> Reason | None:
        back = self._sequence - message.sequence
        self.skipped = 0
        if back >= 0:
            if back >= _WINDOW or self._seen >> back & 1:
                return Reason.REPEATED
            self._seen |= 1 << back
            self.skipped = -1
            return Reason.OVERTAKEN
        # By our own clock: a forged number would otherwise keep the true ones out, as
        # having gone back, for ever.
        most = _BURST + 1e-6 * (now - self._numbered_at) / SHORTEST_PERIOD
        if self._is_known and -back > most:
            return Reason.STAMPS
        self.skipped = -back - 1
        earlier = self._seen << -back if -back < _WINDOW else 0
        self._seen = (earlier | 1) & ((1 << _WINDOW) - 1)
        self._sequence, self._numbered_at = message.sequence, now
        return None

    def _leap_of_time(self, message: Any, now: int, max_age: int) -> Rejection | None:
        """Records the motion's time, unless it goes back or leaps."""
        time = getattr(message, "time", 0.0)
        if self._is_known and time < self._time:
            return Rejection(Reason.TIME, f"back by {self._time - time:.3g} s")
        is_silent = now - self.heard_at > 2 * max_age
        # A vehicle whose time leaps keeps its record: it was silent for us alone.
        if not self._is_known or (is_silent and not self._leaps):
            self._start = time, now
        start, began = self._start
        elapsed = 1e-6 * (now - began)
        most = 1.001 * elapsed + 1e-6 * (max_age + _TIME_AHEAD)
        self._leaps = time - start > most
        if self._leaps:
            words = f"on by {time - start:.3g} s in {elapsed:.3g} s; its unit is s"
            return Rejection(Reason.TIME, words)
        self._time = time
        return None


def _contradiction(message: Any) -> Rejection | None:
    """The contradiction of a sender's first message with its own clock."""
    runs_for = message.utime - message.session
    measured = getattr(message, "utime_measured", message.utime)
    most = _BURST + runs_for * 1e-6 / SHORTEST_PERIOD
    if message.sequence > most or message.session > measured:
        return Rejection(Reason.STAMPS)
    time = getattr(message, "time", 0.0)
    if 1e6 * time > runs_for + _TIME_AHEAD:
        words = f"on by {time:.3g} s in a session of {1e-6 * runs_for:.3g} s"
        return Rejection(Reason.TIME, f"{words}; its unit is s")
    return None


class PeerClock:
    """Estimate of a peer's clock offset from ours, from the messages exchanged.

    A message takes time, so a message from the peer says that its clock is ahead by at
    least ``sent - received``, and one of ours, by the time it came there, by at most
    that difference. The offset is in the middle of the tightest such interval, which
    widens with the drift of two clocks. Before a round trip is known only the first
    half counts: the fastest message is taken to need no time. A clock of another pace
    is followed, by 10 % at most: so fast NTP's programs turn one.

    A message that contradicts the interval by more than 0.1 s is not believed: a forged
    one must not move the clock. When three in a row agree with each other, the clock
    has been set, and everything begins anew; at most once in 5 s, so that a clock that
    stands still is refused and not followed.

    Source: D. L. Mills, RFC 5905, section 8 (the four times); the interval is ours.

    Attributes:
        steps: The number of times that the peer's clock was set.
        last_step: The size of the last step [us].
    """

    def __init__(self) -> None:
        self.steps, self.last_step = 0, 0
        self._low: float = -math.inf
        self._high: float = math.inf
        self._at = 0
        self._stepped_at: float = -math.inf
        self._witnesses: deque[float] = deque(maxlen=_WITNESSES)
        self._behind_since: int | None = None

    @property
    def offset(self) -> int:
        """The lead of the peer's clock over ours [us]; 0 before the first message."""
        if math.isinf(self._low):
            return 0
        is_one_way = math.isinf(self._high)
        return round(self._low if is_one_way else (self._low + self._high) / 2)

    @property
    def uncertainty(self) -> float:
        """The error bound of the offset [us]; infinite before the first round trip."""
        return (self._high - self._low) / 2

    def listen(self, sent: int, received: int, echo: tuple[int, int] | None) -> float:
        """Updates the estimate with a message's times [us].

        Args:
            sent: The time of sending by the peer's clock.
            received: The time of arrival by ours.
            echo: The echo of one of our messages, see `Echo`.

        Returns:
            The amount by which it contradicts the estimate [us], 0 for none.
        """
        low, high = _bounds(sent, received, echo)
        elapsed = received - self._at
        least, most = self._low - _DRIFT * elapsed, self._high + _DRIFT * elapsed
        # It neither comes from before the fastest, nor from the future.
        ahead = low - most if math.isfinite(most) else low - least
        contradiction = max(ahead, least - high)
        if not math.isinf(self._low) and contradiction > _TOLERANCE:
            return 0.0 if self._has_been_set(low, received) else contradiction
        low_now, high_now = max(least, low), min(most, high)
        if low > most:
            low_now = high_now = min(low, self._high + _FASTEST * elapsed)
        elif high < least:
            low_now = high_now = max(high, self._low - _FASTEST * elapsed)
        self._low, self._high, self._at = low_now, high_now, received
        self._witnesses.clear()
        self._look_behind(low, received, least - low)
        return 0.0

    def _look_behind(self, low: float, received: int, behind: float) -> None:
        """Before the first round trip, detects a clock set back by lasting lateness."""
        if behind <= _TOLERANCE or math.isfinite(self._high):
            self._behind_since = None
        elif self._behind_since is None:
            self._behind_since = received
        elif received - self._behind_since > _PATIENCE:
            self._begin_anew(low, received)

    def _has_been_set(self, low: float, received: int) -> bool:
        """Whether this message is the third in a row with the same step."""
        witnesses = self._witnesses
        if witnesses and abs(low - witnesses[-1]) > _TOLERANCE:
            witnesses.clear()
        witnesses.append(low)
        if len(witnesses) < _WITNESSES:
            return False
        if received - self._stepped_at < _BETWEEN_STEPS:
            return False
        self._begin_anew(max(witnesses), received)
        return True

    def _begin_anew(self, low: float, received: int) -> None:
        before = self.offset
        # The echo was measured with a clock that was set meanwhile.
        self._low, self._high, self._at = low, math.inf, received
        self.steps, self.last_step = self.steps + 1, self.offset - before
        self._stepped_at, self._behind_since = received, None
        self._witnesses.clear()


def _bounds(
    sent: int, received: int, echo: tuple[int, int] | None
) -> tuple[float, float]:
    """The least and the greatest offset that a message allows [us]."""
    low = sent - received
    if echo is None:
        return low, math.inf
    ours_sent, ours_age = echo
    high = sent - ours_age - ours_sent
    # No round trip is that long or negative: the sender has not filled in these times,
    # or has set its clock since our message arrived.
    return low, high if -_TOLERANCE <= high - low < LONGEST_ROUND_TRIP else math.inf


def check_timing(scenario: Scenario) -> None:
    """Checks that a scenario's period, time limits and sight suit a bus.

    Raises:
        InvalidValueError: The control period is shorter than an inbox believes of any
            sender, or not below a time limit; or obstacles are in sight only where a
            simulation looks.
    """
    sight, period = scenario.faults.sight, scenario.period
    rule = (
        "0 on a bus, where a vehicle says what it sees (hardware.obstacles: perceived)"
    )
    require(sight <= 0.0, ("faults", "sight"), sight, rule)
    rule = f"at least {SHORTEST_PERIOD:g} s on a bus"
    require(period >= SHORTEST_PERIOD, "period", period, rule)
    scenario.check_hardware_times()
