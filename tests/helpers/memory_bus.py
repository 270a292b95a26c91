"""Buses in memory that stand in for DrakeLcm, and a clock that runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

from vcbf_drake.hil import SimulatedClock


class MemoryLcm:
    """Without file descriptors, as properties make thousands; keeps every message."""

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


class OneSlotLcm:
    """One process's end of a bus: as DrakeLcm's, it keeps the first of a burst.

    Args:
        ends: All ends of the bus; this one joins them.
    """

    def __init__(self, ends: list[OneSlotLcm]) -> None:
        self._ends = ends
        ends.append(self)
        self._handlers: defaultdict[str, list[Callable[[bytes], None]]]
        self._handlers = defaultdict(list)
        self._slots: dict[str, bytes] = {}

    def Publish(self, channel: str, data: bytes) -> None:
        for end in self._ends:
            if channel in end._handlers:
                end._slots.setdefault(channel, data)

    def Subscribe(self, channel: str, handler: Callable[[bytes], None]) -> None:
        self._handlers[channel].append(handler)

    def HandleSubscriptions(self, milliseconds: int) -> int:
        kept, self._slots = self._slots, {}
        for channel, data in kept.items():
            for handler in self._handlers[channel]:
                handler(data)
        return len(kept)


class RunningClock(SimulatedClock):
    """Goes on by 1 ms whenever somebody looks at it."""

    def utime(self) -> int:
        self.now += 1000
        return self.now
