"""The command line, as ``vcbf-drake`` and as ``python -m vcbf_drake``."""

from __future__ import annotations

from vcbf_drake.interrupts import end_at_once_on_interrupt


def main() -> None:
    """Runs the command line; until a command works, Ctrl-C ends it with one line."""
    end_at_once_on_interrupt()
    from vcbf_drake.cli import main as run_commands

    run_commands()


if __name__ == "__main__":
    main()
