"""Ctrl-C while a command loads: one line and the status of the signal.

Nothing is imported here, so that it holds from the first moment on.
"""

from __future__ import annotations

import os
import signal


def end_at_once(number: int, frame: object) -> None:
    """Ends the process in one line; a signal's handler until there is work to undo."""
    os.write(2, b"vcbf-drake: interrupted\n")
    os._exit(128 + number)


def end_at_once_on_interrupt() -> None:
    """Makes Ctrl-C end the process at once, unless it is ignored or taken already."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)


def raise_on_interrupt() -> None:
    """Undoes `end_at_once_on_interrupt`: whoever works now tidies up after itself."""
    if signal.getsignal(signal.SIGINT) is end_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)
