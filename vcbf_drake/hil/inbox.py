"""Inbox: the newest message of a channel that may be acted on.

Its sender is followed by its session: a `Sender` knows the order of its messages and
the time of its motion, a `PeerClock` its clock.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable
import math
from typing import Any

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.formats import (
    TIME_AHEAD,
    MessageFormat,
    Reason,
    Rejection,
    first_fault,
    measured_at,
    most_messages,
)

# The number of senders remembered, so that their old messages are not new again.
_MOST_SENDERS = 8
# The number of sequence numbers back that tell a late message from a repeated one.
_WINDOW = 64
# The bound of a round trip [us].
_LONGEST_ROUND_TRIP = 60_000_000
# The relative drift of two clocks, and the greatest rate of a correction.
_DRIFT, _FASTEST = 200e-6, 0.1
# The most by which a message may contradict the estimate of its sender's clock [us].
_TOLERANCE = 100_000
# Messages in a row that must agree on a step of a clock before it is accepted, and the
# time [us] until the next step may be: a clock that keeps stepping is refused.
_WITNESSES, _BETWEEN_STEPS = 3, 5_000_000
# The time for which messages stay late before the clock counts as set back [us].
_PATIENCE = 500_000

# The echo of one of our messages: its time of sending by our clock, and the time from
# its arrival to this message [us]; None without an echo.
Echo = Callable[[Any], tuple[int, int] | None]


class Inbox:
    """The newest message of the followed sender; all others are counted.

    Beyond what `MessageFormat.decode` checks, a message must be newer than the last one
    of its sender, in its own time too, and not be too old by the sender's `PeerClock`.

    One sender is followed at a time, by its session. Another one, whether it began
    earlier or later, is taken only when that one has been silent for `silence`, or has
    said farewell, or when the other one takes over openly (and began later). So neither
    a second sender nor a stray message locks the first one out.

    Args:
        bus: The bus of the messages.
        message_format: The format of the messages.
        max_age: The greatest age of a message at its arrival [s].
        on_accept: Called with an accepted message and the time of its arrival [us].
        silence: See above [s]; `max_age` by default.
        max_clock_offset: The greatest offset of the sender's clock from ours [s].
        echo: Returns a message's echo of ours; without it, only one way is measured.
        refusal: Returns the reason to refuse a well-formed message; None to accept it.

    Attributes:
        newest: The newest message, None before the first.
        received_at: Its time of arrival [us].
        followed_since: The time since which its sender is followed [us].
        accepted: The number of accepted messages.
        lost: The number of missing sequence numbers.
        rejections: The number of rejected messages, by reason.
        last_rejection: The last rejection's reason, in words; empty for none.
        last_rejected_at: The time of the last rejection [us]; 0 for none.
        round_trips: The round-trip times of our last 65 536 messages that the sender
            echoed [ms].
    """

    def __init__(
        self,
        bus: Bus,
        message_format: MessageFormat,
        max_age: float,
        on_accept: Callable[[Any, int], None] | None = None,
        *,
        silence: float | None = None,
        max_clock_offset: float = 60.0,
        echo: Echo = lambda message: None,
        refusal: Callable[[Any], Reason | None] = lambda message: None,
    ) -> None:
        self._format = message_format
        self._max_age = round(1e6 * max_age)
        self._silence = round(1e6 * (max_age if silence is None else silence))
        self._max_offset = round(1e6 * max_clock_offset)
        self._on_accept, self._echo, self._refusal = on_accept, echo, refusal
        self.round_trips: deque[float] = deque(maxlen=65_536)
        self._echoed_at = 0
        self.begin_anew()
        bus.subscribe(message_format.channel, self.receive)

    def begin_anew(self) -> None:
        """Forgets all messages."""
        self.newest: Any = None
        self.received_at = self.followed_since = 0
        self._senders: OrderedDict[int, Sender] = OrderedDict()
        self._followed: Sender | None = None
        self.accepted = self.lost = 0
        self.rejections: Counter[Reason] = Counter()
        self.last_rejection, self.last_rejected_at = "", 0

    @property
    def late(self) -> int:
        """The number of messages that were too old, or older than the newest."""
        return self.rejections[Reason.OLD] + self.rejections[Reason.OVERTAKEN]

    @property
    def rejected(self) -> int:
        """The number of messages rejected for other reasons than being late."""
        return self.rejections.total() - self.late

    @property
    def peer_clock(self) -> PeerClock | None:
        """The clock of the followed sender, None before the first message."""
        return None if self._followed is None else self._followed.clock

    def utime(self, peer_utime: int) -> int:
        """Returns the time by our clock of a time by the followed sender's [us]."""
        clock = self.peer_clock
        return peer_utime if clock is None else peer_utime - clock.offset

    def has_same_sender(self, message: Any) -> bool:
        """Returns whether our newest message and this one are of one session."""
        both = self.newest is not None and message is not None
        return both and bool(message.session == self.newest.session)

    def complaint(self, now: int) -> str:
        """Returns the faults of the messages of the last second before `now` [us]."""
        count = self.rejections.total()
        if not count or now - self.last_rejected_at > 1_000_000:
            return ""
        return f"{count} rejected, the last: {self.last_rejection}"

    def report(self) -> dict[str, Any]:
        """Returns the report of the messages' arrival, and of their sender's clock."""
        clock = self.peer_clock
        return {
            "clock_offset_ms": None if clock is None else 1e-3 * clock.offset,
            "clock_steps": 0 if clock is None else clock.steps,
            "accepted": self.accepted,
            "lost": self.lost,
            "late": self.late,
            "rejected": {why.value: count for why, count in self.rejections.items()},
        }

    def receive(self, data: bytes | None, now: int) -> None:
        """Receives bytes that arrive at the time `now` [us]; None for unsigned ones."""
        unsigned = Rejection(Reason.SIGNATURE)
        message = unsigned if data is None else self._format.decode(data)
        fault = message if isinstance(message, Rejection) else self._judge(message, now)
        if fault is not None:
            self.rejections[fault.reason] += 1
            self.last_rejection, self.last_rejected_at = fault.words, now
            return
        self.newest, self.received_at = message, now
        self.accepted += 1
        self._add_round_trip(message, now)
        if self._on_accept is not None:
            self._on_accept(message, now)

    def _judge(self, message: Any, now: int) -> Rejection | None:
        """Follows the message's sender, or returns the rejection."""
        reason = self._refusal(message)
        if reason is not None:
            return Rejection(reason)
        sender = self._senders.get(message.session) or Sender(message, now)
        fault = self._reason_to_ignore(sender, message, now)
        if fault is None:
            fault = sender.fault(message, now, self._echo(message), self._max_age)
            if self._followed is sender:
                self.lost = max(0, self.lost + sender.skipped)
        if fault is not None:
            return fault
        if self._followed is not sender:
            self._followed, self.followed_since = sender, now
        self._senders[sender.session] = sender
        self._senders.move_to_end(sender.session)
        while len(self._senders) > _MOST_SENDERS:
            self._senders.popitem(last=False)
        return None

    def _reason_to_ignore(
        self, sender: Sender, message: Any, now: int
    ) -> Rejection | None:
        ahead = message.utime - now
        if abs(ahead) > self._max_offset:
            off = f"{1e-6 * abs(ahead):.1f} s {'ahead' if ahead > 0 else 'behind'}"
            most = f"max_clock_offset is {1e-6 * self._max_offset:g} s"
            reason = Reason.FUTURE if ahead > 0 else Reason.PAST
            return Rejection(reason, f"its clock is {off}; {most}")
        followed = self._followed
        if followed is None or sender is followed:
            return None
        has_ended = self._format.is_last(self.newest)
        is_silent = now - followed.heard_at >= self._silence
        takes_over = getattr(message, "takes_over", False)
        overrules = takes_over and message.session > followed.session
        if has_ended or is_silent or overrules:
            return None
        return Rejection(Reason.SESSION)

    def _add_round_trip(self, message: Any, now: int) -> None:
        """Adds one when a message of ours is first told of, if it makes sense."""
        sent, age = self._echo(message) or (0, 0)
        if sent > self._echoed_at:
            self._echoed_at, away = sent, now - sent - age
            if 0 <= away < _LONGEST_ROUND_TRIP:
                self.round_trips.append(1e-3 * away)


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
        self.session, self.heard_at = first.session, now
        self.clock, self.skipped = PeerClock(), 0
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
        fault = None if self._is_known else first_fault(message)
        fault = fault or self._order(message, now)
        if fault is not None:
            return fault
        off = self.clock.listen(message.utime, now, echo)
        if off:
            return Rejection(Reason.CLOCK, f"by {1e-6 * off:.2f} s")
        age = now + self.clock.offset - measured_at(message)
        if age > max_age:
            return Rejection(Reason.OLD, f"{1e-6 * age:.2f} s")
        fault = self._leap_of_time(message, now, max_age)
        if fault is None:
            self._is_known, self.heard_at = True, now
        return fault

    def _order(self, message: Any, now: int) -> Rejection | None:
        back = self._sequence - message.sequence
        if back >= 0:
            if back >= _WINDOW or self._seen >> back & 1:
                return Rejection(Reason.REPEATED)
            self._seen |= 1 << back
            self.skipped = -1
            return Rejection(Reason.OVERTAKEN)
        # By our own clock: a forged number would otherwise keep the true ones out, as
        # having gone back, for ever.
        is_much = -back > most_messages(now - self._numbered_at)
        if self._is_known and is_much:
            return Rejection(Reason.STAMPS)
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
        most = 1.001 * elapsed + 1e-6 * (max_age + TIME_AHEAD)
        self._leaps = time - start > most
        if self._leaps:
            words = f"on by {time - start:.3g} s in {elapsed:.3g} s; its unit is s"
            return Rejection(Reason.TIME, words)
        self._time = time
        return None


class PeerClock:
    """Estimate of a peer's clock offset from ours, from the messages exchanged.

    A message takes time, so its clock is ahead by at least ``sent - received`` of one
    from the peer, and at most by that of one of ours. The offset is the middle of the
    tightest such interval, which widens with the drift of two clocks; before a round
    trip is known, its lower end: the fastest message is taken to need no time. A clock
    of another pace is followed, by 10 % at most: so fast NTP's programs turn one.

    A message that contradicts the interval by more than 0.1 s is not believed: a forged
    one must not move the clock. Three in a row that agree tell of a clock that was set,
    and all begins anew; at most once in 5 s, so that one that stands is not followed.

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
        """Updates the estimate; returns by how much a message contradicts it [us].

        Args:
            sent: The time of sending by the peer's clock.
            received: The time of arrival by ours.
            echo: The echo of one of our messages, see `Echo`.
        """
        low, high, elapsed = sent - received, math.inf, received - self._at
        if echo is not None:
            ours_sent, ours_age = echo
            bound = sent - ours_age - ours_sent
            # No round trip is that long or negative: the sender has not filled in its
            # times, or has set its clock since our message arrived.
            if -_TOLERANCE <= bound - low < _LONGEST_ROUND_TRIP:
                high = bound
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
