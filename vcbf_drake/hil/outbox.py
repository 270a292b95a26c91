"""Outbox: numbers and stamps what is sent on one channel."""

from __future__ import annotations

from typing import Any

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import VERSION


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
