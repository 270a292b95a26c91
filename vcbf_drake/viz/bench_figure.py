"""A benchmark as a picture: CPU time beside accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vcbf_drake.viz.style import (
    INK,
    METHOD_STYLES,
    MUTED,
    PAGE_WIDTH,
    figure_style,
    new_figure,
    save_figure,
)

_OURS = METHOD_STYLES["dob-vcbf-qp"].color
_OTHERS = METHOD_STYLES["dob-cbf-qp"].color
_EXACT = 1e-16  # Errors below the rounding of doubles are drawn here.
_HEADING, _GAP = 0.9, 0.5  # What a task takes beside its routes, in rows.


def write_bench(results: Mapping[str, Any], directory: Path) -> list[Path]:
    """Writes the figure of a benchmark, as PNG and SVG.

    Args:
        results: What `run_bench` returned.
        directory: Where to write; it exists.

    Returns:
        The two paths.
    """
    with figure_style():
        return save_figure(bench_figure(results), directory, "bench")


def bench_figure(results: Mapping[str, Any]) -> Any:
    """One row a route: its CPU time on the left, its error on the right.

    Dots are medians; a line goes on to the 99th percentile of the times, and to the
    largest error.

    Args:
        results: What `run_bench` returned.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    tasks = results["tasks"]
    height = sum(len(task["routes"]) + _HEADING + _GAP for task in tasks)
    figure = new_figure(PAGE_WIDTH, 0.21 * height + 0.5)
    times, errors = figure.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    row, labels = 0.0, {}
    for task in tasks:
        times.text(
            *(0.0, row, task["title"]),
            transform=times.get_yaxis_transform(),
            va="center",
            color=INK,
            weight="bold",
            size=8,
        )
        row += _HEADING
        for route in task["routes"]:
            labels[row] = route["name"]
            color = _OURS if route["rows"] == "derived" else _OTHERS
            _draw_time(times, row, route, color)
            _draw_error(errors, row, route, color)
            row += 1.0
        row += _GAP
    for axes in (times, errors):
        axes.set_xscale("log")
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    times.set_yticks(list(labels), list(labels.values()))
    times.set_ylim(row - _GAP, -0.6)
    times.set_xlabel("CPU time [ms], median to 99th percentile")
    errors.set_xlabel("error, median to largest")
    times.margins(x=0.12)
    return figure


def _times(ratio: float) -> str:
    if ratio == 1.0:
        return ""
    return f"×{ratio:.0f}" if ratio > 99.0 else f"×{ratio:.2g}"


def _draw_time(axes: Any, row: float, route: Mapping[str, Any], color: str) -> None:
    median, last = route["median_ms"], route["p99_ms"] or route["median_ms"]
    axes.hlines(row, median, last, color=color, lw=1.0)
    axes.plot([median], [row], "o", ms=4.5, color=color)
    axes.annotate(
        _times(route["ratio"]),
        (max(last, median), row),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        color=MUTED,
        size=7.5,
    )


def _draw_error(axes: Any, row: float, route: Mapping[str, Any], color: str) -> None:
    largest = route["error_max"]
    if largest is None:
        return
    median = route.get("error_median", largest)
    low, high = max(median, _EXACT), max(largest, _EXACT)
    axes.hlines(row, low, high, color=color, lw=1.0)
    axes.plot([low], [row], "o", ms=4.5, color=color)
