"""Every figure of one or several results, as PNG and SVG, and the paths' own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.feasible_set import feasible_set_figure, telling_times
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
from vcbf_drake.viz.solids import Solid, hull, solids_of, walls_of
from vcbf_drake.viz.space_figure import draw_space
from vcbf_drake.viz.style import (
    MUTED,
    OBSTACLE,
    PAGE_WIDTH,
    START,
    TARGET,
    Axes,
    Figure,
    Style,
    figure_style,
    legend_above,
    legend_in_a_row,
    new_figure,
    save_figure,
)

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result

NAMES = ("x [m]", "y [m]", "z [m]")


def write_figures(results: Sequence[Result], directory: Path) -> list[Path]:
    """Writes every figure that results of one scenario have, each as PNG and SVG.

    Args:
        results: Results of one scenario under one or several methods, the one to bring
            out last.
        directory: The directory to write to; it is made.

    Returns:
        The paths, in the order of writing.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    runs = label_runs(results)
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []

    def write(name: str, figure: Figure) -> None:
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
        write("feasible_sets", feasible_set_figure(runs, telling_times(runs)))
    return paths


def overview_figure(runs: Sequence[Run]) -> Figure:
    """The paths, the volume barrier and the least barrier of every run."""
    figure = new_figure(1.25 * PAGE_WIDTH, 5.4)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.35, 1.0])
    if runs[-1].is_flat:
        draw_plane(figure.add_subplot(grid[0, :]), runs, (0, 1))
    else:
        draw_space(figure.add_subplot(grid[0, :]), runs)
    volume, barriers = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
    draw_volume(volume, runs)
    draw_barriers(barriers, runs)
    lines, _ = volume.get_legend_handles_labels()
    words = [": ".join([r.label, *(e.text for e in r.events[-1:])]) for r in runs]
    style: Style = dict(ncols=4, fontsize=8 if len(runs) < 4 else 7, columnspacing=1.2)
    figure.legend(lines, words, loc="outside upper left", **style)
    return figure


def path_figure(runs: Sequence[Run]) -> Figure:
    """The paths in space, from above and from the side; in the plane from above."""
    low, high = path_extent(runs)
    x, y, z = high - low
    scale = 0.86 * PAGE_WIDTH / x
    if runs[-1].is_flat:
        figure = new_figure(PAGE_WIDTH, scale * y + 0.8)
        axes = figure.subplots()
        draw_plane(axes, runs, (0, 1))
        legend_above(axes)
        return figure
    if x > 1.8 * max(y, z):
        heights = [0.36 * PAGE_WIDTH, scale * y + 0.6, scale * z + 0.6]
        figure = new_figure(PAGE_WIDTH, sum(heights) + 0.4)
        grid = figure.add_gridspec(3, 1, height_ratios=heights)
        cells = [grid[0], grid[1], grid[2]]
    else:
        figure = new_figure(PAGE_WIDTH, 0.62 * PAGE_WIDTH)
        grid = figure.add_gridspec(2, 2, width_ratios=[1.35, 1.0])
        cells = [grid[:, 0], grid[0, 1], grid[1, 1]]
    space, above, side = map(figure.add_subplot, cells)
    draw_space(space, runs)
    draw_plane(above, runs, (0, 1))
    draw_plane(side, runs, (0, 2))
    entries = above.get_legend_handles_labels()
    options = legend_in_a_row(entries[1])
    figure.legend(*entries, loc="outside upper left", **options)
    return figure


def draw_plane(axes: Axes, runs: Sequence[Run], plane: tuple[int, int]) -> None:
    """Draws paths and obstacles projected on two coordinates, across and up."""
    pair = list(plane)
    last = runs[-1]
    end = max(float(run.time[-1]) for run in runs)
    for solid in solids_of(last.scenario):
        _draw_solid(axes, solid, pair, end)
    for wall in walls_of(last.scenario):
        across = wall.normal[pair]
        if np.any(across):
            along = np.array([-across[1], across[0]])
            for offset, dashes in (
                (wall.offset, "-"),
                (wall.offset + wall.margin, (0, (3, 2))),
            ):
                foot = offset * across / (across @ across)
                style: Style = dict(color=MUTED, lw=1.2, ls=dashes, zorder=2)
                axes.axline(foot, foot + along, **style)
    for run in runs:
        axes.plot(*run.path[:, pair].T, **run.line(), zorder=3)
        if run.failure_tick is not None:
            style = dict(ms=8, mfc=run.color, mec="white", zorder=5)
            axes.plot(*run.path[run.failure_tick, pair], "X", **style)
        if not run.ghost:
            axes.plot(*run.path[0, pair], "o", ms=5, color=START, zorder=4)
            mark: Style = dict(ms=11, mfc=TARGET, mec="white", zorder=4)
            axes.plot(*run.target[pair], "*", **mark)
    low, high = (corner[pair] for corner in path_extent(runs))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=NAMES[plane[0]], ylabel=NAMES[plane[1]])


def path_extent(runs: Sequence[Run]) -> tuple[Array, Array]:
    """The corners of the space that holds paths and obstacles, shape (3,) each [m]."""
    found = [each for run in runs for each in (run.target, run.path)]
    found += [solid.whole.surface for solid in solids_of(runs[-1].scenario)]
    points = np.vstack(found)
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.03 * float((high - low).max())
    return low - room, high + room


def _draw_solid(axes: Axes, solid: Solid, pair: list[int], end: float) -> None:
    """An obstacle with its margin, and where it is in the end if it moves."""
    body, whole = (hull(p.surface[:, pair]) for p in (solid.body, solid.whole))
    if solid.moves:
        middle = 0.5 * (body.min(axis=0) + body.max(axis=0))
        times = solid.key_times(end)
        way = np.array([middle + solid.offset_at(time)[pair] for time in times])
        dashed: Style = dict(fill=False, ec=MUTED, lw=0.6, ls=(0, (3, 2)))
        axes.fill(*(whole + way[-1] - middle).T, **dashed)
        axes.plot(*way.T, color=MUTED, lw=0.8, zorder=2.5)
        arrow = dict(arrowstyle="-|>", color=MUTED, lw=0.8)
        axes.annotate("", way[-1], way[-2], arrowprops=arrow, zorder=2.5)
    if solid.keep_out is not None:
        axes.fill(*whole.T, fc=OBSTACLE, alpha=0.3, lw=0)
    style: Style = dict(fc=OBSTACLE, alpha=0.75, ec=MUTED, lw=0.6, zorder=2)
    axes.fill(*body.T, **style)
