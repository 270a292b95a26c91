"""LinkFaults: what a bad radio link does to the messages that arrive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import heapq
import itertools
import math

import numpy as np


@dataclass(frozen=True)
class LinkFaults:
    """Faults to inject into what arrives at one process, for tests and demonstrations.

    Attributes:
        drop: The share of messages that never arrive, in [0, 1].
        delay: Added to the others' way [s].
        jitter: The delay varies by up to this much either way [s]; messages may then
            overtake each other.
        seed: Of the generator.

    Raises:
        ValueError: A number is outside what is allowed.
    """

    drop: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.drop <= 1.0:
            raise ValueError(f"drop is {self.drop:g}; it must be between 0 and 1")
        if not (math.isfinite(self.delay) and self.delay >= 0.0):
            raise ValueError(f"delay is {self.delay:g} s; it must not be below 0")
        if not 0.0 <= self.jitter <= self.delay:
            raise ValueError(
                f"jitter is {self.jitter:g} s; it must be between 0 and the delay,"
                f" {self.delay:g} s"
            )


class FaultyLink:
    """Drops and delays messages as its faults say.

    Args:
        faults: What to inject.
    """

    def __init__(self, faults: LinkFaults) -> None:
        self._faults = faults
        self._generator = np.random.default_rng(faults.seed)
        self._on_the_way: list[tuple[int, int, str, bytes]] = []
        self._number = itertools.count()

    def put(self, now: int, channel: str, data: bytes) -> None:
        """Takes a message that came at the time `now` [us]."""
        faults = self._faults
        if faults.drop and self._generator.random() < faults.drop:
            return
        due = now
        if faults.delay:
            jitter = self._generator.uniform(-faults.jitter, faults.jitter)
            due += round(1e6 * (faults.delay + jitter))
        heapq.heappush(self._on_the_way, (due, next(self._number), channel, data))

    def due(self, now: int) -> Iterator[tuple[str, bytes]]:
        """Yields channel and bytes of what has arrived at the time `now` [us]."""
        while self._on_the_way and self._on_the_way[0][0] <= now:
            _, _, channel, data = heapq.heappop(self._on_the_way)
            yield channel, data

    def next_due(self) -> float:
        """Returns when the next message arrives [us]; infinite for none."""
        return self._on_the_way[0][0] if self._on_the_way else math.inf
