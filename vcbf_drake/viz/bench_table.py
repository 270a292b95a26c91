"""What the command line shows of a benchmark: one table a task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

_COLUMNS = ("median ms", "p99 ms", "x ours", "error", "worst", "infeasible")
_RUN_COLUMNS = ("mean ms", "x ours", "worst")


def print_bench(results: Mapping[str, Any]) -> None:
    """Prints the CPU times and errors of a benchmark, and what is not installed."""
    console = Console(highlight=False, markup=False)
    for task in results["tasks"]:
        console.print(f"{task['title']} (error: {task['error_unit']})")
        console.print(_table(task))
        console.print()
    console.print("vcbf_drake derives its rows, cbfpy too; the others are given them.")
    missing = sorted({name for task in results["tasks"] for name in task["missing"]})
    if missing:
        console.print(
            f"not installed: {', '.join(missing)}: pip install 'vcbf-drake[bench]'"
        )


def _table(task: Mapping[str, Any]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("")
    columns = _RUN_COLUMNS if task["name"] == "run" else _COLUMNS
    for column in columns:
        table.add_column(column, justify="right")
    for route in task["routes"]:
        cells = {
            "median ms": _time(route["median_ms"]),
            "mean ms": _time(route["median_ms"]),
            "p99 ms": _time(route["p99_ms"]),
            "x ours": f"{route['ratio']:.3g}",
            "error": _error(route.get("error_median")),
            "worst": _error(route["error_max"]),
            "infeasible": _noticed(route),
        }
        table.add_row(route["name"], *(cells[column] for column in columns))
    return table


def _noticed(route: Mapping[str, Any]) -> str:
    """How many infeasible instances a route noticed, and where it found no answer."""
    if "noticed" not in route:
        return ""
    failed = f", {route['failed']} failed" if route["failed"] else ""
    return f"{route['noticed']} of {route['infeasible']}{failed}"


def _time(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}" if value < 10.0 else f"{value:.1f}"


def _error(value: float | None) -> str:
    return "-" if value is None else f"{value:.0e}"
