"""What the command line shows of a study: two tables, and what to look at again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

_OUTCOMES = ("reached", "timeout", "infeasible", "failed", "collision", "error")
# More commands than these are for the file.
_MOST_COMMANDS = 5


def print_study(summary: Mapping[str, Any]) -> None:
    """Prints the methods of a study, the comparisons, and commands to run again."""
    console = Console(highlight=False, markup=False)
    console.print(_methods_table(summary["methods"]))
    if summary["comparisons"]:
        console.print()
        console.print(_comparisons_table(summary["comparisons"]))
    for comparison in summary["comparisons"]:
        title = f"worse with {comparison['method']}"
        _print_commands(console, title, comparison["worse_trials"])
    _print_commands(console, "crashed", summary["errors"])


def _methods_table(methods: Mapping[str, Mapping[str, Any]]) -> Table:
    outcomes = [
        outcome
        for outcome in _OUTCOMES
        if any(outcome in numbers["outcomes"] for numbers in methods.values())
    ]
    table = _table("", "trials", "mean running s", "95 %", *outcomes)
    for method, numbers in methods.items():
        table.add_row(
            method,
            str(numbers["trials"]),
            _number(numbers["mean_running_time"]),
            _interval(numbers["interval"]),
            *(str(numbers["outcomes"].get(outcome, 0)) for outcome in outcomes),
        )
    return table


def _comparisons_table(comparisons: Sequence[Mapping[str, Any]]) -> Table:
    columns = ("pairs", "longer by s", "95 %", "better", "same", "worse")
    table = _table(f"against {comparisons[0]['baseline']}", *columns)
    for each in comparisons:
        table.add_row(
            each["method"],
            str(each["pairs"]),
            _number(each["mean_difference"]),
            _interval(each["interval"]),
            *(str(each[name]) for name in ("better", "same", "worse")),
        )
    return table


def _table(first: str, *columns: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column(first)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _print_commands(
    console: Console, title: str, trials: Sequence[Mapping[str, Any]]
) -> None:
    if not trials:
        return
    console.print(f"\n{title}:")
    for trial in trials[:_MOST_COMMANDS]:
        console.print(trial["replay"], soft_wrap=True)
    if len(trials) > _MOST_COMMANDS:
        console.print(f"and {len(trials) - _MOST_COMMANDS} more, in summary.json")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _interval(interval: Sequence[float] | None) -> str:
    return "-" if interval is None else "{:.2f} .. {:.2f}".format(*interval)
