"""Tables that several sections share: single runs, and trials counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vcbf_drake.viz.report.document import Column, Table, number_columns
from vcbf_drake.viz.report.reproduction import in_drawing_order
from vcbf_drake.viz.report.tally import OUTCOMES, Tally
from vcbf_drake.viz.report.wording import (
    NOTHING,
    between,
    fixed,
    method_label,
    readable,
    slack,
)

Numbers = Mapping[str, Any]
Condition = tuple[str, Mapping[str, Numbers]]

OUTCOME_TITLES = {
    "reached": "reached",
    "timeout": "not arrived",
    "infeasible": "infeasible",
    "collision": "collision",
    "error": "crashed",
}
METHOD = Column("method", whole=True)
EXTREME_TITLES = ("least *Vᵥ*", "greatest slack", "with slack")


def runs_table(
    caption: str, conditions: Sequence[Condition], unit: str, command: str = ""
) -> Table:
    """How single runs ended, with the numbers people compare.

    Args:
        caption: What it says and what to notice.
        conditions: A condition in words, empty when there is only one, and its runs:
            for each method an entry with its ``summary``.
        unit: The unit of the barriers.
        command: What makes the runs.
    """
    conditioned = any(words for words, _ in conditions)
    columns = [
        *([Column("condition")] if conditioned else []),
        METHOD,
        Column("outcome", whole=True),
        *number_columns("at [s]", f"least *h* [{unit}]", "least *Vᵥ*"),
        *number_columns("greatest slack", "to target [m]"),
    ]
    rows = [
        [
            *([readable(words)] if conditioned else []),
            method_label(method),
            *_cells(run["summary"]),
        ]
        for words, runs in conditions
        for method, run in in_drawing_order(runs).items()
    ]
    leading = 1 if conditioned else 0
    return Table(caption, columns, without_repeats(rows, leading), command=command)


def tally_table(
    caption: str,
    heads: Sequence[Column],
    rows: Sequence[tuple[Sequence[str], Tally]],
    command: str = "",
) -> Table:
    """Trials counted by their outcomes, with running times and extremes.

    Args:
        caption: What it says and what to notice.
        heads: The leading columns.
        rows: The leading cells and what became of the trials.
        command: What makes the trials.
    """
    tallies = [tally for _, tally in rows]
    shown = [each for each in OUTCOMES if any(t.count(each) for t in tallies)]
    extremes = any(tally.least_volume is not None for tally in tallies)
    columns = [
        *heads,
        *number_columns("trials", *(OUTCOME_TITLES[each] for each in shown)),
        *number_columns("mean [s]", "95 % interval"),
        *(number_columns(*EXTREME_TITLES) if extremes else []),
    ]
    body = []
    for leading, tally in rows:
        counts = [str(tally.count(each)) for each in shown]
        cells = [*leading, str(tally.trials), *counts]
        cells += [fixed(tally.mean), between(tally.interval)]
        if extremes:
            used = NOTHING if tally.with_slack is None else str(tally.with_slack)
            cells += [fixed(tally.least_volume, 4), slack(tally.greatest_slack), used]
        body.append(cells)
    repeats = without_repeats(body, len(heads) - 1)
    return Table(caption, columns, repeats, command=command)


def without_repeats(rows: Sequence[Sequence[str]], leading: int) -> list[list[str]]:
    """Rows whose leading cells are empty where they are those of the row above."""
    above: Sequence[str] = ()
    thinned = []
    for row in rows:
        same = 0
        while same < leading and above[: same + 1] == row[: same + 1]:
            same += 1
        thinned.append([*([""] * same), *row[same:]])
        above = row
    return thinned


def _cells(summary: Numbers) -> list[str]:
    outcome = summary["outcome"]
    key = {
        "reached": "reached_at",
        "infeasible": "infeasible_at",
        "collision": "collided_at",
    }
    return [
        "not arrived" if outcome == "timeout" else outcome,
        fixed(summary[key.get(outcome, "running_time")]),
        fixed(summary["min_barrier"], 4),
        fixed(summary["min_volume"], 4),
        slack(summary["max_abs_slack"]),
        fixed(summary["final_distance"]),
    ]
