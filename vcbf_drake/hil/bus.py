"""Bus: LCM as one process of the loop sees it, its clock and injected faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import heapq
import hmac
import ipaddress
import itertools
import math
import os
from pathlib import Path
import re
import socket
import time
from typing import Protocol
from urllib.parse import SplitResult, parse_qsl, urlsplit

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
            raise ValueError(
                f"delay is {self.delay:g} s; it must be finite and not below 0"
            )
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

    def clear(self) -> None:
        """Forgets what is on the way."""
        self._on_the_way.clear()

    def next_due(self) -> float:
        """Returns when the next message arrives [us]; infinite for none."""
        return self._on_the_way[0][0] if self._on_the_way else math.inf


# Multicast, as LCM's own default; a time to live of 0 keeps it on this computer.
DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0"

# Takes a message's bytes and the time of its arrival [us].
Handler = Callable[[bytes, int], None]
# Told that a message came at a time [us] without the signature that it must have.
Refusal = Callable[[int], None]
# Takes the time [us], the channel and the bytes of a message.
Tap = Callable[[int, str, bytes], None]

_BETWEEN_PROCESSES = ("udpm://", "tcpq://")
SIGNATURE_BYTES = 32  # HMAC-SHA256's, after the message.
_LEAST_KEY, _MOST_KEY = 16, 65_536  # Bytes.
_LONGEST_NAME = 48  # LCM's channels have at most 63 characters.
_MOST_DRAINED = 100
# The greatest value of each.
_UDPM_OPTIONS = {"ttl": 255, "recv_buf_size": 2**31 - 1}
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
        name: The vehicle's: its channels end with a slash and this, so that several
            vehicles share a bus. Empty for none.
        key: With a key, everything that is sent ends with a signature, and what
            arrives without the right one is refused.

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
        *,
        name: str = "",
        key: bytes = b"",
    ) -> None:
        check_name(name)
        self.name, self._key = name, key
        self.lcm = lcm or DrakeLcm(DEFAULT_URL)
        self.clock = clock or WallClock()
        self.session = self.clock.utime()
        self.taps: list[Tap] = []
        self._link = FaultyLink(faults or LinkFaults())
        self._handlers: dict[str, list[tuple[Handler, Refusal]]] = {}

    @property
    def subscribed(self) -> tuple[str, ...]:
        """The channels that someone listens to here."""
        return tuple(self._handlers)

    def channel(self, base: str) -> str:
        """Returns what a channel is called on this bus: with the vehicle's name."""
        return f"{base}/{self.name}" if self.name else base

    def begin_session(self) -> None:
        """Makes what is sent from now on newer than anything that others send now."""
        self.session = self.clock.utime()

    def publish(self, channel: str, data: bytes) -> None:
        """Sends the bytes on a channel, given without the vehicle's name."""
        full = self.channel(channel)
        self._tell_taps(self.clock.utime(), full, data)
        self.lcm.Publish(full, data + self._signature(full, data))

    def subscribe(
        self, channel: str, handler: Handler, refuse: Refusal = lambda now: None
    ) -> None:
        """Calls the handler with whatever bytes arrive on the channel.

        Args:
            channel: Without the vehicle's name.
            handler: Gets the bytes, without their signature.
            refuse: Told of bytes that have not the right signature.
        """
        full = self.channel(channel)
        if full not in self._handlers:
            self._handlers[full] = []
            self.lcm.Subscribe(
                full, lambda data: self._link.put(self.clock.utime(), full, data)
            )
        self._handlers[full].append((handler, refuse))

    def _signature(self, channel: str, data: bytes) -> bytes:
        if not self._key:
            return b""
        return hmac.digest(self._key, channel.encode() + b"\0" + data, "sha256")

    def drain(self) -> None:
        """Throws away what has arrived so far, told to nobody."""
        for _ in range(_MOST_DRAINED):
            if not self.lcm.HandleSubscriptions(0):
                break
        self._link.clear()

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
            if self._key:
                data, signature = data[:-SIGNATURE_BYTES], data[-SIGNATURE_BYTES:]
                if not hmac.compare_digest(signature, self._signature(channel, data)):
                    for _, refuse in self._handlers[channel]:
                        refuse(now)
                    continue
            self._tell_taps(now, channel, data)
            for handler, _ in self._handlers[channel]:
                handler(data, now)
        return arrived

    def _tell_taps(self, now: int, channel: str, data: bytes) -> None:
        for tap in self.taps:
            tap(now, channel, data)


class Neighbours:
    """Listens for the other vehicles' names on a bus while nobody speaks under ours.

    Args:
        bus: The bus; it hears nothing of a ``memq://`` in one process.
        base: A channel without a name: what whoever is waited for would send on.

    Attributes:
        names: What was heard.
    """

    def __init__(self, bus: Bus, base: str) -> None:
        self.names: set[str] = set()
        self._ours, self._lcm = bus.channel(base), DrakeLcm(bus.lcm.get_lcm_url())
        self._lcm.SubscribeMultichannel(f"{base}(/.*)?", self._hear)

    def listen(self) -> str:
        """Returns what was heard so far, in words; empty for nobody."""
        self._lcm.HandleSubscriptions(0)
        return ", ".join(name or "one without a name" for name in sorted(self.names))

    def _hear(self, channel: str, data: bytes) -> None:
        if channel != self._ours:
            self.names.add(channel.partition("/")[2])


def check_name(name: str) -> None:
    """Checks that a vehicle's name may end a channel's.

    Raises:
        BusError: It may not.
    """
    if not re.fullmatch(rf"[A-Za-z0-9_-]{{0,{_LONGEST_NAME}}}", name):
        raise BusError(
            f"name {name!r}: a vehicle's name has at most {_LONGEST_NAME} letters,"
            " digits, _ and -"
        )


def vehicle_name(scenario_name: str) -> str:
    """Returns what a scenario's vehicle is called on a bus."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", scenario_name)[:_LONGEST_NAME]


def read_key(path: str | Path) -> bytes:
    """Returns the key in a file, which is all of its bytes.

    Raises:
        BusError: The file cannot be read, or is too short or too long to be a key.
    """
    try:
        with open(path, "rb") as file:
            key = file.read(_MOST_KEY + 1)  # Some files never end.
    except OSError as error:
        raise BusError(f"key_file {path}: {error.strerror}") from None
    if not _LEAST_KEY <= len(key) <= _MOST_KEY:
        has = f"{len(key)} bytes" if len(key) <= _MOST_KEY else "too many bytes"
        raise BusError(
            f"key_file {path}: has {has}; a key has at least {_LEAST_KEY} and at most"
            f" {_MOST_KEY}: head -c 32 /dev/urandom > A_NEW_FILE"
        )
    return key


def check_bus(url: str, patience: float = _CHECK_PATIENCE) -> None:
    """Checks that what one end publishes reaches another.

    Without a route for multicast LCM raises nothing; messages just never arrive.

    Args:
        url: LCM's URL of the bus.
        patience: How long to try [s].

    Raises:
        BusError: Nothing arrived, or the URL is not one of a bus between processes, or
            not one at all.
    """
    if not url.startswith(_BETWEEN_PROCESSES):
        allowed = " and ".join(_BETWEEN_PROCESSES)
        raise BusError(f"{url} is no bus between processes; {allowed} are")
    address, port = _parsed(url)
    if address.scheme == "tcpq":
        _check_server(url, address.hostname or "localhost", port or 7700)
    sender, receiver = DrakeLcm(url), DrakeLcm(url)
    token = f"{os.getpid()} {time.monotonic_ns()}".encode()
    arrived: list[bytes] = []
    receiver.Subscribe(_CHECK_CHANNEL, arrived.append)
    deadline = time.monotonic() + patience
    while token not in arrived:
        if time.monotonic() > deadline:
            raise BusError(f"{url} carries no messages: {_probable_cause(address)}")
        sender.Publish(_CHECK_CHANNEL, token)
        receiver.HandleSubscriptions(20)


def _parsed(url: str) -> tuple[SplitResult, int | None]:
    """Returns the parts of a bus's URL, and its port, where it has one.

    LCM takes what it does not understand for 0, or for what it likes.

    Raises:
        BusError: It is no URL, or a port or an option makes no sense.
    """
    try:
        address = urlsplit(url)
        port = address.port
    except ValueError as error:
        raise BusError(f"{url}: {error}") from None
    example = f"as in {DEFAULT_URL}"
    is_multicast = address.scheme == "udpm"
    if port == 0 or (is_multicast and address.hostname and port is None):
        raise BusError(f"{url}: needs a port, 1 to 65535, {example}")
    options = parse_qsl(address.query, keep_blank_values=True) if is_multicast else ()
    for option, value in options:
        most = _UDPM_OPTIONS.get(option)
        if most is None:
            known = " and ".join(_UDPM_OPTIONS)
            raise BusError(f"{url}: no option {option}; there are {known}, {example}")
        if not (value.isascii() and value.isdigit() and int(value) <= most):
            raise BusError(f"{url}: {option} must be 0 to {most}, {example}")
    return address, port


def _check_server(url: str, host: str, port: int) -> None:
    try:
        socket.create_connection((host, port), timeout=_CHECK_PATIENCE).close()
    except OSError as error:
        raise BusError(
            f"{url}: no LCM server answers at {host}:{port}"
            f" ({error.strerror or error}); start one there, for example"
            " lcm-tcpq-server or java -cp lcm.jar lcm.lcm.TCPService"
        ) from None


def _probable_cause(address: SplitResult) -> str:
    if address.scheme == "tcpq":
        return "what answers there is probably no LCM server"
    if not _is_multicast(address.hostname or ""):
        return (
            f"{address.hostname} is no multicast address; udpm needs one,"
            " 224.0.0.0 to 239.255.255.255"
        )
    return (
        "there is probably no route for multicast. On Linux: sudo ip link set lo up;"
        " sudo ip route add 224.0.0.0/4 dev lo"
    )


def _is_multicast(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_multicast
    except ValueError:
        return False
