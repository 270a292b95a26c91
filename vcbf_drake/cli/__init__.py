"""vcbf-drake: the command line.

Only typer and rich are imported here, so that ``--help`` answers at once; each command
imports what it needs. A command is a plain function; this list is their order.
"""

from collections.abc import Callable
from typing import Any

from vcbf_drake.cli.application import app
from vcbf_drake.cli.hardware import controller, plant
from vcbf_drake.cli.hardware_logs import replay_log
from vcbf_drake.cli.simulations import check, compare, diagram, list_scenarios, run
from vcbf_drake.cli.studies import faults, monte_carlo

_COMMANDS: dict[str, Callable[..., Any]] = {
    "list": list_scenarios,
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

for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)

__all__ = ["app", "main"]


def main() -> None:
    """Runs the command line."""
    app()
