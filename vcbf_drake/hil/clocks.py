"""Clocks: this process's, a simulated one, and the estimate of a peer's."""

from __future__ import annotations

from collections import deque
import math
import time
from typing import TypeAlias

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


class WallClock:
    """The system's clock at the start, advanced by a clock that is never set back."""

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()

    def utime(self) -> int:
        """Returns the time [us]."""
        return (self._offset + time.monotonic_ns()) // 1000


class SimulatedClock:
    """A clock that the driver of a simulation sets.

    Attributes:
        now: Its time [us].
    """

    def __init__(self, now: int = 1_000_000_000_000_000) -> None:
        self.now = now

    def utime(self) -> int:
        """Returns the time [us]."""
        return self.now


Clock: TypeAlias = WallClock | SimulatedClock


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
        self._low, self._high, self._at = -math.inf, math.inf, 0
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
        behind, self._at = least - low, received
        if low > most:
            self._low = self._high = min(low, self._high + _FASTEST * elapsed)
        elif high < least:
            self._low = self._high = max(high, self._low - _FASTEST * elapsed)
        else:
            self._low, self._high = max(least, low), min(most, high)
        self._witnesses.clear()
        # Before the first round trip, lasting lateness is a clock that was set back.
        if behind <= _TOLERANCE or math.isfinite(self._high):
            self._behind_since = None
        elif self._behind_since is None:
            self._behind_since = received
        elif received - self._behind_since > _PATIENCE:
            self._begin_anew(low, received)
        return 0.0

    def _has_been_set(self, low: float, received: int) -> bool:
        """Whether this message is the third in a row with the same step."""
        witnesses = self._witnesses
        if witnesses and abs(low - witnesses[-1]) > _TOLERANCE:
            witnesses.clear()
        witnesses.append(low)
        is_too_soon = received - self._stepped_at < _BETWEEN_STEPS
        if len(witnesses) < _WITNESSES or is_too_soon:
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
