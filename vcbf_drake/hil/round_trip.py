"""RoundTrip: how long messages take to the other side and back."""

from __future__ import annotations

from collections import deque

_REMEMBERED = 65_536
_LONGEST = 60_000_000  # [us]


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
