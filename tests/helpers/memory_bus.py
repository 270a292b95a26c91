"""A bus in memory without DrakeLcm's file descriptors: properties make thousands."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable


class MemoryLcm:
    """Stands in for a DrakeLcm; keeps every message until it is handled."""

    def __init__(self) -> None:
        self._handlers: defaultdict[str, list[Callable[[bytes], None]]]
        self._handlers = defaultdict(list)
        self._sent: list[tuple[str, bytes]] = []

    def Publish(self, channel: str, data: bytes) -> None:
        self._sent.append((channel, data))

    def Subscribe(self, channel: str, handler: Callable[[bytes], None]) -> None:
        self._handlers[channel].append(handler)

    def HandleSubscriptions(self, milliseconds: int) -> int:
        sent, self._sent = self._sent, []
        for channel, data in sent:
            for handler in self._handlers[channel]:
                handler(data)
        return len(sent)
