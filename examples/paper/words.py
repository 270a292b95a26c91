"""Numbers, outcomes and tables in words, the same way everywhere in the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import re

from vcbf_drake.viz.style import METHOD_STYLES

from .archive import in_drawing_order
from .experiment import Numbers

NOTHING = "–"
# From best to worst; every count of outcomes is told in this order.
OUTCOMES = ("reached", "timeout", "infeasible", "collision", "error")
TITLES = {"timeout": "not arrived", "error": "crashed"}

_MINUS = re.compile(r"(?<!\w)-(?=\d)")
_NUMBER = re.compile(r"[-−\d.,() to%e]*|–")


# Numbers -----------------------------------------------------------------------------


def fixed(value: float | None, digits: int = 2) -> str:
    """A number with so many decimals; a dash where there is none."""
    if value is None:
        return NOTHING
    # No zero with a minus sign, and a true minus before the others.
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def significant(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits; a dash where there is none."""
    return NOTHING if value is None else f"{value:.{digits}g}"


def slack(value: float | None) -> str:
    """A slack; 0 only where it is exactly that."""
    return "0" if value == 0.0 else significant(value, 2)


def between(interval: Sequence[float] | None, digits: int = 2) -> str:
    """An interval; a dash where there is none."""
    if interval is None:
        return NOTHING
    return f"{fixed(interval[0], digits)} to {fixed(interval[1], digits)}"


def percent(share: float | None) -> str:
    """A share in percent."""
    return NOTHING if share is None else f"{100.0 * share:.1f} %"


def proportion(share: Numbers) -> str:
    """A count out of a total, with its interval."""
    if share["rate"] is None:
        return "none of none"
    interval = ""
    if share.get("interval") is not None:
        low, high = share["interval"]
        interval = f", {100 * low:.0f} to {high:.0%}"
    return f"{share['count']} of {share['of']} ({share['rate']:.0%}{interval})"


def mean_time(running_time: Numbers) -> str:
    """A mean with its interval."""
    mean, interval = running_time["mean"], running_time["interval"]
    if interval is None:
        return f"{mean:.2f} s"
    return f"{mean:.2f} s ({interval[0]:.2f} to {interval[1]:.2f})"


# Words -------------------------------------------------------------------------------


def label(method: str) -> str:
    """A method's name as people read it."""
    return METHOD_STYLES[method].label


def readable(typed: str) -> str:
    """A label that was typed in plain letters, as it is set."""
    return _MINUS.sub("−", typed.replace("^2", "²").replace("=", " = "))


def listed(words: Sequence[str]) -> str:
    """Words with commas and an `and`."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def ending(summary: Numbers) -> str:
    """How a run ended, as what follows the method's name."""
    return {
        "reached": "arrives at {reached_at:.1f} s",
        "infeasible": "has no feasible input at {infeasible_at:.2f} s",
        "collision": "collides at {collided_at:.1f} s",
        "timeout": "is still on its way after {running_time:.0f} s",
    }[summary["outcome"]].format(**summary)


def endings(runs: Mapping[str, Numbers]) -> str:
    """How every run ended, as a sentence."""
    parts = [
        f"{label(method)} {ending(run['summary'])}"
        for method, run in in_drawing_order(runs).items()
    ]
    return "; ".join(parts) + "."


def least_barriers(runs: Mapping[str, Numbers], unit: str) -> str:
    """The least barrier of every run."""
    return ", ".join(
        f"{label(method)} {fixed(run['summary']['min_barrier'], 4)} {unit}"
        for method, run in in_drawing_order(runs).items()
    )


def collides(summary: Numbers) -> bool:
    """Whether a run ended in a collision."""
    return bool(summary["outcome"] == "collision")


def arrives(summary: Numbers) -> bool:
    """Whether a run arrived without touching anything."""
    return bool(summary["outcome"] == "reached" and summary["min_barrier"] > 0.0)


def least_square(summary: Numbers) -> str:
    """The least h of a barrier that is a difference of squares."""
    least = round(summary["min_barrier"], 2) + 0.0  # No minus before a zero.
    return f"least h {least:.2f} m²"


# Tables, as Markdown -----------------------------------------------------------------


def table(
    caption: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    command: str = "",
    merged: int = 0,
) -> str:
    """A caption and a table; columns of numbers stand flush right.

    Args:
        caption: What it says and what to notice.
        columns: The heads.
        rows: The cells, one for each column.
        command: What makes its numbers.
        merged: How many leading cells are left empty where the row above has the same.
    """
    cells = [[each.replace("|", r"\|") for each in row] for row in rows]
    is_number = [
        all(_NUMBER.fullmatch(row[i]) for row in cells) for i in range(len(columns))
    ]
    dashes = ["---:" if each else "---" for each in is_number]
    lines = [list(columns), dashes, *_without_repeats(cells, merged)]
    words = f"{caption} `{command}`" if command else caption
    return "\n".join([words, "", *(f"| {' | '.join(line)} |" for line in lines)])


def runs_table(
    caption: str,
    conditions: Sequence[tuple[str, Mapping[str, Numbers]]],
    unit: str,
    command: str = "",
) -> str:
    """How single runs ended, with the numbers people compare.

    Args:
        caption: What it says and what to notice.
        conditions: A condition in words, empty when there is only one, and its runs:
            for each method an entry with its ``summary``.
        unit: The unit of the barriers.
        command: What makes the runs.
    """
    many = any(words for words, _ in conditions)
    columns = ["method", "outcome", "at [s]", f"least *h* [{unit}]", "least *Vᵥ*"]
    rows = [
        [readable(words)] * many + [label(method), *_run_cells(run["summary"])]
        for words, runs in conditions
        for method, run in in_drawing_order(runs).items()
    ]
    columns = ["condition"] * many + [*columns, "greatest slack", "to target [m]"]
    return table(caption, columns, rows, command, merged=int(many))


def trials_table(
    caption: str,
    heads: Sequence[str],
    rows: Sequence[tuple[Sequence[str], Numbers]],
    command: str = "",
) -> str:
    """Trials counted by their outcomes, with running times and extremes.

    Args:
        caption: What it says and what to notice.
        heads: The leading columns.
        rows: The leading cells and what `describe` says of the trials.
        command: What makes the trials.
    """
    shown = [o for o in OUTCOMES if any(o in each["outcomes"] for _, each in rows)]
    counted = [TITLES.get(outcome, outcome) for outcome in shown]
    columns = [*heads, "trials", *counted, "mean [s]", "95 % interval"]
    columns += ["least *Vᵥ*", "greatest slack", "with slack"]
    cells = [
        [
            *leading,
            str(sum(each["outcomes"].values())),
            *(str(each["outcomes"].get(outcome, 0)) for outcome in shown),
            fixed(each["mean_running_time"]),
            between(each["interval"]),
            fixed(each["least_volume"], 4),
            slack(each["greatest_slack"]),
            str(each["with_slack"]["count"]),
        ]
        for leading, each in rows
    ]
    return table(caption, columns, cells, command, merged=len(heads) - 1)


def _without_repeats(
    rows: Sequence[Sequence[str]], leading: int
) -> Iterable[Sequence[str]]:
    above: Sequence[str] = ()
    for row in rows:
        same = 0
        while same < leading and above[: same + 1] == row[: same + 1]:
            same += 1
        yield [*([""] * same), *row[same:]]
        above = row


def _run_cells(summary: Numbers) -> list[str]:
    outcome = summary["outcome"]
    when = {
        "reached": "reached_at",
        "infeasible": "infeasible_at",
        "collision": "collided_at",
    }
    return [
        TITLES.get(outcome, outcome),
        fixed(summary[when.get(outcome, "running_time")]),
        fixed(summary["min_barrier"], 4),
        fixed(summary["min_volume"], 4),
        slack(summary["max_abs_slack"]),
        fixed(summary["final_distance"]),
    ]
