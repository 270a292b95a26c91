"""This process's surroundings: the signals that end a command, and Drake's log.

Nothing slow is imported here: a signal while a command loads, from the first moment on,
is answered by one line and its status, as the shell counts it.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # As in typing, which takes a while to import.
if TYPE_CHECKING:
    from collections.abc import Callable
    from logging import LogRecord
    from types import FrameType

_WARNING = 30  # As in logging, which takes a while to import.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def end_at_once(number: int, frame: object) -> None:
    """Ends the process in one line; a signal's handler until there is work to undo."""
    say_interrupted()
    os._exit(128 + number)


def say_interrupted() -> None:
    """Writes the line, unless stderr is closed."""
    try:
        os.write(2, b"vcbf-drake: interrupted\n")
    except OSError:
        pass


def end_at_once_on_signals() -> None:
    """Makes signals end the process at once, unless they are ignored or taken."""
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, end_at_once)


def handle(number: int, handler: Callable[[int, FrameType | None], object]) -> None:
    """Sets a signal's handler, unless the signal is ignored, as by nohup."""
    if signal.getsignal(number) is not signal.SIG_IGN:
        signal.signal(number, handler)


def raise_on_interrupt() -> None:
    """Makes Ctrl-C raise from now on, so that running work can clean up."""
    if signal.getsignal(signal.SIGINT) is end_at_once:
        signal.signal(signal.SIGINT, _raise_unless_importing)


def _raise_unless_importing(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt; amid an import, ends the process at once.

    A module in C++ that is interrupted while it is made raises an ImportError instead.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            end_at_once(number, frame)
        frame = frame.f_back
    raise KeyboardInterrupt


def show_warnings_only() -> None:
    """Restricts Drake's printed log to warnings and errors.

    A solver's own messages serve the debugging of solvers. A filter is used because
    importing pydrake resets the log's level.
    """
    from logging import getLogger

    getLogger("drake").addFilter(_is_warning)


def _is_warning(record: LogRecord) -> bool:
    return record.levelno >= _WARNING
