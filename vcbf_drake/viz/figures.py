"""Every figure of one or several results, as PNG and SVG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcbf_drake.viz.feasible_set import telling_times
from vcbf_drake.viz.feasible_set_figure import feasible_set_figure
from vcbf_drake.viz.path_figure import draw_plane, path_figure
from vcbf_drake.viz.runs import Run, label_runs
from vcbf_drake.viz.series_figures import (
    barrier_figure,
    disturbance_figure,
    draw_barriers,
    draw_volume,
    input_figure,
    slack_figure,
    volume_figure,
)
from vcbf_drake.viz.space_figure import draw_space
from vcbf_drake.viz.style import PAGE_WIDTH, figure_style, new_figure, save_figure

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result


def write_figures(
    results: Sequence[Result], directory: Path, times: Sequence[float] | None = None
) -> list[Path]:
    """Writes every figure that results of one scenario have, each as PNG and SVG.

    Args:
        results: Results of one scenario under one or several methods, the one to bring
            out last.
        directory: Where to write; it is made.
        times: When to show the feasible sets [s]; by default 2 s, the tick before the
            first infeasible one, and that tick.

    Returns:
        The paths, in the order of writing.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    runs = label_runs(results)
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    when = telling_times(runs) if times is None else times
    paths: list[Path] = []

    def write(name: str, figure: Any) -> None:
        paths.extend(save_figure(figure, directory, name))

    with figure_style():
        write("overview", overview_figure(runs))
        write("paths", path_figure(runs))
        write("barriers", barrier_figure(runs))
        write("volume", volume_figure(runs))
        write("slack", slack_figure(runs))
        if runs[-1].channels.disturbances:
            write("disturbance", disturbance_figure(runs))
        write("inputs", input_figure(runs))
        write("feasible_sets", feasible_set_figure(runs, when))
    return paths


def overview_figure(runs: Sequence[Run]) -> Any:
    """The paths, the volume barrier and the least barrier of every run.

    Args:
        runs: The runs, the one to bring out last.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    figure = new_figure(1.25 * PAGE_WIDTH, 5.4)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.35, 1.0])
    if runs[-1].is_flat:
        draw_plane(figure.add_subplot(grid[0, :]), runs, (0, 1))
    else:
        draw_space(figure.add_subplot(grid[0, :]), runs)
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
