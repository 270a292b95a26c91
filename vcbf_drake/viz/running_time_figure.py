"""The running times of a study, in pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from vcbf_drake.viz.style import (
    INK,
    METHOD_STYLES,
    PAGE_WIDTH,
    Figure,
    Style,
    figure_style,
    new_figure,
    save_figure,
)

Record = Mapping[str, Any]

# More would be one dark block, and slow to draw.
_MOST_COLUMNS = 1000
# Many columns are drawn finely.
_MANY = 60
_PAIR = "#c5ccd5"
_MARKERS = {
    "reached": "o",
    "timeout": "s",
    "infeasible": "x",
    "failed": "+",
    "collision": "*",
}


def write_running_times(
    records: Sequence[Record], summary: Record, directory: Path
) -> list[Path]:
    """Writes the figure of a study's running times, as PNG and SVG.

    Args:
        records: The records of the trials.
        summary: The result of `summarise_study`.
        directory: An existing directory to write to.

    Returns:
        The two paths.
    """
    with figure_style():
        figure = running_time_figure(records, summary)
        return save_figure(figure, directory, "running_times")


def running_time_figure(records: Sequence[Record], summary: Record) -> Figure:
    """Every pair as one column, in the order of the first method's running times.

    The mean of each method and its confidence interval stand at the right.
    """
    figure = new_figure(PAGE_WIDTH, 3.0)
    pairs, means = figure.subplots(1, 2, sharey=True, width_ratios=[8, 1])
    methods = list(summary["methods"])
    columns = _columns(records, methods)
    every = max(math.ceil(len(columns) / _MOST_COLUMNS), 1)
    columns, size = columns[::every], 5.0 if len(columns) <= _MANY else 3.0
    times = [[record["running_time"] for record in each.values()] for each in columns]
    lowest, highest = list(map(min, times)), list(map(max, times))
    pairs.vlines(range(len(columns)), lowest, highest, color=_PAIR, lw=0.5)
    seen = {record["outcome"] for record in records}
    for position, (method, numbers) in enumerate(summary["methods"].items()):
        color, label = METHOD_STYLES[method].color, METHOD_STYLES[method].label
        pairs.plot([], [], color=color, lw=4, label=label)
        for outcome, marker in _MARKERS.items():
            points = [
                (k, each[method]["running_time"])
                for k, each in enumerate(columns)
                if method in each and each[method]["outcome"] == outcome
            ]
            if points:
                look: Style = dict(ls="", marker=marker, ms=size, color=color)
                pairs.plot(*zip(*points, strict=True), **look, clip_on=False)
        if (mean := numbers["mean_running_time"]) is not None:
            low, high = numbers["interval"] or (mean, mean)
            means.vlines(position, low, high, color=color, lw=1.2)
            means.plot([position], [mean], ls="", marker="D", ms=4, color=color)
    for outcome in [each for each in _MARKERS if each in seen]:
        grey: Style = dict(ls="", marker=_MARKERS[outcome], ms=5, color=INK)
        pairs.plot([], [], **grey, label=outcome)
    pairs.set(
        xlabel=f"{'trials' if every <= 1 else f'one trial in {every}'},"
        f" in the order of {METHOD_STYLES[methods[0]].label}",
        ylabel="running time [s]",
        xticks=[],
    )
    pairs.set_ylim(bottom=0.0)
    means.set(xlabel="mean", xticks=[], xlim=(-0.6, len(methods) - 0.4))
    figure.legend(*pairs.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure


def _columns(
    records: Sequence[Record], methods: Sequence[str]
) -> list[dict[str, Record]]:
    """The records that ended, one dict by method for each draw, by their times."""
    columns: dict[int, dict[str, Record]] = {}
    for record in sorted(records, key=lambda each: each["index"]):
        if record["error"] is None:
            columns.setdefault(record["index"], {})[record["method"]] = record
    # A trial that crashed has no place in the order: last.
    crashed = {"running_time": math.inf}
    return sorted(
        columns.values(),
        key=lambda each: [each.get(m, crashed)["running_time"] for m in methods],
    )
