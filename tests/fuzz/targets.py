"""What comes from outside, for a fuzzer: only errors of one line may come out."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from itertools import pairwise
from pathlib import Path
import struct
import tempfile
from typing import Any, NamedTuple, get_args, get_type_hints

from tests.helpers.genuine_messages import FORMATS, NOW, genuine
from vcbf_drake import ScenarioError
from vcbf_drake.hil import Inbox, MessageFormat, SimulatedClock
from vcbf_drake.hil.event_log import (
    EventLogError,
    EventLogWriter,
    logged_scenario,
    read_event_log,
)
from vcbf_drake.simulation import loading
from vcbf_drake.simulation.scenario import Scenario


class Target(NamedTuple):
    """A function that must not raise, whatever it is given.

    Attributes:
        take: The function.
        seeds: Returns inputs to start from.
        words: Returns what inputs are likely to hold.
    """

    take: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]
    words: Callable[[], list[str]]


# LCM event logs: every event of the file, or one line that says what is wrong ---------


def take_event_log(data: bytes) -> None:
    """Reads a file of these bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log")
        path.write_bytes(data)
        try:
            events, damage = read_event_log(path)
            assert len(damage.splitlines()) <= 1
            assert sum(len(event.data) for event in events) <= len(data)
            logged_scenario(path, events)
        except (EventLogError, ScenarioError) as error:
            assert str(error).isprintable(), "one line"


def _event_logs() -> list[bytes]:
    logs = []
    for number in range(3):
        with tempfile.TemporaryDirectory() as folder:
            with EventLogWriter(Path(folder, "log")) as log:
                log.tap(1_000, "VCBF_SCENARIO", b"a: {duration: 1}")
                for each in range(number):
                    log.tap(2_000 + each, "VCBF_STATE", bytes(10 * each))
            logs.append(Path(folder, "log").read_bytes())
    return logs


# LCM messages: accepted as they should be, or counted by reason ----------------------

_LENGTH = struct.Struct(">H")


class _Silent:
    """In the place of a bus: what arrives is the fuzzer's."""

    clock = SimulatedClock(NOW)

    def subscribe(self, channel: str, handler: object) -> None:
        pass


def take_messages(data: bytes) -> None:
    """Takes a channel's number, then messages, each with its length before it."""
    if not data:
        return
    form = FORMATS[data[0] % len(FORMATS)]
    accepted: list[Any] = []
    inbox = Inbox(_Silent(), form, 0.1, lambda message, now: accepted.append(message))
    sent, rest = 0, data[1:]
    while len(rest) >= _LENGTH.size:
        (length,) = _LENGTH.unpack_from(rest)
        rest = rest[_LENGTH.size :]
        inbox.receive(rest[:length], NOW + 1000 * sent)
        rest, sent = rest[length:], sent + 1
    assert inbox.accepted == len(accepted)
    assert sent == len(accepted) + sum(inbox.rejections.values())
    assert inbox.lost >= 0
    for earlier, later in pairwise(accepted):
        if later.session == earlier.session:
            assert later.sequence > earlier.sequence
    for message in accepted:
        for name, size in form.sizes.items():
            assert getattr(message, name) == size
        for name in form.numbers:
            grows = name in ("time", "input_integral")  # As long as a vehicle runs.
            value = getattr(message, name)
            for number in (value,) if isinstance(value, float) else value:
                assert abs(number) < (1e12 if grows else 1e6)


def _messages() -> list[bytes]:
    def framed(form: MessageFormat) -> bytes:
        sent = [genuine(form, NOW, sequence).encode() for sequence in range(3)]
        return b"".join(_LENGTH.pack(len(each)) + each for each in sent)

    return [bytes([number]) + framed(form) for number, form in enumerate(FORMATS)]


# Scenario files and overrides: a scenario, or one line that says what is wrong -------

_SMALL = """\
s:
  vehicle: !Car {}
  input_set: {lower: [-1, -1], upper: [1, 1]}
  initial_state: [0, 0, 0, 0]
  target: [3, 0]
"""
_OVERRIDES = (
    "{duration: 3.0, period: .inf}",
    "{disturbance: [!Sinusoid {amplitude: [1.0]}, !Constant {value: [0.1]}]}",
    "{disturbance: [!BandLimitedNoise {std: [1.0], tones: 3, seed: 1}]}",
    "{disturbance: [!SmoothStep {amplitude: [1.0], start: 1.0, duration: 2.0}]}",
    "{disturbance: [!Recorded {times: [0, 1, 99], values: [[1], [2], [3]]}]}",
    "{input_set: {lower: [-1, -1], upper: [1, 1], A: [[1, 1]], b: [0.5]}}",
    "{faults: {gusts: [{amplitude: [1.0], start: 2.0}], sight: 1.0}}",
    "{obstacles: &o [{center: [1, 2], radius: 3}], target: [1e-3, -.inf]}",
    "{volume: {gain: slow, widening: 8}}",
    "{a: &a [*a], <<: {b: 1}, ? [c] : d}",
)


def take_scenario(data: bytes) -> None:
    """Reads a file behind the letter f, overrides of a small one behind another."""
    text, name = data[1:].decode(errors="replace"), "fuzz.yaml"
    try:
        if data[:1] == b"f":
            scenario = loading.parse_scenario(text, name)
        else:
            scenario = loading.parse_scenario(_SMALL, name, text)
    except ScenarioError as error:
        assert str(error).isprintable(), "one line"
        return
    again = loading.parse_scenario(loading.dump_scenario(scenario), name)
    assert repr(again) == repr(scenario), "what was dumped loads to the same"


def _scenarios() -> list[bytes]:
    shipped = map(loading.load_scenario, loading.shipped_scenarios())
    files = [_SMALL, *map(loading.dump_scenario, shipped)]
    return [f"f{text}".encode() for text in files] + [
        f"o{text}".encode() for text in _OVERRIDES
    ]


def _keys_and_tags() -> list[str]:
    found = {"*a", "&a", "<<:", "!!float", "!!python/object", ".nan"}
    waiting: list[Any] = [Scenario]
    while waiting:
        schema = waiting.pop()
        for name, hint in get_type_hints(schema).items():
            found.add(name)
            for inner in (hint, *get_args(hint)):
                for each in (inner, *get_args(inner)):
                    tag = f"!{getattr(each, '__name__', '')}"
                    if dataclasses.is_dataclass(each) and tag not in found:
                        found.add(tag)
                        waiting.append(each)
    return sorted(found)


TARGETS = {
    "event-logs": Target(
        take_event_log, _event_logs, lambda: [r"\xed\xa1\xda\x01", "VCBF_SCENARIO"]
    ),
    "messages": Target(  # nan, -1
        take_messages,
        _messages,
        lambda: [r"\x7f\xf8\x00\x00\x00\x00\x00\x00", r"\xff\xff\xff\xff"],
    ),
    "scenarios": Target(take_scenario, _scenarios, _keys_and_tags),
}
