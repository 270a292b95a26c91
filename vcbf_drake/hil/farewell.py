"""say_farewell: the last message, so often that it arrives."""

from __future__ import annotations

from collections.abc import Callable
import time

_TIMES, _PAUSE = 10, 0.05  # [s]


def say_farewell(send: Callable[[], None]) -> None:
    """Sends a last message again and again for half a second.

    A bus may lose a message, and a DrakeLcm that is busy keeps the first of several
    that come at once: the one before the last.

    Args:
        send: Sends it.
    """
    for _ in range(_TIMES):
        send()
        time.sleep(_PAUSE)
