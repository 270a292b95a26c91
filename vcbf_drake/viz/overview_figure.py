"""One picture of a comparison: the paths above, the volume and the barriers below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vcbf_drake.viz.geometry import geometry_of
from vcbf_drake.viz.path_figure import draw_plane
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.series_figures import draw_barriers, draw_volume
from vcbf_drake.viz.space_figure import draw_space
from vcbf_drake.viz.style import PAGE_WIDTH, new_figure


def overview_figure(runs: Sequence[Run]) -> Any:
    """The paths, the volume barrier and the least barrier of every run.

    Args:
        runs: The runs, the one to bring out last.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    figure = new_figure(1.25 * PAGE_WIDTH, 5.4)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.35, 1.0])
    if geometry_of(runs[-1].result).dimensions == 3:
        draw_space(figure.add_subplot(grid[0, :]), runs)
    else:
        draw_plane(figure.add_subplot(grid[0, :]), runs, (0, 1))
    volume, barriers = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
    draw_volume(volume, runs)
    draw_barriers(barriers, runs)
    figure.legend(
        *_outcomes(volume, runs),
        loc="outside upper left",
        ncols=4,
        fontsize=8 if len(runs) < 4 else 7,
        columnspacing=1.2,
    )
    return figure


def _outcomes(axes: Any, runs: Sequence[Run]) -> tuple[list[Any], list[str]]:
    """The legend: every run's line, its name and how it ended."""
    lines, _ = axes.get_legend_handles_labels()
    words = [
        f"{run.label}: {run.events[-1].text}" if run.events else run.label
        for run in runs
    ]
    return lines, words
