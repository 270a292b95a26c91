"""Inbox and Outbox: the messages of one channel, checked, ordered and numbered."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import VERSION, MessageFormat, Reason, Rejection
from vcbf_drake.hil.timing import SHORTEST_PERIOD, Exchange, PeerClock

# How far clocks may be apart unless a scenario says otherwise [s].
MAX_CLOCK_OFFSET = 60.0
# How many sequence numbers back a late message is still told from a repeated one.
_WINDOW = 64
# How many messages may come faster than `SHORTEST_PERIOD` says.
_BURST = 100
# How far a motion's time may run ahead of the clock [us].
_TIME_AHEAD = 100_000
# How many senders are remembered, so that their past is not taken for news.
_MOST_SENDERS = 8
_LATE = (Reason.OLD, Reason.OVERTAKEN)

# What a message tells of a message of ours: when that was sent by our clock, and how
# long before this message it came [us]; None if it tells of none of ours.
Echo = Callable[[Any], tuple[int, int] | None]


class Outbox:
    """Sends messages on one channel, each with version, session, number and time.

    Args:
        bus: Where to.
        channel: Its name.

    Attributes:
        sent: How many messages were sent.
    """

    def __init__(self, bus: Bus, channel: str) -> None:
        self.sent = 0
        self._bus, self._channel = bus, channel
        self._session, self._next = bus.session, 0

    def send(self, message: Any) -> None:
        """Fills in what all messages have in common, and publishes."""
        if self._session != self._bus.session:
            self._session, self._next = self._bus.session, 0
        message.version = VERSION
        message.session, message.sequence = self._session, self._next
        message.utime = self._bus.clock.utime()
        self._bus.publish(self._channel, message.encode())
        self._next += 1
        self.sent += 1


class Inbox:
    """The newest message of the sender that is followed; all others are counted.

    Beyond what `MessageFormat.decode` checks, a message must be newer than the last one
    of its sender, in its own time too, and not be too old by the sender's `PeerClock`.

    One sender is followed at a time, by its session. Another one, whether it began
    earlier or later, is taken only when that one has been silent for `silence`, or has
    said farewell, or when the other one takes over openly (and began later). So neither
    a second sender nor a stray message locks the first one out.

    Args:
        bus: Where messages come from.
        message_format: What they have to look like.
        max_age: How old they may be when they arrive [s].
        on_accept: Called with an accepted message and the time of its arrival [us].
        silence: See above [s]; `max_age` by default.
        max_clock_offset: How far the sender's clock may be from ours [s].
        echo: What a message tells of ours; without, only one way is measured.
        refusal: Why a message that is well formed is not for us; None if it is.

    Attributes:
        newest: The newest message, None before the first.
        received_at: When it arrived [us].
        accepted: How many were accepted.
        lost: How many sequence numbers never came.
        rejections: How many were rejected, by reason.
        last_rejection: Why the last one was, in words; empty if none was.
        last_rejected_at: When [us]; 0 if none was.
    """

    def __init__(
        self,
        bus: Bus,
        message_format: MessageFormat,
        max_age: float,
        on_accept: Callable[[Any, int], None] | None = None,
        *,
        silence: float | None = None,
        max_clock_offset: float = MAX_CLOCK_OFFSET,
        echo: Echo = lambda message: None,
        refusal: Callable[[Any], Reason | None] = lambda message: None,
    ) -> None:
        self.newest: Any = None
        self.received_at = 0
        self._format, self._clock = message_format, bus.clock
        self._max_age = round(1e6 * max_age)
        self._silence = round(1e6 * (max_age if silence is None else silence))
        self._max_offset = round(1e6 * max_clock_offset)
        self._on_accept, self._echo, self._refusal = on_accept, echo, refusal
        self._senders: OrderedDict[int, _Sender] = OrderedDict()
        self._followed: _Sender | None = None
        self._start_counting()
        bus.subscribe(message_format.channel, self.receive, self._refuse_unsigned)

    def _start_counting(self) -> None:
        self.accepted = 0
        self.lost = 0
        self.rejections: Counter[Reason] = Counter()
        self.last_rejection, self.last_rejected_at = "", 0

    @property
    def channel(self) -> str:
        """The channel, without the name of a vehicle."""
        return self._format.channel

    @property
    def late(self) -> int:
        """How many came too old, or after a newer one."""
        return sum(self.rejections[reason] for reason in _LATE)

    @property
    def rejected(self) -> int:
        """How many were rejected for other reasons than being late."""
        return sum(self.rejections.values()) - self.late

    @property
    def peer_clock(self) -> PeerClock | None:
        """The clock of the sender that is followed, None before the first message."""
        return None if self._followed is None else self._followed.clock

    def utime(self, peer_utime: int) -> int:
        """Returns the time by our clock of a time by the followed sender's [us]."""
        clock = self.peer_clock
        return peer_utime if clock is None else peer_utime - clock.offset

    def has_same_sender(self, message: Any) -> bool:
        """Returns whether our newest message and this one are of one session."""
        both = self.newest is not None and message is not None
        return both and bool(message.session == self.newest.session)

    def begin_anew(self) -> None:
        """Forgets all that came."""
        self.newest, self.received_at = None, 0
        self._senders.clear()
        self._followed = None
        self._start_counting()

    def forget_the_start(self) -> None:
        """Forgets what was lost or late so far: nobody acted on it yet."""
        self.lost = 0
        for reason in _LATE:
            del self.rejections[reason]

    def complaint(self, now: int, within: float = 1.0) -> str:
        """Returns what was wrong with what came lately; empty for nothing.

        Args:
            now: The time [us].
            within: How far back to look [s].
        """
        if not self.rejected and not self.late:
            return ""
        if now - self.last_rejected_at > 1e6 * within:
            return ""
        count = self.rejected + self.late
        return f"{count} rejected, the last: {self.last_rejection}"

    def receive(self, data: bytes, now: int) -> None:
        """Takes whatever bytes came at the time `now` [us]."""
        message = self._format.decode(data)
        if isinstance(message, Rejection):
            self._reject(message, now)
            return
        refusal = self._refusal(message)
        if refusal is not None:
            self._reject(Rejection(refusal), now)
            return
        sender = self._senders.get(message.session) or _Sender(message, now)
        rejection = self._meet(sender, message, now)
        if rejection is None:
            rejection = sender.fault(message, now, self._echo(message), self._max_age)
            if self._followed is sender:
                self.lost = max(0, self.lost + sender.skipped)
        if rejection is not None:
            self._reject(rejection, now)
            return
        self._follow(sender)
        self.newest, self.received_at = message, now
        self.accepted += 1
        if self._on_accept is not None:
            self._on_accept(message, now)

    def _meet(self, sender: _Sender, message: Any, now: int) -> Rejection | None:
        """Returns why a sender is not listened to."""
        ahead = message.utime - now
        if abs(ahead) > self._max_offset:
            direction = "ahead" if ahead > 0 else "behind"
            return Rejection(
                Reason.FUTURE if ahead > 0 else Reason.PAST,
                f"its clock is {1e-6 * abs(ahead):.1f} s {direction}; max_clock_offset"
                f" is {1e-6 * self._max_offset:g} s",
            )
        followed = self._followed
        if followed is None or sender is followed or self._has_ended(followed):
            return None
        if now - followed.heard_at >= self._silence:
            return None
        takes_over = getattr(message, "takes_over", False)
        if takes_over and message.session > followed.session:
            return None
        return Rejection(Reason.SESSION)

    def _has_ended(self, followed: _Sender) -> bool:
        last = self.newest
        return (
            last is not None
            and last.session == followed.session
            and self._format.is_last(last)
        )

    def _follow(self, sender: _Sender) -> None:
        self._followed = sender
        self._senders[sender.session] = sender
        self._senders.move_to_end(sender.session)
        while len(self._senders) > _MOST_SENDERS:
            self._senders.popitem(last=False)

    def _refuse_unsigned(self, now: int) -> None:
        self._reject(Rejection(Reason.SIGNATURE), now)

    def _reject(self, rejection: Rejection, now: int) -> None:
        self.rejections[rejection.reason] += 1
        self.last_rejection, self.last_rejected_at = rejection.words, now


class _Sender:
    """What is known of one session: its order, its motion's time, its clock.

    Attributes:
        session: The session.
        heard_at: When its last message was accepted [us].
        clock: Its clock.
        skipped: How many numbers the last message skipped; -1 if it was one of those.
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
        """Takes the message's number and times down; returns what is wrong with it."""
        self.skipped = 0
        contradiction = None if self._is_known else _contradiction(message)
        if contradiction is not None:
            return contradiction
        order = self._order(message, now)
        if order is not None:
            return Rejection(order)
        exchange = Exchange(message.utime, now, *(echo or (None, None)))
        if not self.clock.listen(exchange):
            return Rejection(Reason.CLOCK)
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
        """Takes the motion's time down, unless it goes back or leaps."""
        time = getattr(message, "time", 0.0)
        if self._is_known and time < self._time:
            return Rejection(Reason.TIME, f"back by {self._time - time:.3g} s")
        is_silent = now - self.heard_at > 2 * max_age
        # What leaps is silent for us alone, and stays what it is.
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
    """Why a sender's first message cannot be true, by its own clock."""
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
