"""vcbf-drake: the command line.

Only typer and rich are imported here, so that ``--help`` answers at once; each command
imports what it needs. A command is a plain function; this list is their order.
"""

from collections.abc import Callable
import inspect
import signal
import sys
from typing import Any, NoReturn

from vcbf_drake.cli.application import app
from vcbf_drake.cli.hardware import controller, plant, replay_log
from vcbf_drake.cli.simulations import (
    check,
    compare,
    diagram,
    list_scenarios,
    run,
    schema,
    show,
)
from vcbf_drake.cli.studies import faults, monte_carlo
from vcbf_drake.environment import handle, say_interrupted

_COMMANDS: dict[str, Callable[..., Any]] = {
    "list": list_scenarios,
    "show": show,
    "schema": schema,
    "run": run,
    "compare": compare,
    "check": check,
    "diagram": diagram,
    "monte-carlo": monte_carlo,
    "faults": faults,
    "plant": plant,
    "controller": controller,
    "replay-log": replay_log,
}


def _help(command: Callable[..., Any]) -> str:
    """The docstring, one line a paragraph: the terminal wraps it."""
    paragraphs = (inspect.getdoc(command) or "").split("\n\n")
    return "\n\n".join(" ".join(each.split()) for each in paragraphs)


for _name, _command in _COMMANDS.items():
    app.command(_name, help=_help(_command))(_command)

__all__ = ["app", "main"]


def main() -> None:
    """Runs the command line; what a terminated command began is removed."""
    handle(signal.SIGTERM, _terminate)
    handle(signal.SIGHUP, _terminate)
    app()


def _terminate(number: int, frame: object) -> NoReturn:
    say_interrupted()
    sys.exit(128 + number)
