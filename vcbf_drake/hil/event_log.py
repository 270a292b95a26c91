"""LCM's event logs: files of all messages on a bus, with times and scenario.

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

from collections.abc import Sequence
from io import FileIO
import itertools
from pathlib import Path
import struct
from typing import NamedTuple

from vcbf_drake.errors import ScenarioError, VcbfError
from vcbf_drake.files import WriterThread
from vcbf_drake.hil.bus import Bus
from vcbf_drake.simulation.loading import dump_scenario, parse_scenario
from vcbf_drake.simulation.scenario import Scenario

_SYNC = bytes.fromhex("eda1da01")
_HEADER = struct.Struct(">4sqqii")
# Events that may wait for the disk: half a minute of a loop at 200 Hz.
_CAPACITY = 20_000
_PATIENCE = 2.0  # [s]
_LONGEST_CHANNEL = 63  # LCM's own limit.


class EventLogError(VcbfError):
    """A file is not an event log, or not of the expected kind."""


class Event(NamedTuple):
    """The time of a message on the bus [us], its channel, and its bytes."""

    utime: int
    channel: str
    data: bytes


class EventLogWriter(WriterThread[Event]):
    """Writes an event log; its `tap` is one of a `Bus`.

    A thread of its own writes, from a queue that holds `capacity` events, and hands
    each to the system at once: a process that is killed loses no more than the queue. A
    stalled disk loses events, which are counted; a failed disk ends the log. Neither
    stops the run.

    Args:
        path: The file. An existing file is never replaced: the log is then FILE.01,
            FILE.02, ..., much as with ``lcm-logger --increment``.
        force: Whether to replace an existing file.
        capacity: The number of events that may wait for the disk.
        patience: The time for which `close` waits for it [s].

    Attributes:
        path: The file that is written.

    Raises:
        EventLogError: The file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        force: bool = False,
        capacity: int = _CAPACITY,
        patience: float = _PATIENCE,
    ) -> None:
        self._error, self._count = "", 0
        self.path, self._file = _opened(Path(path), force)
        super().__init__(self._append, capacity, patience, self._file.close)

    @property
    def failure(self) -> str:
        """The missing events and the reason, in one line; empty for none."""
        if self._error:
            after = f"the log ends after {self._count} events"
            return f"{self.path}: {self._error}; {after}"
        if self.lost:
            return f"{self.path}: the disk was too slow, {self.lost} events are missing"
        return ""

    def tap(self, utime: int, channel: str, data: bytes) -> None:
        """Appends an event, unless the log has failed or its queue is full."""
        if not self._error:
            self(Event(utime, channel, data))

    def _append(self, event: Event) -> None:
        if self._error:
            return
        name = event.channel.encode()
        sizes = len(name), len(event.data)
        header = _HEADER.pack(_SYNC, self._count, event.utime, *sizes)
        try:
            self._file.write(header + name + event.data)
            self._count += 1
        except OSError as error:
            self._error = str(error.strerror)

    def __enter__(self) -> EventLogWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _opened(path: Path, force: bool) -> tuple[Path, FileIO]:
    """Opens a file that is not there yet: this one, or the next number."""
    for number in itertools.count():
        numbered = path.with_name(f"{path.name}.{number:02}") if number else path
        is_device = numbered.exists() and not numbered.is_file()
        try:
            # Nothing is lost of a pipe or a device.
            return numbered, FileIO(numbered, "w" if force or is_device else "x")
        except FileExistsError:
            continue
        except OSError as error:
            raise EventLogError(f"{numbered}: {error.strerror}") from None
    raise AssertionError  # The numbers do not end.


def read_event_log(path: str | Path) -> tuple[list[Event], str]:
    """Reads an event log, and skips damaged parts.

    Returns the events, in the order of the file, and in one line which parts of it are
    damaged; empty for none.

    A log whose writer was killed ends amid an event, and disks fail: after bytes that
    are not an event, reading goes on at the next one. (LCM's own reader ends there, or
    the process with it, where a header promises gigabytes.)

    Args:
        path: The file.

    Raises:
        EventLogError: The file cannot be read, or holds no event.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise EventLogError(f"{path}: {error.strerror}") from None
    events: list[Event] = []
    damaged: list[range] = []  # Where there are no events.
    end, place = 0, data.find(_SYNC)
    while place >= 0:
        event = _event_at(data, place)
        if event is None:
            place = data.find(_SYNC, place + 1)
            continue
        if place > end:
            damaged.append(range(end, place))
        events.append(event)
        end = place + _HEADER.size + len(event.channel) + len(event.data)
        place = data.find(_SYNC, end)
    if not events:
        words = f"no event in its {len(data)} bytes" if data else "it is empty"
        raise EventLogError(f"{path}: not an LCM log: {words}")
    if end < len(data):
        damaged.append(range(end, len(data)))
    if not damaged:
        return events, ""
    return events, (
        f"{path}: {sum(map(len, damaged))} of its {len(data)} bytes are no whole events"
        f" and are left out, the first at byte {damaged[0].start}"
    )


def _event_at(data: bytes, place: int) -> Event | None:
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


# The run in a log ------------------------------------------------------------------

# This channel exists in logs only; its one event is the scenario as YAML text.
SCENARIO_CHANNEL = "VCBF_SCENARIO"


def start_log(
    bus: Bus, scenario: Scenario, path: str | Path, *, force: bool = False
) -> EventLogWriter:
    """Logs a scenario, and from now on all messages that a bus sends and receives.

    The bus is that of a vehicle's or a controller's process, before that is made. For
    the file see `EventLogWriter`.
    """
    log = EventLogWriter(path, force=force)
    channel, text = bus.channel(SCENARIO_CHANNEL), dump_scenario(scenario)
    log.tap(bus.clock.utime(), channel, text.encode())
    bus.taps.append(log.tap)
    return log


def carries_scenario(scenario: Scenario) -> bool:
    """Returns whether its log is self-contained: it has no class of a user's."""
    return type(scenario.vehicle).__module__.startswith("vcbf_drake.")


def of_one_vehicle(
    path: str | Path, events: Sequence[Event], name: str | None
) -> list[Event]:
    """Returns the events of one vehicle, on channels without its name.

    Raises:
        EventLogError: The events are of several vehicles, or of none of that name.
    """
    parts = [event.channel.partition("/") for event in events]
    names = sorted({end for base, _, end in parts if base == "VCBF_STATE"})
    found = ", ".join(each or "one without a name" for each in names) or "none"
    if name is None and len(names) > 1:
        words = f"is of several vehicles: {found}; --name says which"
        raise EventLogError(f"{path}: {words}")
    if name is not None and name not in names:
        raise EventLogError(f"{path}: has no vehicle {name}; it has {found}")
    wanted = name if name is not None else (names or [""])[0]
    return [
        event._replace(channel=base)
        for event, (base, _, end) in zip(events, parts, strict=True)
        if end == wanted or base == SCENARIO_CHANNEL
    ]


def logged_scenario(path: str | Path, events: Sequence[Event]) -> Scenario:
    """Returns the scenario that a log carries.

    Raises:
        EventLogError: It carries none.
        ScenarioError: It does not load.
    """
    for event in events:
        if event.channel == SCENARIO_CHANNEL:
            text = event.data.decode(errors="replace")
            try:
                return parse_scenario(text, f"{path}, channel {SCENARIO_CHANNEL}")
            except ScenarioError as error:
                hint = "a log of a vehicle of your own needs its SCENARIO"
                raise ScenarioError(f"{error}; {hint}") from None
    raise EventLogError(f"{path}: carries no scenario; it must be given")
