"""LCM messages that nothing is wrong with: what attacks and fuzzing begin with."""

from __future__ import annotations

from typing import Any

from vcbf_drake.hil import (
    MessageFormat,
    SimulatedClock,
    command_format,
    obstacles_format,
    state_format,
)

SECOND = 1_000_000  # In microseconds.
NOW = SimulatedClock().now
SESSION = NOW - 100 * SECOND
FORMATS = (
    state_format(8, 3),
    command_format(3),
    obstacles_format(),
)


def genuine(form: MessageFormat, now: int, sequence: int) -> Any:
    """A message that nothing is wrong with.

    Args:
        form: What it has to be like.
        now: When it is sent [us].
        sequence: Its number in the session.
    """
    message = form.type()
    message.version, message.session = 2, SESSION
    message.sequence, message.utime = sequence, now
    sizes = form.sizes or {"num_obstacles": 7, "num_coordinates": 21}
    for name, size in sizes.items():
        setattr(message, name, size)
    for name, kind, sizes in zip(
        message.__slots__, message.__typenames__, message.__dimensions__, strict=True
    ):
        if sizes:
            item = {"double": 0.5, "boolean": True, "string": "row"}[kind]
            setattr(message, name, [item] * getattr(message, sizes[0]))
    if hasattr(message, "utime_measured"):
        message.utime_measured = now
    return message
