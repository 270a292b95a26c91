"""Bus: LCM as one process of the loop sees it, its clock and injected faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
import heapq
import hmac
from ipaddress import IPv4Address
import itertools
import math
import os
from pathlib import Path
import re
import socket
import time
from typing import Any, TypeAlias

import numpy as np
from pydrake.lcm import DrakeLcm

from vcbf_drake.checks import check_parameter
from vcbf_drake.errors import InvalidValueError, VcbfError
from vcbf_drake.simulation.scenario import Scenario

# Multicast, as LCM's own default; a time to live of 0 keeps it on this computer.
DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0"
VERSION = 2  # Of the messages.
SIGNATURE_BYTES = 32  # HMAC-SHA256's, after the message.

# A function of a message's bytes and its time of arrival [us]; None replaces bytes
# without the required signature.
Handler = Callable[[bytes | None, int], None]
# A function of the time [us], the channel and the bytes of a message.
Tap = Callable[[int, str, bytes], None]

_LEAST_KEY, _MOST_KEY = 16, 65_536  # Bytes.
_LONGEST_NAME = 48  # LCM's channels have at most 63 characters.
_CHECK_CHANNEL = "VCBF_BUS_CHECK"
# LCM reads an invalid option as 0, or ignores it, and of a port its first digits.
_MULTICAST = re.compile(r"udpm://(([\d.]+):([1-9]\d{0,4}))?", re.ASCII)
_OPTION = re.compile(r"ttl=(1?\d?\d|2[0-4]\d|25[0-5])|recv_buf_size=\d{1,9}", re.ASCII)
_NO_SERVER = (
    "no LCM server answers there; start one, for example lcm-tcpq-server or"
    " java -cp lcm.jar lcm.lcm.TCPService"
)
_NO_WAY = (
    f"a bus between processes is tcpq://HOST:PORT or, as {DEFAULT_URL}, a multicast"
    " address with its port, to which there must be a route. On Linux: sudo ip link"
    " set lo up; sudo ip route add 224.0.0.0/4 dev lo"
)


class BusError(VcbfError):
    """The bus does not carry messages; the text names a remedy."""


@dataclass(frozen=True)
class LinkFaults:
    """Faults injected into the messages that arrive at a process, for tests.

    Attributes:
        drop: Probability that a message is lost, in [0, 1].
        delay: Delay of the other messages [s].
        jitter: Greatest deviation from that delay [s]; messages may then overtake each
            other.
        seed: The seed of the generator.
    """

    drop: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_parameter("delay", self.delay, zero_allowed=True)
        for name, most in (("drop", 1.0), ("jitter", self.delay)):
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                must = f"it must be between 0 and {most:g}"
                raise InvalidValueError(name, f"{value:g}; {must}")


class WallClock:
    """The system's clock at the start, advanced by a clock that is never set back."""

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()

    def utime(self) -> int:
        """Returns the time [us]."""
        return (self._offset + time.monotonic_ns()) // 1000


class SimulatedClock:
    """A clock that the driver of a simulation sets.

    Attributes:
        now: Its time [us].
    """

    def __init__(self, now: int = 1_000_000_000_000_000) -> None:
        self.now = now

    def utime(self) -> int:
        """Returns the time [us]."""
        return self.now


Clock: TypeAlias = WallClock | SimulatedClock


class Bus:
    """Publishes, subscribes and waits on an LCM bus, with a clock and faults.

    A DrakeLcm subscription keeps one message and drops what comes before that one is
    handled, so the owner of a bus has to poll it or wait on it without long breaks.

    Args:
        lcm: The bus; shared by both halves for ``memq://``, which is private to it.
        clock: The clock that stamps sent and received messages.
        faults: Faults injected into arriving messages; none by default.
        name: The vehicle's: its channels end with a slash and this, so that several
            vehicles share a bus. Empty for none.
        key: With a key, every sent message ends with a signature, and messages without
            the right one are refused.

    Attributes:
        lcm: The bus.
        clock: The clock.
        session: The start of the current session [us]: the bus was opened, or
            `begin_session` called.
        sent: The number of messages that `send` sent in it, by channel.
        taps: Functions called with every published message, and with every message that
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
        self.clock: Clock = clock or WallClock()
        self.taps: list[Tap] = []
        self._handlers: dict[str, list[Handler]] = {}
        self._faults = faults or LinkFaults()
        self._generator = np.random.default_rng(self._faults.seed)
        # Messages on their way: arrival time [us], number, channel, bytes.
        self._arriving: list[tuple[int, int, str, bytes]] = []
        self._numbers = itertools.count()
        self.begin_session()

    @property
    def subscribed(self) -> tuple[str, ...]:
        """The subscribed channels."""
        return tuple(self._handlers)

    def channel(self, base: str) -> str:
        """Returns a channel's name on this bus, with the vehicle's name."""
        return f"{base}/{self.name}" if self.name else base

    def begin_session(self) -> None:
        """Begins a session that is newer than those of all other senders."""
        self.session = self.clock.utime()
        self.sent: Counter[str] = Counter()

    @contextmanager
    def one_instant(self) -> Iterator[None]:
        """Stops the clock, so that decisions and stamps have the same time."""
        clock, self.clock = self.clock, SimulatedClock(self.clock.utime())
        try:
            yield
        finally:
            self.clock = clock

    def send(self, channel: str, message: Any) -> None:
        """Fills in a message's version, session, number and time, and publishes it."""
        message.version, message.session = VERSION, self.session
        message.sequence, message.utime = self.sent[channel], self.clock.utime()
        self.publish(channel, message.encode())
        self.sent[channel] += 1

    def publish(self, channel: str, data: bytes) -> None:
        """Sends the bytes on a channel, given without the vehicle's name."""
        full, now = self.channel(channel), self.clock.utime()
        for tap in self.taps:
            tap(now, full, data)
        self.lcm.Publish(full, data + self._signature(full, data))

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Calls the handler with all bytes that arrive on a channel.

        The channel is given without the vehicle's name, the bytes without signature.
        """
        full = self.channel(channel)
        if full not in self._handlers:
            self._handlers[full] = []
            self.lcm.Subscribe(full, lambda data: self._take(full, data))
        self._handlers[full].append(handler)

    def poll(self) -> int:
        """Handles the messages that have arrived and returns their number."""
        self.lcm.HandleSubscriptions(0)
        return self._deliver()

    def wait(self, until: float) -> int:
        """Waits for messages until a time [us] and returns how many were handled."""
        while True:
            next_due = self._arriving[0][0] if self._arriving else math.inf
            remaining = min(until, next_due) - self.clock.utime()
            # LCM waits for whole milliseconds; what is left of one is slept.
            if remaining >= 1000.0:
                self.lcm.HandleSubscriptions(math.floor(remaining / 1000.0))
            elif remaining > 0.0:
                time.sleep(1e-6 * remaining)
            arrived = self.poll()
            if arrived or self.clock.utime() >= until:
                return arrived

    def _take(self, channel: str, data: bytes) -> None:
        """Receives a message from LCM, subject to the faults."""
        faults, due = self._faults, self.clock.utime()
        if faults.drop and self._generator.random() < faults.drop:
            return
        if faults.delay:
            jitter = self._generator.uniform(-faults.jitter, faults.jitter)
            due += round(1e6 * (faults.delay + jitter))
        heapq.heappush(self._arriving, (due, next(self._numbers), channel, data))

    def _deliver(self) -> int:
        arrived, until = 0, self.clock.utime()
        while self._arriving and self._arriving[0][0] <= until:
            arrived += 1
            *_, channel, signed = heapq.heappop(self._arriving)
            now, data = self.clock.utime(), self._verified(channel, signed)
            if data is not None:
                for tap in self.taps:
                    tap(now, channel, data)
            for handler in self._handlers[channel]:
                handler(data, now)
        return arrived

    def _verified(self, channel: str, signed: bytes) -> bytes | None:
        """The bytes without their signature; None if that is not the right one."""
        if not self._key:
            return signed
        data, signature = signed[:-SIGNATURE_BYTES], signed[-SIGNATURE_BYTES:]
        is_right = hmac.compare_digest(signature, self._signature(channel, data))
        return data if is_right else None

    def _signature(self, channel: str, data: bytes) -> bytes:
        if not self._key:
            return b""
        return hmac.digest(self._key, channel.encode() + b"\0" + data, "sha256")


def check_name(name: str) -> None:
    """Checks that a vehicle's name is valid as the end of a channel's name."""
    if not re.fullmatch(rf"[A-Za-z0-9_-]{{0,{_LONGEST_NAME}}}", name):
        must = f"it must be at most {_LONGEST_NAME} letters, digits, _ and -"
        raise InvalidValueError("name", f"{name!r}; {must}")


def vehicle_name(scenario_name: str) -> str:
    """Returns the name of a scenario's vehicle on a bus."""
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


def open_bus(
    scenario: Scenario,
    url: str = DEFAULT_URL,
    name: str | None = None,
    faults: LinkFaults | None = None,
) -> Bus:
    """Returns the bus of a scenario's vehicle or controller, once it carries messages.

    Args:
        scenario: It has the key's path and the vehicle's default name.
        url: LCM's URL of the bus.
        name: The vehicle's.
        faults: Faults injected into arriving messages; none by default.

    Raises:
        InvalidValueError: The name is not valid.
        BusError: There is no key, or the bus carries no messages.
    """
    name = vehicle_name(scenario.name) if name is None else name
    check_name(name)
    key_file = scenario.hardware.key_file
    key = read_key(key_file) if key_file else b""
    check_bus(url)
    return Bus(DrakeLcm(url), faults=faults, name=name, key=key)


def check_bus(url: str, patience: float = 1.0) -> None:
    """Checks that a published message reaches a subscriber.

    Without a route for multicast, or a server, LCM raises nothing; messages just never
    arrive.

    Args:
        url: LCM's URL of the bus.
        patience: The time limit [s].

    Raises:
        BusError: Nothing arrived, or LCM would take a part of the URL for another.
    """
    base, _, options = url.partition("?")
    for option in filter(None, options.split("&")):
        if not _OPTION.fullmatch(option):
            known = "ttl=0 to ttl=255 and recv_buf_size=BYTES"
            raise BusError(f"{url}: no option {option}; there are {known}")
    remedy, can_carry = _NO_WAY, _is_multicast(base)
    if base.startswith("tcpq://"):
        remedy, can_carry = _NO_SERVER, _has_server(base, patience)
    if not (can_carry and _carries(url, patience)):
        raise BusError(f"{url} carries no messages: {remedy}")


def _carries(url: str, patience: float) -> bool:
    arrived: list[bytes] = []
    token = f"{os.getpid()} {time.monotonic_ns()}".encode()
    deadline = time.monotonic() + patience
    with suppress(RuntimeError):  # LCM's own test has failed.
        sender, receiver = DrakeLcm(url), DrakeLcm(url)
        receiver.Subscribe(_CHECK_CHANNEL, arrived.append)
        while token not in arrived and time.monotonic() < deadline:
            sender.Publish(_CHECK_CHANNEL, token)
            receiver.HandleSubscriptions(20)
    return token in arrived


def _is_multicast(base: str) -> bool:
    """Whether LCM knows an address; about others it prints lines of its own."""
    found = _MULTICAST.fullmatch(base)
    if found is None or found[1] is None:
        return found is not None
    with suppress(ValueError):
        return IPv4Address(found[2]).is_multicast and int(found[3]) < 65_536
    return False


def _has_server(base: str, patience: float) -> bool:
    """Asks for a server before LCM does, which prints lines of its own."""
    host, _, port = base.removeprefix("tcpq://").partition(":")
    try:
        address = host or "localhost", int(port or 7700)
        socket.create_connection(address, patience).close()
    except (OSError, ValueError, OverflowError):
        return False
    return True
