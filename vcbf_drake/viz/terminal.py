"""Tables and reports of the command line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from decimal import ROUND_FLOOR, Context
import math
import textwrap
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from vcbf_drake.safety.assumptions import Assumption
    from vcbf_drake.simulation.scenario import Scenario

OUTCOME_STYLES = {
    "reached": "green",
    "timeout": "yellow",
    "infeasible": "red",
    "failed": "red",
    "collision": "bold red",
}
_VERDICTS = {
    True: Text("holds", "green"),
    False: Text("does not hold", "red"),
    None: Text("information", "dim"),
}
# The part of 80 columns for the methods, beside the labels, and their number.
_METHODS_WIDTH, _MOST_METHODS = 66, 6
# A log from hardware does not know the truth.
_GUARANTEED = {True: "yes", False: "no", None: "-"}
_MOST_CHANGES = 12

# More commands than these are for the file.
_MOST_COMMANDS = 5

# Label, key and unit of what is a number.
_REPORTED_NUMBERS = (
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
    ("refused intervals", "refused_intervals", ""),
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

    More than six runs take more tables than one, one below the other.

    Args:
        summaries: The summaries.
        barrier_unit: The unit of the scenario's barriers.
    """
    console = _console(summaries[0]["scenario"])
    count = math.ceil(len(summaries) / math.ceil(len(summaries) / _MOST_METHODS))
    width = _METHODS_WIDTH // count - 1
    for first in range(0, len(summaries), count):
        shown = summaries[first : first + count]
        heads = ("\n".join(textwrap.wrap(each["method"], width)) for each in shown)
        columns = [_cells(summary, barrier_unit) for summary in shown]
        rows = [[label, *(c[label] for c in columns)] for label in columns[0]]
        console.print(_table(["", *heads], rows))
    for summary in summaries:
        for remark in _remarks(summary):
            console.print(f"{summary['method']}: {remark}")


def print_assumptions(heading: str, assumptions: Sequence[Assumption]) -> None:
    """Prints the hypotheses with their numbers, and what those that fail cost."""
    console = _console(heading)
    table = Table.grid(padding=(0, 2))
    for assumption in assumptions:
        table.add_row(_VERDICTS[assumption.holds], Text(assumption.name, "bold"))
        table.add_row("", Text(assumption.statement))
        numbers = assumption.numbers.items()
        text = ", ".join(f"{name} = {number_text(value)}" for name, value in numbers)
        table.add_row("", Text(text))
        if assumption.holds is False:
            table.add_row("", Text(f"cost: {assumption.consequence}", "red"))
    console.print(table)


def print_hardware_report(side: str, report: Mapping[str, Any]) -> None:
    """Prints the report of a vehicle's or a controller's process.

    Args:
        side: The side of the report.
        report: The result of `PlantProcess.report` or `ControllerProcess.report`, or
            that of a `LogReplay`.
    """
    console = _console(f"\n{side} of {report['scenario']}")
    table = Table.grid(padding=(0, 2))
    if "ending" in report:
        peer = "controller" if side == "vehicle" else "vehicle"
        ending = report["ending"].replace("no peer", f"no {peer} was heard")
        table.add_row("ended by", ending)
    outcome = report.get("outcome")
    if outcome is not None:
        table.add_row("outcome", Text(outcome, OUTCOME_STYLES[outcome]))
    for label, key, unit in _REPORTED_NUMBERS:
        if key in report:
            table.add_row(label, f"{number_text(report[key])} {unit}".strip())
    for label, key in (("tick", "tick_ms"), ("round trip", "round_trip_ms")):
        if key in report:
            median, p99 = (number_text(report[key][k]) for k in ("median", "p99"))
            table.add_row(label, f"{median} ms median, {p99} ms p99")
    arrived = report["arrived"]
    came = (f"{arrived[key]} {key}" for key in ("accepted", "lost", "late"))
    table.add_row("messages", ", ".join(came))
    rejected = (f"{count} {why}" for why, count in arrived["rejected"].items())
    table.add_row("rejected", ", ".join(rejected) or "none")
    for finding, count in report.get("findings", {}).items():
        table.add_row("refuted", f"{finding} ({count} ticks)")
    for reason in report.get("reasons_against_feasible", ()):
        table.add_row("not guaranteed", f"feasible: {reason}")
    if "commands" in report:
        same, logged = report["commands"]["same"], report["commands"]["logged"]
        words = f"{same} of {logged} logged ones came out again bit for bit; largest"
        largest = number_text(report["commands"]["largest_difference"])
        table.add_row("commands", f"{words} difference {largest}")
    changes = report["changes"]
    for index, change in enumerate(changes[:_MOST_CHANGES]):
        line = f"{change['time']:.2f} s: {change['mode']}"
        line += f", {change['reason']}" if change["reason"] else ""
        table.add_row("" if index else "mode", line)
    if len(changes) > _MOST_CHANGES:
        table.add_row("", f"and {len(changes) - _MOST_CHANGES} more changes")
    console.print(table)


def print_study(summary: Mapping[str, Any]) -> None:
    """Prints the methods of a study, the comparisons, and commands to run again."""
    methods, comparisons = summary["methods"], summary["comparisons"]
    seen = {outcome for each in methods.values() for outcome in each["outcomes"]}
    outcomes = [each for each in (*OUTCOME_STYLES, "error") if each in seen]
    console = Console(highlight=False, markup=False)
    rows = [
        [method, each["trials"], each["mean_running_time"], each["interval"]]
        + [each["outcomes"].get(outcome, 0) for outcome in outcomes]
        for method, each in methods.items()
    ]
    console.print(_table(["", "trials", "mean running s", "95 %", *outcomes], rows))
    rows = [
        [method, each["median_arrival"]]
        + [number_text(each[name]) for name in ("least_barrier", "least_volume")]
        for method, each in methods.items()
    ]
    heads = ["", "median arrival s", "least h", "least V_v"]
    console.print("", _table(heads, rows), sep="\n")
    if comparisons:
        heads = [f"against {comparisons[0]['baseline']}", "pairs", "longer by s"]
        heads += ["95 %", "better", "same", "worse"]
        keys = ("method", "pairs", "mean_difference", "interval", *heads[4:])
        rows = [[each[key] for key in keys] for each in comparisons]
        console.print("", _table(heads, rows), sep="\n")
    again = [(f"worse with {e['method']}", e["worse_trials"]) for e in comparisons]
    for title, trials in (*again, ("crashed", summary["errors"])):
        if trials:
            console.print(f"\n{title}:")
        for trial in trials[:_MOST_COMMANDS]:
            console.print(trial["replay"], soft_wrap=True)
        if len(trials) > _MOST_COMMANDS:
            console.print(f"and {len(trials) - _MOST_COMMANDS} more, in summary.json")


def _console(heading: str) -> Console:
    console = Console(highlight=False, markup=False)
    console.print(heading)
    return console


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
    """A table whose first column names the rows; numbers stand to the right."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    for column, head in enumerate(heads):
        table.add_column(head, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        table.add_row(*map(_cell, row))
    return table


def _cell(value: Any) -> str | Text:
    """A number, or an interval of two, in two decimals; a dash for none."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.2f}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "{:.2f} .. {:.2f}".format(*value)
    return value if isinstance(value, str | Text) else str(value)


def _cells(summary: Mapping[str, Any], barrier_unit: str) -> dict[str, str | Text]:
    outcome, cpu = summary["outcome"], summary["step_cpu_ms"]
    apart = summary.get("least_separation")  # Where there are other vehicles.
    return {
        "outcome": Text(outcome, OUTCOME_STYLES[outcome]),
        "running s": number_text(summary["running_time"]),
        "reached s": number_text(summary["reached_at"]),
        "infeasible s": number_text(summary["infeasible_at"]),
        "collided s": number_text(summary["collided_at"]),
        "guaranteed": _GUARANTEED[summary.get("guaranteed")],
        f"min h {barrier_unit}".strip(): number_text(summary["min_barrier"]),
        **({} if apart is None else {"min apart m": number_text(apart)}),
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
    if summary.get("guaranteed_feasible"):
        ticks = summary["backup_ticks"]
        yield f"guaranteed: feasible (Theorem 5); the backup acted at {ticks} ticks"
    against = summary.get("reasons_against_feasible")
    if against:
        yield f"not guaranteed feasible: {', '.join(against)}"
    certified = summary.get("certified_min_barrier")
    if certified is not None and certified >= 0.0:
        least = rounded_down(certified)
        yield f"certified at every instant, between ticks too: h >= {least}"


def number_text(value: float | None) -> str:
    """Returns a number in three digits, a count in all of its; a dash for none."""
    if isinstance(value, int):
        return str(value)
    return "-" if value is None or math.isnan(value) else f"{value:.3g}"


def rounded_down(value: float) -> str:
    """Returns a bound from below in three digits that is still one."""
    three_digits = Context(prec=3, rounding=ROUND_FLOOR)
    return f"{float(three_digits.create_decimal_from_float(value)):.3g}"
