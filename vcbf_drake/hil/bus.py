"""Bus: LCM as one process of the loop sees it, its clock and injected faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import heapq
import itertools
import math
import os
import time
from typing import Protocol

import numpy as np
from pydrake.lcm import DrakeLcm

from vcbf_drake.errors import VcbfError


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


# Multicast, as LCM's own default; a time to live of 0 keeps it on this computer.
DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0"

# Takes a message's bytes and the time of its arrival [us].
Handler = Callable[[bytes, int], None]
# Takes the time [us], the channel and the bytes of a message.
Tap = Callable[[int, str, bytes], None]

_BETWEEN_PROCESSES = ("udpm://", "tcpq://")
_CHECK_CHANNEL = "VCBF_BUS_CHECK"
_CHECK_PATIENCE = 1.0  # [s]


class BusError(VcbfError):
    """The bus does not carry messages; the text says how to mend it."""


class Bus:
    """Publishes, subscribes and waits on an LCM bus, with a clock and faults.

    A DrakeLcm subscription keeps one message and drops what comes before that one is
    handled, so whoever owns a bus polls it or waits on it without long breaks.

    Args:
        lcm: The bus; shared by both halves for ``memq://``, which is private to it.
        clock: Stamps what is sent and what arrives.
        faults: Injected into what arrives; none by default.

    Attributes:
        lcm: The bus.
        clock: The clock.
        session: When what is sent now began [us]: when the bus was opened, or
            `begin_session` called.
        taps: Called with everything that is published, and with everything that
            arrives on a subscribed channel, after the faults.
    """

    def __init__(
        self,
        lcm: DrakeLcm | None = None,
        clock: Clock | None = None,
        faults: LinkFaults | None = None,
    ) -> None:
        self.lcm = lcm or DrakeLcm(DEFAULT_URL)
        self.clock = clock or WallClock()
        self.session = self.clock.utime()
        self.taps: list[Tap] = []
        self._link = FaultyLink(faults or LinkFaults())
        self._handlers: dict[str, list[Handler]] = {}

    @property
    def subscribed(self) -> tuple[str, ...]:
        """The channels that someone listens to here."""
        return tuple(self._handlers)

    def begin_session(self) -> None:
        """Makes what is sent from now on newer than anything that others send now."""
        self.session = self.clock.utime()

    def publish(self, channel: str, data: bytes) -> None:
        """Sends the bytes."""
        self._tell_taps(self.clock.utime(), channel, data)
        self.lcm.Publish(channel, data)

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Calls the handler with whatever bytes arrive on the channel."""
        if channel not in self._handlers:
            self._handlers[channel] = []
            self.lcm.Subscribe(
                channel,
                lambda data: self._link.put(self.clock.utime(), channel, data),
            )
        self._handlers[channel].append(handler)

    def poll(self) -> int:
        """Handles what has arrived and returns how many messages that were."""
        self.lcm.HandleSubscriptions(0)
        return self._deliver()

    def wait(self, until: float) -> int:
        """Waits for a message and handles it, at the longest until a time [us].

        Returns:
            How many messages arrived.
        """
        while True:
            remaining = min(until, self._link.next_due()) - self.clock.utime()
            # LCM waits for whole milliseconds; what is left of one is slept.
            if remaining >= 1000.0:
                self.lcm.HandleSubscriptions(math.floor(remaining / 1000.0))
            elif remaining > 0.0:
                time.sleep(1e-6 * remaining)
            arrived = self.poll()
            if arrived or self.clock.utime() >= until:
                return arrived

    def _deliver(self) -> int:
        arrived = 0
        for channel, data in self._link.due(self.clock.utime()):
            arrived += 1
            now = self.clock.utime()
            self._tell_taps(now, channel, data)
            for handler in self._handlers[channel]:
                handler(data, now)
        return arrived

    def _tell_taps(self, now: int, channel: str, data: bytes) -> None:
        for tap in self.taps:
            tap(now, channel, data)


def check_bus(url: str, patience: float = _CHECK_PATIENCE) -> None:
    """Checks that what one end publishes reaches another.

    Without a route for multicast LCM raises nothing; messages just never arrive.

    Args:
        url: LCM's URL of the bus.
        patience: How long to try [s].

    Raises:
        BusError: Nothing arrived, or the URL is not one of a bus between processes.
    """
    if not url.startswith(_BETWEEN_PROCESSES):
        allowed = " and ".join(_BETWEEN_PROCESSES)
        raise BusError(f"{url} is no bus between processes; {allowed} are")
    sender, receiver = DrakeLcm(url), DrakeLcm(url)
    token = f"{os.getpid()} {time.monotonic_ns()}".encode()
    arrived: list[bytes] = []
    receiver.Subscribe(_CHECK_CHANNEL, arrived.append)
    deadline = time.monotonic() + patience
    while token not in arrived:
        if time.monotonic() > deadline:
            raise BusError(
                f"{url} carries no messages: there is probably no route for multicast."
                " On Linux: sudo ip link set lo up;"
                " sudo ip route add 224.0.0.0/4 dev lo"
            )
        sender.Publish(_CHECK_CHANNEL, token)
        receiver.HandleSubscriptions(20)
