"""What a command asks for, and what a vehicle does."""

from __future__ import annotations

from enum import IntEnum


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
