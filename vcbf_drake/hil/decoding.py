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
from typing import Any

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


VERSION = 1

# How far the clocks of two computers may be apart [us].
MAX_CLOCK_SKEW = 100_000
# No sender numbers messages faster than this [Hz].
_MAX_RATE = 10_000
# No state, input or time is as large as this, in SI units.
_MAX_NUMBER = 1e6
_MAX_BYTES = 65_536


class Reason(Enum):
    """Why a message is rejected."""

    LENGTH = "wrong length"
    TYPE = "another type"
    VERSION = "unknown version"
    SIZE = "array of another size"
    NUMBER = "not a finite number of sensible size"
    CODE = "unknown code"
    STAMPS = "contradictory time stamps or sequence"
    FUTURE = "from the future"
    SESSION = "of an earlier session"
    REPEATED = "repeated"
    OVERTAKEN = "overtaken by a newer one"
    OLD = "too old"


@dataclass(frozen=True)
class Rejection:
    """What takes the place of a message that must not be acted on."""

    reason: Reason


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
    """

    channel: str
    type: Any
    sizes: dict[str, int]
    codes: dict[str, int] = field(default_factory=dict)
    numbers: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()

    def decode(self, data: bytes, now: int) -> Any | Rejection:
        """Returns the message, or why it must not be acted on.

        Args:
            data: Whatever came.
            now: The time of its arrival [us].
        """
        if len(data) > _MAX_BYTES:
            return Rejection(Reason.LENGTH)
        try:
            message = self.type.decode(data)
        except struct.error:
            return Rejection(Reason.LENGTH)
        except ValueError:
            return Rejection(Reason.TYPE)
        if len(message.encode()) != len(data):
            return Rejection(Reason.LENGTH)
        fault = next(self._faults(message, now), None)
        return message if fault is None else Rejection(fault)

    def _faults(self, message: Any, now: int) -> Iterator[Reason]:
        if message.version != VERSION:
            yield Reason.VERSION
        if any(getattr(message, name) != size for name, size in self.sizes.items()):
            yield Reason.SIZE
        if not _has_its_sizes(message):
            yield Reason.SIZE
        if not all(map(_is_sensible, self._values(message, self.numbers))):
            yield Reason.NUMBER
        if any(math.isinf(value) for value in self._values(message, self.gaps)):
            yield Reason.NUMBER
        if not all(0 <= getattr(message, name) < n for name, n in self.codes.items()):
            yield Reason.CODE
        if message.utime > now + MAX_CLOCK_SKEW:
            yield Reason.FUTURE
        if not _is_consistent(message):
            yield Reason.STAMPS

    @staticmethod
    def _values(message: Any, names: tuple[str, ...]) -> Iterator[float]:
        for name in names:
            value = getattr(message, name)
            yield from (value,) if isinstance(value, float) else value


def _is_sensible(value: float) -> bool:
    return abs(value) < _MAX_NUMBER  # False for nan.


def _has_its_sizes(message: Any) -> bool:
    """Whether arrays are as long as said: a negative length decodes as none."""
    return all(
        len(getattr(message, name)) == getattr(message, sizes[0])
        for name, sizes in zip(message.__slots__, message.__dimensions__, strict=True)
        if sizes
    )


def _is_consistent(message: Any) -> bool:
    """Whether session, sequence and times can be true together.

    What a message claims is bounded by how long its sender runs: a forged number would
    otherwise keep the true ones out, as having gone back, for ever.
    """
    runs_for = message.utime - message.session
    elapsed = getattr(message, "time", 0.0)
    measured = getattr(message, "utime_measured", message.utime)
    return (
        message.session > 0
        and 0 <= message.sequence <= 1 + runs_for * 1e-6 * _MAX_RATE
        and message.session <= measured <= message.utime
        and 0.0 <= elapsed <= (runs_for + MAX_CLOCK_SKEW) * 1e-6
    )


def state_format(num_states: int, num_inputs: int) -> MessageFormat:
    """Returns the format of a vehicle's states."""
    return MessageFormat(
        channel="VCBF_STATE",
        type=vcbf_state,
        sizes={"num_states": num_states, "num_inputs": num_inputs},
        codes={"mode": len(VehicleMode)},
        numbers=("time", "state", "input_integral"),
    )


def command_format(num_inputs: int) -> MessageFormat:
    """Returns the format of commands."""
    return MessageFormat(
        channel="VCBF_COMMAND",
        type=vcbf_command,
        sizes={"num_inputs": num_inputs},
        codes={"mode": len(CommandMode)},
        numbers=("input",),
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
        numbers=("time", "state_age", "input", "disturbance_estimate", "error_bound"),
        gaps=("reference", "slack", "volume", "barriers"),
    )


def obstacles_format(num_obstacles: int, num_dimensions: int) -> MessageFormat:
    """Returns the format of a vehicle's obstacles."""
    return MessageFormat(
        channel="VCBF_OBSTACLES",
        type=vcbf_obstacles,
        sizes={
            "num_obstacles": num_obstacles,
            "num_coordinates": num_obstacles * num_dimensions,
        },
        numbers=("time", "radius", "position", "velocity"),
    )
