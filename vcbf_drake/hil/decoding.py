"""From bytes to a checked message, or to the reason why not.

Anyone can write on the bus. Nothing here raises, and nothing here takes more memory
than a message has bytes, whatever the bytes are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum, IntEnum
import math
import struct
from typing import Any, TypedDict

from vcbf_drake.hil.bus import SIGNATURE_BYTES
from vcbf_drake.hil.messages import (
    vcbf_command,
    vcbf_obstacles,
    vcbf_state,
    vcbf_status,
)
from vcbf_drake.safety import FilterStatus


class CommandMode(IntEnum):
    """What a command asks of the vehicle."""

    APPLY = 0
    """Apply the input."""
    HOLD = 1
    """Apply the input; it is held, because the state it rests on is old."""
    FALLBACK = 2
    """Use the vehicle's own fallback; the status says why."""
    END = 3
    """The same, because the controller ends."""


class VehicleMode(IntEnum):
    """What a vehicle does."""

    WAITING = 0
    """It stands, until a first command comes."""
    FOLLOWING = 1
    """It applies the commands that come."""
    FALLBACK = 2
    """It zeroes its input or brakes, for no command came or one asked for it."""
    ENDED = 3
    """Nothing more: this is its last message."""


class ModeChange(TypedDict):
    """When something else began, and why.

    Attributes:
        time: Since the motion began [s].
        mode: What began: the name of a `CommandMode` or `VehicleMode`.
        reason: Why; empty where the mode says it all.
    """

    time: float
    mode: str
    reason: str


VERSION = 2

# No state or input is as large as this, in SI units.
_MAX_NUMBER = 1e6
# What grows as long as a vehicle runs, and how far: 1 MN for eleven days.
_GROWING, _MAX_GROWN = ("time", "input_integral"), 1e12
_MAX_BYTES = 65_536


class Reason(Enum):
    """Why a message is rejected."""

    LENGTH = "wrong length"
    TYPE = "another type"
    SIGNATURE = "not signed with our key"
    VERSION = "unknown version"
    SIZE = "array of another size"
    NUMBER = "not a finite number of sensible size"
    CODE = "unknown code"
    STAMPS = "contradictory time stamps or sequence"
    TIME = "its motion's time leaps"
    FUTURE = "from the future"
    PAST = "from the past"
    CLOCK = "contradicts its sender's clock"
    ADDRESS = "meant for another"
    SESSION = "of another sender than the one followed"
    REPEATED = "repeated"
    OVERTAKEN = "overtaken by a newer one"
    OLD = "too old"


@dataclass(frozen=True)
class Rejection:
    """What takes the place of a message that must not be acted on."""

    reason: Reason
    detail: str = field(default="", compare=False)

    @property
    def words(self) -> str:
        """The reason, and what is known beyond it."""
        reason = self.reason.value
        return f"{reason} ({self.detail})" if self.detail else reason


@dataclass(frozen=True)
class MessageFormat:
    """What a message on a channel has to look like.

    Attributes:
        channel: The channel's name.
        type: The class that lcm-gen made.
        sizes: The value of every field that is the size of an array.
        codes: Fields that are codes 0, 1, ..., and how many codes there are.
        numbers: Fields that hold finite numbers.
        gaps: Fields whose numbers may be nan.
        last_mode: The mode of a sender's last message, where it has one.
    """

    channel: str
    type: Any
    sizes: dict[str, int]
    codes: dict[str, int] = field(default_factory=dict)
    numbers: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()
    last_mode: int | None = None

    def decode(self, data: bytes) -> Any | Rejection:
        """Returns the message, or why it must not be acted on."""
        if len(data) > _MAX_BYTES:
            return Rejection(Reason.LENGTH, f"{len(data)} bytes")
        try:
            message = self.type.decode(data)
        except struct.error:
            return Rejection(Reason.LENGTH)
        except ValueError:
            return Rejection(Reason.TYPE)
        spare = len(data) - len(message.encode())
        if spare == SIGNATURE_BYTES:
            words = "as if it were signed; no key_file is set here"
            return Rejection(Reason.LENGTH, words)
        if spare:
            return Rejection(Reason.LENGTH)
        fault = next(self._faults(message), None)
        return message if fault is None else fault

    def is_last(self, message: Any) -> bool:
        """Returns whether its sender ends with it."""
        return self.last_mode is not None and message.mode == self.last_mode

    def _faults(self, message: Any) -> Iterator[Rejection]:
        if message.version != VERSION:
            found = f"{message.version}, ours is {VERSION}"
            yield Rejection(Reason.VERSION, found)
        for name, size in self.sizes.items():
            if getattr(message, name) != size:
                found = f"{name} is {getattr(message, name)}, not {size}"
                yield Rejection(Reason.SIZE, found)
        if not _has_its_sizes(message):
            yield Rejection(Reason.SIZE)
        for name in self.numbers:
            limit = _MAX_GROWN if name in _GROWING else _MAX_NUMBER
            # Not below it is nan, too.
            if not all(abs(each) < limit for each in _numbers(message, name)):
                yield Rejection(Reason.NUMBER, name)
        for name in self.gaps:
            if any(map(math.isinf, _numbers(message, name))):
                yield Rejection(Reason.NUMBER, name)
        for name, n in self.codes.items():
            if not 0 <= getattr(message, name) < n:
                yield Rejection(Reason.CODE, f"{name} {getattr(message, name)}")
        measured = getattr(message, "utime_measured", message.utime)
        is_ordered = message.session > 0 and message.sequence >= 0
        if not (is_ordered and 0 < measured <= message.utime):
            yield Rejection(Reason.STAMPS)
        if getattr(message, "time", 0.0) < 0.0:
            yield Rejection(Reason.STAMPS, "time is negative")


def _numbers(message: Any, name: str) -> Iterator[float]:
    value = getattr(message, name)
    yield from (value,) if isinstance(value, float) else value


def _has_its_sizes(message: Any) -> bool:
    """Whether arrays are as long as said: a negative length decodes as none."""
    return all(
        len(getattr(message, name)) == getattr(message, sizes[0])
        for name, sizes in zip(message.__slots__, message.__dimensions__, strict=True)
        if sizes
    )


# Before the first state, or before a round trip, these are nan.
_STATUS_GAPS = (
    *("state_age", "reference", "slack", "volume", "barriers"),
    *("disturbance_estimate", "error_bound", "disturbance_bound"),
    *("clock_offset", "clock_uncertainty"),
)


def state_format(num_states: int, num_inputs: int) -> MessageFormat:
    """Returns the format of a vehicle's states."""
    return MessageFormat(
        channel="VCBF_STATE",
        type=vcbf_state,
        sizes={"num_states": num_states, "num_inputs": num_inputs},
        codes={"mode": len(VehicleMode)},
        numbers=("time", "state", "input_integral"),
        last_mode=VehicleMode.ENDED,
    )


def command_format(num_inputs: int) -> MessageFormat:
    """Returns the format of commands."""
    return MessageFormat(
        channel="VCBF_COMMAND",
        type=vcbf_command,
        sizes={"num_inputs": num_inputs},
        codes={"mode": len(CommandMode)},
        numbers=("input",),
        last_mode=CommandMode.END,
    )


def status_format(
    num_inputs: int, num_barriers: int, num_disturbances: int
) -> MessageFormat:
    """Returns the format of a filter's status."""
    return MessageFormat(
        channel="VCBF_STATUS",
        type=vcbf_status,
        sizes={
            "num_inputs": num_inputs,
            "num_barriers": num_barriers,
            "num_disturbances": num_disturbances,
        },
        codes={"mode": len(CommandMode), "filter_status": len(FilterStatus)},
        numbers=("time", "input"),
        gaps=_STATUS_GAPS,
    )


def obstacles_format() -> MessageFormat:
    """Returns the format of a vehicle's obstacles, however many."""
    return MessageFormat(
        channel="VCBF_OBSTACLES",
        type=vcbf_obstacles,
        sizes={},
        numbers=("time", "radius", "position", "velocity"),
    )
