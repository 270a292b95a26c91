"""The command line, as ``vcbf-drake`` and as ``python -m vcbf_drake``."""

from __future__ import annotations

import os
import signal


def main() -> None:
    """Runs the command line; while it is imported, Ctrl-C ends it with one line."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
    from vcbf_drake.cli import main as run_commands

    if signal.getsignal(signal.SIGINT) is _end_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run_commands()


def _end_at_once(number: int, frame: object) -> None:
    os.write(2, b"vcbf-drake: interrupted\n")
    os._exit(128 + number)


if __name__ == "__main__":
    main()
