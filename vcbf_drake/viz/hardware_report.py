"""What the two halves of a loop over LCM print at their end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from vcbf_drake.viz.terminal import OUTCOME_STYLES, number_text

_MOST_CHANGES = 12

# Label, key and unit of what is a number.
_NUMBERS = (
    ("reached", "reached_at", "s"),
    ("time", "time", "s"),
    ("min h", "min_barrier", ""),
    ("distance", "final_distance", "m"),
    ("ticks", "ticks", ""),
    ("infeasible ticks", "infeasible_ticks", ""),
    ("failed ticks", "failed_ticks", ""),
    ("min V_v", "min_volume", ""),
    ("max |slack|", "max_abs_slack", ""),
    ("real-time rate", "real_time_rate", ""),
    ("periods missed", "deadlines_missed", ""),
)


def print_hardware_report(side: str, report: Mapping[str, Any]) -> None:
    """Prints the report of a vehicle's or a controller's process.

    Args:
        side: Whose report it is.
        report: What `PlantProcess.report` or `ControllerProcess.report` returned, or
            that of a `LogReplay`.
    """
    console = Console(highlight=False, markup=False)
    console.print(f"\n{side} of {report['scenario']}")
    table = Table.grid(padding=(0, 2))
    if "ending" in report:
        table.add_row("ended by", report["ending"])
    if "outcome" in report:
        outcome = report["outcome"]
        table.add_row("outcome", Text(outcome, OUTCOME_STYLES[outcome]))
    for label, key, unit in _NUMBERS:
        if key in report:
            table.add_row(label, f"{number_text(report[key])} {unit}".strip())
    for label, key in (("tick", "tick_ms"), ("round trip", "round_trip_ms")):
        if key in report:
            table.add_row(label, _percentiles(report[key]))
    if "prediction" in report:
        table.add_row("prediction", _prediction(report["prediction"]))
    arrived = report["arrived"]
    table.add_row(
        "messages",
        ", ".join(f"{arrived[key]} {key}" for key in ("accepted", "lost", "late")),
    )
    rejected = arrived["rejected"].items()
    table.add_row(
        "rejected", ", ".join(f"{n} {reason}" for reason, n in rejected) or "none"
    )
    for finding, count in report.get("findings", {}).items():
        table.add_row("refuted", f"{finding} ({count} ticks)")
    if "commands" in report:
        table.add_row("commands", _sameness(report["commands"]))
    for index, line in enumerate(_changes(report["changes"])):
        table.add_row("" if index else "mode", line)
    console.print(table)


def _percentiles(times: Mapping[str, float | None]) -> str:
    median, p99 = (number_text(times[key]) for key in ("median", "p99"))
    return f"{median} ms median, {p99} ms p99"


def _prediction(found: Mapping[str, Mapping[str, float | None]]) -> str:
    ahead, off, without = (
        number_text(found[key]["median"])
        for key in ("ahead_ms", "off_mm", "off_without_mm")
    )
    return f"{ahead} ms ahead, {off} mm off; without it {without} mm (medians)"


def _sameness(commands: Mapping[str, Any]) -> str:
    difference = number_text(commands["largest_difference"])
    return (
        f"{commands['same']} of {commands['logged']} logged ones came out again bit for"
        f" bit; largest difference {difference}"
    )


def _changes(changes: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [
        f"{change['time']:.2f} s: {change['mode']}"
        + (f", {change['reason']}" if change["reason"] else "")
        for change in changes[:_MOST_CHANGES]
    ]
    if len(changes) > _MOST_CHANGES:
        lines.append(f"and {len(changes) - _MOST_CHANGES} more changes")
    return lines
