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
    Axes,
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
        summary: What `summarise_study` says of them.
        directory: Where to write; it exists.

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
    every = math.ceil(len(columns) / _MOST_COLUMNS)
    columns = columns[:: max(every, 1)]
    times = [[record["running_time"] for record in each.values()] for each in columns]
    lowest, highest = list(map(min, times)), list(map(max, times))
    pairs.vlines(range(len(columns)), lowest, highest, color=_PAIR, lw=0.5)
    for method in methods:
        _draw_method(pairs, method, columns)
    for position, (method, numbers) in enumerate(summary["methods"].items()):
        _draw_mean(means, position, method, numbers)
    pairs.set(
        xlabel=f"{'trials' if every <= 1 else f'one trial in {every}'},"
        f" in the order of {METHOD_STYLES[methods[0]].label}",
        ylabel="running time [s]",
        xticks=[],
    )
    pairs.set_ylim(bottom=0.0)
    means.set(xlabel="mean", xticks=[], xlim=(-0.6, len(methods) - 0.4))
    figure.legend(*_legend(pairs, records), loc="outside upper left", ncols=4)
    return figure


def _columns(
    records: Sequence[Record], methods: Sequence[str]
) -> list[dict[str, Record]]:
    """The records that ended, one dict by method for each draw."""
    columns: dict[int, dict[str, Record]] = {}
    for record in records:
        if record["error"] is None:
            columns.setdefault(record["index"], {})[record["method"]] = record

    def times(column: dict[str, Record]) -> list[float]:
        # A trial that crashed has no place in the order: last.
        ended = [column.get(method) for method in methods]
        return [r["running_time"] if r else math.inf for r in ended]

    return sorted((columns[index] for index in sorted(columns)), key=times)


def _draw_method(
    axes: Axes, method: str, columns: Sequence[Mapping[str, Record]]
) -> None:
    style, size = METHOD_STYLES[method], 5.0 if len(columns) <= _MANY else 3.0
    axes.plot([], [], color=style.color, lw=4, label=style.label)
    for outcome, marker in _MARKERS.items():
        points = [
            (position, column[method]["running_time"])
            for position, column in enumerate(columns)
            if method in column and column[method]["outcome"] == outcome
        ]
        if points:
            look: Style = dict(ls="", marker=marker, ms=size, color=style.color)
            axes.plot(*zip(*points, strict=True), **look, clip_on=False)


def _draw_mean(axes: Axes, position: int, method: str, numbers: Record) -> None:
    mean, color = numbers["mean_running_time"], METHOD_STYLES[method].color
    if mean is None:
        return
    low, high = numbers["interval"] or (mean, mean)
    axes.vlines(position, low, high, color=color, lw=1.2)
    axes.plot([position], [mean], ls="", marker="D", ms=4, color=color)


def _legend(axes: Axes, records: Sequence[Record]) -> tuple[list[Any], list[str]]:
    """The methods' colours, and a grey marker for each outcome there is."""
    from matplotlib.lines import Line2D

    handles, labels = axes.get_legend_handles_labels()
    for outcome, marker in _MARKERS.items():
        if any(record["outcome"] == outcome for record in records):
            handles.append(Line2D([], [], ls="", marker=marker, ms=5, color=INK))
            labels.append(outcome)
    return handles, labels
