"""LCM's event logs: files of everything that was on a bus, and when.

The format is that of ``lcm-logger``; every number in it is big-endian:

| bytes | |
| --- | --- |
| 4 | the synchronisation word 0xEDA1DA01 |
| 8 | the event's number: 0, 1, 2, ... |
| 8 | when, in microseconds since 1970 |
| 4, 4 | lengths of the channel's name and of the data |
| | the name, then the data |
"""

from __future__ import annotations

from collections.abc import Iterator
import mmap
import os
from pathlib import Path
import struct
from types import TracebackType
from typing import NamedTuple

from vcbf_drake.errors import VcbfError

_SYNC = bytes.fromhex("eda1da01")
_HEADER = struct.Struct(">4sqqii")
_LONGEST_CHANNEL = 63  # LCM's own limit.


class EventLogError(VcbfError):
    """A file is not an event log, or not one of what it is taken for."""


class Event(NamedTuple):
    """A message, and when it was on the bus.

    Attributes:
        utime: When [us].
        channel: On which channel.
        data: Its bytes.
    """

    utime: int
    channel: str
    data: bytes


class EventLogWriter:
    """Writes an event log; called with an event's parts, as a `Bus` calls its taps.

    Every event is handed to the system at once: a process that is killed loses none.
    A disk that fails ends the log, not the flight.

    Args:
        path: The file, which is replaced.

    Attributes:
        failure: Why the log ended early, in one line; empty when it did not.

    Raises:
        EventLogError: The file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.failure = ""
        self._path, self._count = path, 0
        try:
            self._file = open(path, "wb", buffering=0)
        except OSError as error:
            raise EventLogError(f"{path}: {error.strerror}") from None

    def __call__(self, utime: int, channel: str, data: bytes) -> None:
        """Appends an event, unless the log has failed."""
        if self.failure:
            return
        name = channel.encode()
        header = _HEADER.pack(_SYNC, self._count, utime, len(name), len(data))
        try:
            self._file.write(header + name + data)
        except OSError as error:
            self.failure = (
                f"{self._path}: {error.strerror}; the log ends after"
                f" {self._count} events"
            )
        self._count += 1

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> EventLogWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class EventLog(NamedTuple):
    """What an event log holds.

    Attributes:
        events: The events, in the order of the file.
        damage: What was not events, in one line; empty when all of it was.
    """

    events: list[Event]
    damage: str


def read_event_log(path: str | Path) -> EventLog:
    """Reads an event log, and passes over what in it is not events.

    A log whose writer was killed ends amid an event, and disks fail: after bytes that
    are not an event, reading goes on at the next one.

    Args:
        path: The file.

    Raises:
        EventLogError: The file cannot be read, or holds no event.
    """
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if not size:
                raise EventLogError(f"{path}: not an LCM log: it is empty")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                found = list(_events(data))
    except OSError as error:
        raise EventLogError(f"{path}: {error.strerror}") from None
    if not found:
        raise EventLogError(f"{path}: not an LCM log: no event in its {size} bytes")
    return EventLog([event for _, event in found], _damage(path, found, size))


def _events(data: mmap.mmap) -> Iterator[tuple[int, Event]]:
    """Yields the events, each after the place where it begins."""
    place = data.find(_SYNC)
    while place >= 0:
        event = _event_at(data, place)
        if event is None:
            place = data.find(_SYNC, place + 1)
        else:
            yield place, event
            place = data.find(_SYNC, place + _length(event))


def _event_at(data: mmap.mmap, place: int) -> Event | None:
    """Returns the event that begins at a synchronisation word, None if none does."""
    if place + _HEADER.size > len(data):
        return None
    _, _, utime, channel_length, data_length = _HEADER.unpack_from(data, place)
    start = place + _HEADER.size
    middle, end = start + channel_length, start + channel_length + data_length
    if not 0 < channel_length <= _LONGEST_CHANNEL or data_length < 0 or end > len(data):
        return None
    name = data[start:middle]
    if not name.isascii():
        return None
    return Event(utime, name.decode("ascii"), data[middle:end])


def _length(event: Event) -> int:
    return _HEADER.size + len(event.channel) + len(event.data)


def _damage(path: str | Path, found: list[tuple[int, Event]], size: int) -> str:
    lost = size - sum(_length(event) for _, event in found)
    if not lost:
        return ""
    expected = 0  # Where the first damage is.
    for place, event in found:
        if place != expected:
            break
        expected += _length(event)
    return (
        f"{path}: {lost} of its {size} bytes are no whole events and are left out,"
        f" the first at byte {expected}"
    )
