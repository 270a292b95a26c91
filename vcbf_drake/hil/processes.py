"""HardwareProcess: how a process on the bus ends, and what it says on the way."""

from __future__ import annotations

from collections.abc import Callable
import time

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.mailbox import Inbox

_TIMES, _PAUSE = 10, 0.05  # [s]

# Why a process ended, and its exit status.
EXIT_STATUSES = {
    "duration": 0,
    "vehicle ended": 0,
    "collision": 3,
    "infeasible": 4,
    "no peer": 5,
    "stopped": 128,  # And the signal's number.
}


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


class HardwareProcess:
    """What both processes share: how they end, and what they say on the way.

    Attributes:
        bus: The bus.
        ending: Why `run` ended, one of the keys of `EXIT_STATUSES`; empty before.
        tell: Called with a line whenever something changes.
        progress: Called with a line once a second.
    """

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.ending = ""
        self.tell: Callable[[str], None] = lambda line: None
        self.progress: Callable[[str], None] = lambda line: None
        self._stopping = False
        self._told: dict[str, str] = {}
        self._progress_at = 0

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def _forget_the_start(self, inbox: Inbox) -> None:
        """What came before is no loss: nobody listened."""
        self.bus.drain()
        inbox.begin_anew()

    def _tell_change(self, subject: str, text: str, line: str) -> None:
        """Tells a line if the subject's text is another one than before."""
        if self._told.get(subject, "") != text:
            self._told[subject] = text
            self.tell(line)

    def _tell_progress(self, line: Callable[[], str]) -> None:
        now = self.bus.clock.utime()
        if now - self._progress_at >= 1_000_000:
            self._progress_at = now
            self.progress(line())
