"""The command line, as ``vcbf-drake`` and as ``python -m vcbf_drake``."""

from __future__ import annotations

from vcbf_drake.environment import end_at_once_on_signals

# Before anything else is imported.
end_at_once_on_signals()


def main() -> None:
    """Runs the command line; until a command works, a signal ends it in one line."""
    from vcbf_drake.cli import main as run_commands

    run_commands()


if __name__ == "__main__":
    main()
