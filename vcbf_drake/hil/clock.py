"""The clocks that messages are stamped with."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Tells the time in microseconds since 1970."""

    def utime(self) -> int:
        """Returns the time [us]."""


class WallClock:
    """The system's clock as it was at the start, from then on never set back."""

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()

    def utime(self) -> int:
        """Returns the time [us]."""
        return (self._offset + time.monotonic_ns()) // 1000


class SimulatedClock:
    """A clock that whoever drives a simulation sets.

    Attributes:
        now: The time it tells [us].
    """

    def __init__(self, now: int = 1_000_000_000_000_000) -> None:
        self.now = now

    def utime(self) -> int:
        """Returns the time [us]."""
        return self.now
