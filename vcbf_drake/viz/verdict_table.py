"""What the command line shows of a reproduction: one line a claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

_STYLES = {
    "reproduced": "green",
    "reproduced under stated conditions": "yellow",
    "undecided": "yellow",
    "not reproduced": "red",
}


def print_verdicts(verdicts: Sequence[Mapping[str, str]]) -> None:
    """Prints every claim with what was found and the numbers that say so.

    Args:
        verdicts: Those of the results.
    """
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), show_edge=False)
    for header in ("claim", "found", "number"):
        table.add_column(header)
    for verdict in verdicts:
        found = verdict["found"]
        table.add_row(
            Text(f"{verdict['where']}: {verdict['claim']}"),
            Text(found, _STYLES[found]),
            Text(verdict["number"]),
        )
    Console(highlight=False, markup=False).print(table)
