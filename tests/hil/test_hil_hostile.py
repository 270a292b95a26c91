"""Hostile messages: none crashes anything, none is acted on, all are counted.

What is not tried is a message that is right in every respect: LCM has no senders'
names, so that whoever may write on the bus may also command.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import struct
import tracemalloc
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
import pytest

from tests.helpers.genuine_messages import FORMATS, SECOND, genuine
from vcbf_drake import load_scenario
from vcbf_drake.hil import (
    Bus,
    Inbox,
    InProcess,
    MessageFormat,
    Reason,
    SimulatedClock,
    command_format,
    obstacles_format,
    state_format,
)

_BYTES = {"int8_t": 1, "boolean": 1, "int32_t": 4, "int64_t": 8, "double": 8}


def places_of_sizes(message: Any) -> list[int]:
    """Where in the bytes of a message its array sizes are."""
    places, place = [], 8  # After the fingerprint.
    used = {size for sizes in message.__dimensions__ if sizes for size in sizes}
    for name, kind, sizes in zip(
        message.__slots__, message.__typenames__, message.__dimensions__, strict=True
    ):
        value = getattr(message, name)
        if name in used:
            places.append(place)
        for item in value if sizes else [value]:
            place += _BYTES[kind] if kind != "string" else 5 + len(item.encode())
    return places


class Attacker:
    """Makes bad messages for one channel; it has heard the good ones.

    Args:
        form: What good ones look like.
        rng: Its dice.
    """

    def __init__(self, form: MessageFormat, rng: np.random.Generator) -> None:
        self._form, self._rng = form, rng
        self.heard: list[bytes] = []

    def kinds(self) -> dict[str, Callable[[int], bytes]]:
        """All it can do, by name; each takes the time."""
        return {
            "random bytes": lambda now: self._bytes(),
            "random fields": lambda now: (
                self._template(now).encode()[:8] + self._bytes()
            ),
            "truncated": self._truncated,
            "extended": lambda now: self._template(now).encode() + self._bytes(1),
            "huge size": self._huge,
            "no number": self._no_number,
            "replayed": lambda now: self.heard[self._rng.integers(len(self.heard))],
            "from the future": self._future,
            "another version": self._version,
            "another type": self._type,
        }

    def _bytes(self, least: int = 0) -> bytes:
        return self._rng.bytes(int(self._rng.integers(least, 400)))

    def _template(self, now: int) -> Any:
        """The next good message, before something is done to it."""
        message = self._form.type.decode(self.heard[-1])
        message.sequence, message.utime = message.sequence + 1, now
        return message

    def _truncated(self, now: int) -> bytes:
        data: bytes = self._template(now).encode()
        return data[: self._rng.integers(len(data))]

    def _huge(self, now: int) -> bytes:
        message = self._template(now)
        data = bytearray(message.encode())
        place = self._rng.choice(places_of_sizes(message))
        size = self._rng.choice([-(2**31), -1, 10**6, 2**31 - 1])
        data[place : place + 4] = struct.pack(">i", size)
        return bytes(data)

    def _no_number(self, now: int) -> bytes:
        message = self._template(now)
        name = self._rng.choice(self._form.numbers)
        bad = self._rng.choice([np.nan, np.inf, -np.inf, 1e300])
        value = getattr(message, name)
        if isinstance(value, float):
            setattr(message, name, bad)
        else:
            changed = list(value)
            changed[self._rng.integers(len(changed))] = bad
            setattr(message, name, changed)
        data: bytes = message.encode()
        return data

    def _future(self, now: int) -> bytes:
        message = self._template(now)
        ahead = int(self._rng.integers(SECOND, 10**9 * SECOND))
        message.utime += ahead
        if self._rng.random() < 0.5:  # Of a sender that began in the future.
            message.session += ahead
        data: bytes = message.encode()
        return data

    def _version(self, now: int) -> bytes:
        message = self._template(now)
        message.version = int(self._rng.choice([-1, 0, 1, 2**31 - 1]))
        data: bytes = message.encode()
        return data

    def _type(self, now: int) -> bytes:
        others = [form for form in FORMATS if form.type is not self._form.type]
        other = others[self._rng.integers(len(others))]
        data: bytes = genuine(other, now, 10**6).encode()
        return data


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
def test_ten_thousand_hostile_messages_are_counted_and_nothing_else(form) -> None:
    clock = SimulatedClock()
    bus, accepted = Bus(DrakeLcm("memq://"), clock), []
    inbox = Inbox(bus, form, 0.1, lambda message, now: accepted.append(message))
    attacker = Attacker(form, np.random.default_rng(7))
    for sequence in range(80):
        data = genuine(form, clock.now, sequence).encode()
        attacker.heard.append(data)
        inbox.receive(data, clock.now)
        clock.now += 1000
    kinds = attacker.kinds()
    reasons: dict[str, Counter[Reason]] = {name: Counter() for name in kinds}
    newest, at, names = inbox.newest, inbox.received_at, list(kinds)
    memory = []
    for number in range(10_000):
        if number in (7_000, 9_999):
            if not tracemalloc.is_tracing():
                tracemalloc.start()
            memory.append(tracemalloc.get_traced_memory()[0])
        name = names[number % len(names)]
        before = inbox.rejections.copy()
        inbox.receive(kinds[name](clock.now), clock.now)
        (reason,) = inbox.rejections - before
        reasons[name][reason] += 1
        clock.now += 10
    tracemalloc.stop()
    assert len(accepted) == inbox.accepted == 80
    assert inbox.newest is newest
    assert inbox.received_at == at
    assert inbox.lost == 0
    assert sum(inbox.rejections.values()) == 10_000
    expected = {
        "random bytes": {Reason.LENGTH, Reason.TYPE},
        "random fields": {
            Reason.LENGTH,
            Reason.TYPE,
            Reason.VERSION,
            Reason.SIZE,
        },
        "truncated": {Reason.LENGTH, Reason.TYPE},
        "extended": {Reason.LENGTH},
        "huge size": {Reason.LENGTH, Reason.SIZE},
        "no number": {Reason.NUMBER},
        "replayed": {Reason.REPEATED},
        "from the future": {Reason.FUTURE},
        "another version": {Reason.VERSION},
        "another type": {Reason.TYPE, Reason.LENGTH},
    }
    for name, found in reasons.items():
        assert found.total() == 1000
        assert found.keys() <= expected[name], name
    # Python's struct keeps up to 100 formats; 3000 kept messages were a megabyte.
    assert memory[1] - memory[0] < 100_000
    # It still listens.
    inbox.receive(genuine(form, clock.now, 80).encode(), clock.now)
    assert inbox.accepted == 81


class Storm:
    """All attackers of one run.

    Args:
        run: The run.
        seed: Of their dice.
    """

    def __init__(self, run: InProcess, seed: int) -> None:
        self.sent = 0
        self._run, rng = run, np.random.default_rng(seed)
        forms = [state_format(4, 2), command_format(2), obstacles_format()]
        self._attackers = {form.channel: Attacker(form, rng) for form in forms}
        run.plant.bus.taps.append(self._listen("VCBF_STATE", "VCBF_OBSTACLES"))
        run.controller.bus.taps.append(self._listen("VCBF_COMMAND"))

    def _listen(self, *channels: str) -> Callable[[int, str, bytes], None]:
        def hear(utime: int, channel: str, data: bytes) -> None:
            if channel in channels:
                self._attackers[channel].heard.append(data)

        return hear

    def strike(self) -> None:
        """Sends one message of every kind on every channel that was heard."""
        for channel, attacker in self._attackers.items():
            for make in attacker.kinds().values() if attacker.heard else ():
                self._run.lcm.Publish(channel, make(self._run.clock.now))
                self.sent += 1


def flight(
    hostile: bool, key: bytes = b""
) -> tuple[bytes, list[bytes], list[Counter[Reason]], int]:
    """The path, what was said, what each side rejected, and how much was sent."""
    run = InProcess(load_scenario("car-avoidance"), key=key)
    said: list[bytes] = []
    for bus, channels in (
        (run.controller.bus, ("VCBF_COMMAND",)),
        (run.plant.bus, ("VCBF_STATE",)),
    ):
        bus.taps.append(
            lambda utime, channel, data, mine=channels: (
                said.append(data) if channel in mine else None
            )
        )
    storm = Storm(run, seed=3)
    for tick in range(1, 61):
        run.advance_to(tick * 0.02)
        if hostile:
            storm.strike()
    run.controller.bus.poll()
    run.plant.bus.poll()
    log = run.plant.diagram.GetSubsystemByName("log_path").FindLog(run.plant.context)
    assert np.ptp(log.data()) > 0.5
    receivers = (
        run.controller.diagram.GetSubsystemByName("state_receiver"),
        run.plant.diagram.GetSubsystemByName("vehicle_end"),
    )
    rejections = [receiver.inbox.rejections for receiver in receivers]
    return log.data().tobytes(), said, rejections, storm.sent


@pytest.mark.parametrize("key", [b"", b"0123456789abcdef"])
def test_a_loop_under_attack_moves_as_without_bit_for_bit(key: bytes) -> None:
    """3 channels, 10 kinds, 60 ticks: the same path, the same messages, all counted."""
    calm_path, calm_said, calm_rejections, _ = flight(hostile=False)
    path, said, rejections, sent = flight(hostile=True, key=key)
    assert path == calm_path
    assert said == calm_said
    assert [found.total() for found in calm_rejections] == [0, 0]
    assert sent > 1500
    for found in rejections:
        assert found.total() == 600
        if key:
            assert found == {Reason.SIGNATURE: 600}
            continue
        assert found[Reason.REPEATED] + found[Reason.OVERTAKEN] >= 60
        for reason in (Reason.FUTURE, Reason.NUMBER, Reason.VERSION):
            assert found[reason] >= 60
