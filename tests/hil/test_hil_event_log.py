"""Event logs: LCM's own reader and writer agree, and damage does not spread."""

from __future__ import annotations

from contextlib import suppress
import os
from pathlib import Path
import struct
import time

from hypothesis import given, settings, strategies as st
from pydrake.lcm import DrakeLcm
import pytest

from vcbf_drake.hil import Bus, SimulatedClock
from vcbf_drake.hil.event_log import (
    Event,
    EventLogError,
    EventLogWriter,
    read_event_log,
)

EVENTS = [
    Event(1_700_000_000_000_000, "VCBF_STATE", b"abc"),
    Event(1_700_000_000_020_000, "A", b""),
    Event(1_700_000_000_020_000, "X" * 63, bytes(range(256)) * 5),
    # The synchronisation word may be in the data.
    Event(-5, "VCBF_STATE", bytes.fromhex("eda1da01eda1da01")),
]


def written(path, events=EVENTS):
    with EventLogWriter(path, force=True) as log:
        for event in events:
            log.tap(*event)
    return path


def test_what_is_written_is_read(tmp_path) -> None:
    assert read_event_log(written(tmp_path / "a.log")) == (EVENTS, "")


def test_the_bytes_are_those_of_the_format(tmp_path) -> None:
    """The header field by field: sync, number, time, lengths; then name and data."""
    data = written(tmp_path / "a.log").read_bytes()
    assert data[:31] == (
        b"\xed\xa1\xda\x01"
        + (0).to_bytes(8, "big")
        + (1_700_000_000_000_000).to_bytes(8, "big")
        + (10).to_bytes(4, "big")
        + b"\0\0\0\x03VCB"
    )
    assert data[41:53] == b"\xed\xa1\xda\x01" + (1).to_bytes(8, "big")


def test_lcm_reads_what_is_written(tmp_path) -> None:
    lcm = pytest.importorskip("lcm")
    path = written(tmp_path / "a.log")
    found = list(lcm.EventLog(str(path), "r"))
    assert [event.eventnum for event in found] == [0, 1, 2, 3]
    assert [Event(e.timestamp, e.channel, e.data) for e in found] == EVENTS


def test_what_lcm_writes_is_read(tmp_path) -> None:
    lcm = pytest.importorskip("lcm")
    log = lcm.EventLog(str(tmp_path / "a.log"), "w", overwrite=True)
    for event in EVENTS:
        log.write_event(*event)
    log.close()
    assert read_event_log(tmp_path / "a.log") == (EVENTS, "")


def test_an_event_is_in_the_file_soon_and_before_the_log_is_closed(tmp_path) -> None:
    log = EventLogWriter(tmp_path / "a.log")
    for count, event in enumerate(EVENTS, start=1):
        log.tap(*event)
        deadline = time.monotonic() + 30.0
        while (found := _events(tmp_path / "a.log")) != EVENTS[:count]:
            assert time.monotonic() < deadline, found
            time.sleep(1e-3)
    log.close()


def _events(path: Path) -> list[Event]:
    return read_event_log(path)[0] if path.stat().st_size else []


def test_a_log_that_is_there_is_not_replaced(tmp_path) -> None:
    """What a service manager's restart would destroy is the log of the crash."""
    path = tmp_path / "flight.log"
    contents = [EVENTS[:1], EVENTS[1:2], EVENTS[2:]]
    for content in contents:
        with EventLogWriter(path) as log:
            for event in content:
                log.tap(*event)
    names = ["flight.log", "flight.log.01", "flight.log.02"]
    assert sorted(each.name for each in tmp_path.iterdir()) == names
    assert [read_event_log(tmp_path / name)[0] for name in names] == contents
    with EventLogWriter(path, force=True) as log:
        log.tap(*EVENTS[3])
        assert log.path == path
    assert read_event_log(path)[0] == [EVENTS[3]]


def test_a_disk_that_stalls_costs_log_and_not_flight(tmp_path) -> None:
    """A pipe whose reader pauses: nothing waits, and what is missing is counted."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    log = EventLogWriter(path, capacity=50, patience=0.05)
    for number in range(1000):
        log.tap(number, "A", bytes(4096))  # More than pipe and queue hold.
    log.close()
    assert 800 < log.lost < 1000
    assert (
        log.failure == f"{path}: the disk was too slow, {log.lost} events are missing"
    )
    while log.is_open:  # The disk works again.
        with suppress(BlockingIOError):
            os.read(reader, 65_536)
    os.close(reader)


def test_a_disk_that_is_full_ends_the_log_in_one_line() -> None:
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full here")
    with EventLogWriter("/dev/full") as log:
        for event in EVENTS:
            log.tap(*event)
    assert log.failure == (
        "/dev/full: No space left on device; the log ends after 0 events"
    )


def test_a_log_cut_off_anywhere_keeps_its_whole_events(tmp_path) -> None:
    whole = written(tmp_path / "a.log").read_bytes()
    ends = [len(written(tmp_path / "b.log", EVENTS[:n]).read_bytes()) for n in range(5)]
    for cut in range(ends[1], len(whole), 7):
        (tmp_path / "b.log").write_bytes(whole[:cut])
        kept = sum(cut >= end for end in ends[1:])
        events, damage = read_event_log(tmp_path / "b.log")
        assert events == EVENTS[:kept]
        lost = cut - ends[kept]
        assert damage == (
            f"{tmp_path / 'b.log'}: {lost} of its {cut} bytes are no whole events and"
            f" are left out, the first at byte {ends[kept]}"
            if lost
            else ""
        )


@pytest.mark.parametrize("place", [0, 1, 2, 3])
@pytest.mark.parametrize(
    "garbage",
    [
        b"garbage",
        b"\xed\xa1\xda\x01",
        # A header that promises 2 GB, and one with negative lengths.
        struct.pack(">4sqqii", b"\xed\xa1\xda\x01", 0, 0, 4, 2**31 - 1) + b"NAME",
        struct.pack(">4sqqii", b"\xed\xa1\xda\x01", 0, 0, -4, -9),
        struct.pack(">4sqqii", b"\xed\xa1\xda\x01", 0, 0, 2, 0) + b"\xff\xfe",
    ],
)
def test_garbage_between_events_is_passed_over(tmp_path, place, garbage) -> None:
    parts = [written(tmp_path / "a.log", [event]).read_bytes() for event in EVENTS]
    parts.insert(place, garbage)
    (tmp_path / "a.log").write_bytes(b"".join(parts))
    events, damage = read_event_log(tmp_path / "a.log")
    assert events == EVENTS
    assert f": {len(garbage)} of its" in damage
    assert damage.endswith(f"at byte {sum(map(len, parts[:place]))}")


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.binary(max_size=200))
def test_random_bytes_are_refused_in_one_line(tmp_path_factory, data) -> None:
    path = tmp_path_factory.getbasetemp() / "a.log"
    path.write_bytes(data)
    with pytest.raises(
        EventLogError, match=r"a\.log: not an LCM log: \w+ \w+"
    ) as found:
        read_event_log(path)
    assert "\n" not in str(found.value)


def test_files_that_cannot_be_opened_are_named(tmp_path) -> None:
    with pytest.raises(EventLogError, match=r"none\.log: No such file"):
        read_event_log(tmp_path / "none.log")
    with pytest.raises(EventLogError, match="Is a directory"):
        EventLogWriter(tmp_path)
    with pytest.raises(EventLogError, match="Is a directory"):
        read_event_log(tmp_path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_ends_the_log_and_nothing_else() -> None:
    with EventLogWriter("/dev/full") as log:
        log.tap(*EVENTS[0])
        log.tap(*EVENTS[1])
    assert log.failure == (
        "/dev/full: No space left on device; the log ends after 0 events"
    )


def test_a_writer_is_a_tap(tmp_path) -> None:
    clock = SimulatedClock()
    lcm = DrakeLcm("memq://")
    bus, other = Bus(lcm, clock), Bus(lcm, clock)
    bus.subscribe("HEARD", lambda data, now: None)
    with EventLogWriter(tmp_path / "a.log") as log:
        bus.taps.append(log.tap)
        bus.publish("SAID", b"1")
        clock.now += 7
        other.publish("HEARD", b"2")
        other.publish("UNHEARD", b"3")
        bus.poll()
    start = clock.now - 7
    assert read_event_log(tmp_path / "a.log")[0] == [
        Event(start, "SAID", b"1"),
        Event(start + 7, "HEARD", b"2"),
    ]
