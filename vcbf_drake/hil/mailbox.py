"""Inbox and Outbox: the messages of one channel, checked and numbered."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import VERSION, MessageFormat, Reason, Rejection


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


# How many sequence numbers back a late message is still told from a repeated one.
_WINDOW = 64
_LATE = (Reason.OLD, Reason.OVERTAKEN)


class Inbox:
    """Keeps the newest message that passed every check, and counts all the others.

    Beyond what `MessageFormat.decode` checks, a message must belong to the newest
    session, be newer than the last one, in its own time too, and not be too old.

    Args:
        bus: Where messages come from.
        message_format: What they have to look like.
        max_age: How old they may be when they arrive [s].
        on_accept: Called with an accepted message and the time of its arrival [us].

    Attributes:
        newest: The newest message, None before the first.
        received_at: When it arrived [us].
        accepted: How many were accepted.
        lost: How many sequence numbers never came.
        rejections: How many were rejected, by reason.
    """

    def __init__(
        self,
        bus: Bus,
        message_format: MessageFormat,
        max_age: float,
        on_accept: Callable[[Any, int], None] | None = None,
    ) -> None:
        self.newest: Any = None
        self.received_at = 0
        self.accepted = 0
        self.lost = 0
        self.rejections: Counter[Reason] = Counter()
        self._format = message_format
        self._max_age = round(1e6 * max_age)
        self._on_accept = on_accept
        self._session, self._sequence = 0, -1
        # Bit i stands for the sequence number i before the last one.
        self._seen = 0
        bus.subscribe(message_format.channel, self.receive)

    @property
    def late(self) -> int:
        """How many came too old, or after a newer one."""
        return sum(self.rejections[reason] for reason in _LATE)

    @property
    def rejected(self) -> int:
        """How many were rejected for other reasons than being late."""
        return sum(self.rejections.values()) - self.late

    def receive(self, data: bytes, now: int) -> None:
        """Takes whatever bytes came at the time `now` [us]."""
        message = self._format.decode(data, now)
        reason = (
            message.reason
            if isinstance(message, Rejection)
            else self._out_of_order(message, now)
        )
        if reason is not None:
            self.rejections[reason] += 1
            return
        self.newest, self.received_at = message, now
        self.accepted += 1
        if self._on_accept is not None:
            self._on_accept(message, now)

    def _out_of_order(self, message: Any, now: int) -> Reason | None:
        """Takes the message's number down; returns what is wrong with its order."""
        if message.session < self._session:
            return Reason.SESSION
        if message.session > self._session:
            self._session, self._seen = message.session, 0
            self._sequence = message.sequence - 1
        back = self._sequence - message.sequence
        if back >= 0:
            if back >= _WINDOW or self._seen >> back & 1:
                return Reason.REPEATED
            self._seen |= 1 << back
            self.lost = max(0, self.lost - 1)
            return Reason.OVERTAKEN
        self.lost += -back - 1
        earlier = self._seen << -back if -back < _WINDOW else 0
        self._seen = (earlier | 1) & ((1 << _WINDOW) - 1)
        self._sequence = message.sequence
        if now - getattr(message, "utime_measured", message.utime) > self._max_age:
            return Reason.OLD
        if self._time_went_back(message):
            return Reason.STAMPS
        return None

    def _time_went_back(self, message: Any) -> bool:
        last = self.newest
        if last is None or last.session != message.session:
            return False
        return bool(getattr(message, "time", 0.0) < getattr(last, "time", 0.0))
