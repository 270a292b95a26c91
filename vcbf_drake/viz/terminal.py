"""What the command line shows on a terminal: tables and a progress bar."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from decimal import ROUND_FLOOR, Context
import math
import sys
import textwrap
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from vcbf_drake.safety.assumptions import Assumption
    from vcbf_drake.simulation.scenario import Scenario

OUTCOME_STYLES = {
    "reached": "green",
    "timeout": "yellow",
    "infeasible": "red",
    "collision": "bold red",
}
_VERDICTS = {
    True: Text("holds", "green"),
    False: Text("does not hold", "red"),
    None: Text("information", "dim"),
}
# What 80 columns leave to the methods, beside the labels.
_METHODS_WIDTH = 66
# A log from hardware does not know the truth.
_GUARANTEED = {True: "yes", False: "no", None: "-"}


def progress_bar() -> Progress:
    """Returns a bar on stderr that disappears when done; silent in a pipe."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )


def print_scenarios(scenarios: Sequence[Scenario]) -> None:
    """Prints the names of scenarios and the first lines of their descriptions."""
    table = Table.grid(padding=(0, 2, 0, 0), pad_edge=False)
    for scenario in scenarios:
        title = scenario.description.strip().partition("\n")[0]
        table.add_row(scenario.name, Text(title))
    Console().print(table)


def print_summaries(
    summaries: Sequence[Mapping[str, Any]], barrier_unit: str = ""
) -> None:
    """Prints the summaries of runs of one scenario, one column a run, and remarks.

    Args:
        summaries: The summaries.
        barrier_unit: The unit of the scenario's barriers.
    """
    console = Console(highlight=False, markup=False)
    width = _METHODS_WIDTH // len(summaries) - 1
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column()
    for summary in summaries:
        header = "\n".join(textwrap.wrap(summary["method"], width))
        table.add_column(header, justify="right", no_wrap=True)
    columns = [_cells(summary, barrier_unit) for summary in summaries]
    for label in columns[0]:
        table.add_row(label, *(cells[label] for cells in columns))
    console.print(summaries[0]["scenario"])
    console.print(table)
    for summary in summaries:
        for remark in _remarks(summary):
            console.print(f"{summary['method']}: {remark}")


def print_assumptions(scenario: Scenario, assumptions: Sequence[Assumption]) -> None:
    """Prints the hypotheses with their numbers, and what those that fail cost."""
    console = Console(highlight=False, markup=False)
    console.print(f"{scenario.name}, {scenario.method}")
    table = Table.grid(padding=(0, 2))
    for assumption in assumptions:
        table.add_row(_VERDICTS[assumption.holds], Text(assumption.name, "bold"))
        table.add_row("", Text(assumption.statement))
        table.add_row("", Text(_numbers(assumption.numbers)))
        if assumption.holds is False:
            table.add_row("", Text(f"cost: {assumption.consequence}", "red"))
    console.print(table)


def _cells(summary: Mapping[str, Any], barrier_unit: str) -> dict[str, str | Text]:
    outcome, cpu = summary["outcome"], summary["step_cpu_ms"]
    return {
        "outcome": Text(outcome, OUTCOME_STYLES[outcome]),
        "running s": number_text(summary["running_time"]),
        "reached s": number_text(summary["reached_at"]),
        "infeasible s": number_text(summary["infeasible_at"]),
        "collided s": number_text(summary["collided_at"]),
        "guaranteed": _GUARANTEED[summary.get("guaranteed")],
        f"min h {barrier_unit}".strip(): number_text(summary["min_barrier"]),
        "min V_v": number_text(summary["min_volume"]),
        "max |slack|": number_text(summary["max_abs_slack"]),
        "distance m": number_text(summary["final_distance"]),
        "CPU p50 ms": number_text(cpu["median"]),
        "CPU p99 ms": number_text(cpu["p99"]),
        "x real time": number_text(summary["real_time_factor"]),
    }


def _remarks(summary: Mapping[str, Any]) -> Iterator[str]:
    if summary["conflict"]:
        yield f"no input satisfies {', '.join(summary['conflict'])}"
    if summary.get("rows_without_authority"):
        names = ", ".join(summary["rows_without_authority"])
        yield f"no input could move the rows of {names} at some tick"
    failing = [
        each["name"] for each in summary["assumptions"] if each["holds"] is False
    ]
    if failing:
        yield f"hypotheses that fail (see vcbf-drake check): {', '.join(failing)}"
    broken = [
        f"{name} ({number_text(each['first_violation'])} s)"
        for name, each in summary.get("audit", {}).items()
        if each["held"] is False
    ]
    if broken:
        yield f"promises broken, first at (see summary.json): {', '.join(broken)}"
    certified = summary.get("certified_min_barrier")
    if certified is not None:
        least = rounded_down(certified)
        yield f"certified at every instant, between ticks too: h >= {least}"


def _numbers(numbers: Mapping[str, float]) -> str:
    return ", ".join(
        f"{name} = {number_text(value)}" for name, value in numbers.items()
    )


def number_text(value: float | None) -> str:
    """Returns a number in three digits; a dash for none."""
    return "-" if value is None or math.isnan(value) else f"{value:.3g}"


def rounded_down(value: float) -> str:
    """Returns a bound from below in three digits that is still one."""
    three_digits = Context(prec=3, rounding=ROUND_FLOOR)
    return f"{float(three_digits.create_decimal_from_float(value)):.3g}"
