"""Every figure of one or several results, as PNG and SVG, and the paths' own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.plants.shapes import surface
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
from vcbf_drake.viz.style import (
    GRID,
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
    multiples,
    new_figure,
    save_figure,
)

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result

NAMES = ("x [m]", "y [m]", "z [m]")
SHADOW = "#d9dee5"


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
        if any(run.has_volume for run in runs):
            write("volume", volume_figure(runs))
        write("slack", slack_figure(runs))
        if runs[-1].channels.disturbances:
            write("disturbance", disturbance_figure(runs))
        write("inputs", input_figure(runs))
        write("feasible_sets", feasible_set_figure(runs, telling_times(runs)))
    return paths


def overview_figure(runs: Sequence[Run]) -> Figure:
    """The paths, the volume barrier if there is one, and every run's least barrier."""
    figure = new_figure(1.25 * PAGE_WIDTH, 5.4)
    top, bottom = figure.add_gridspec(2, 1, height_ratios=[1.35, 1.0])
    if runs[-1].is_flat:
        draw_plane(figure.add_subplot(top), runs, (0, 1))
    else:
        draw_space(figure.add_subplot(top), runs)
    draws = (
        [draw_volume, draw_barriers]
        if any(run.has_volume for run in runs)
        else [draw_barriers]
    )
    for cell, draw in zip(bottom.subgridspec(1, len(draws)), draws, strict=True):
        axes = figure.add_subplot(cell)
        draw(axes, runs)
    lines, _ = axes.get_legend_handles_labels()
    words = [": ".join([r.label, *(e.text for e in r.events[-1:])]) for r in runs]
    style: Style = dict(ncols=4, fontsize=8 if len(runs) < 4 else 7, columnspacing=1.2)
    figure.legend(lines, words, loc="outside upper left", **style)
    return figure


def path_figure(runs: Sequence[Run]) -> Figure:
    """The paths from above; in space from the side too, and as the eye sees them."""
    x, y, z = np.ptp(path_extent(runs), axis=0)
    scale = 0.86 * PAGE_WIDTH / x
    if runs[-1].is_flat:
        figure = new_figure(PAGE_WIDTH, scale * y + 0.8)
        axes = figure.subplots()
        draw_plane(axes, runs, (0, 1))
        legend_above(axes)
        return figure
    if x > 1.8 * max(y, z):
        heights = [0.42 * PAGE_WIDTH, scale * y + 0.6, scale * z + 0.6]
        figure = new_figure(PAGE_WIDTH, sum(heights) + 0.4)
        cells = [*figure.add_gridspec(3, 1, height_ratios=heights)]
    else:
        figure = new_figure(PAGE_WIDTH, 0.62 * PAGE_WIDTH)
        grid = figure.add_gridspec(2, 2, width_ratios=[1.35, 1.0])
        cells = [grid[:, 0], grid[0, 1], grid[1, 1]]
    draw_space(figure.add_subplot(cells[0]), runs)
    for cell, plane in zip(cells[1:], ((0, 1), (0, 2)), strict=True):
        axes = figure.add_subplot(cell)
        draw_plane(axes, runs, plane)
    entries = axes.get_legend_handles_labels()
    options = legend_in_a_row(entries[1])
    figure.legend(*entries, loc="outside upper left", **options)
    return figure


def draw_plane(axes: Axes, runs: Sequence[Run], plane: tuple[int, int]) -> None:
    """Draws paths and obstacles projected on two coordinates, across and up."""
    pair = list(plane)
    for wall in walls_of(runs[-1].scenario):
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
    _draw_projected(axes, runs, np.eye(3)[pair])
    low, high = (corner[pair] for corner in path_extent(runs))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=NAMES[plane[0]], ylabel=NAMES[plane[1]])


def draw_space(axes: Axes, runs: Sequence[Run]) -> None:
    """Draws paths and obstacles above a floor, seen from beside the way."""
    low, high = path_extent(runs)
    border = 0.06 * float(np.linalg.norm(high - low))
    low, high = low - border, high + border * np.array([1.0, 1.0, 0.0])
    way = runs[-1].target - runs[-1].path[0]
    view = parallel_view(float(np.rad2deg(np.arctan2(way[1], way[0]))) - 112.0, 24.0)
    _draw_floor(axes, view, low, high)
    flat = view[:2] * [1.0, 1.0, 0.0]
    lift = view[:2, 2] * low[2]
    for solid in solids_of(runs[-1].scenario):
        shadow = hull(surface(solid.body) @ flat.T + lift)
        axes.fill(*shadow.T, fc=SHADOW, lw=0, zorder=1.5)
    for run in runs:
        axes.plot(*(run.path @ flat.T + lift).T, color=SHADOW, lw=1.4, zorder=1.5)
    _draw_projected(axes, runs, view[:2])
    axes.set_aspect("equal")
    axes.set_axis_off()


def parallel_view(azimuth: float, elevation: float) -> Array:
    """The axes of an eye far away, at an azimuth and an elevation [degrees].

    Returns:
        As rows, shape (3, 3): what is drawn to the right, what upwards, what is
        towards the eye. Points, shape (..., 3), are drawn at ``points @ view[:2].T``.
    """
    a, e = np.deg2rad([azimuth, elevation])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return np.stack([right, np.cross(toward, right), toward])


def _draw_floor(axes: Axes, view: Array, low: Array, high: Array) -> None:
    """The floor of a box with lines at round coordinates, and a ruler for heights."""
    from matplotlib.ticker import MaxNLocator

    def draw(line: Array, words: str, color: str = GRID, away: float = 11.0) -> None:
        """A line with words behind its end, so many points away."""
        start, end = line @ view[:2].T
        axes.plot(*np.transpose([start, end]), color=color, lw=0.7, zorder=1)
        offset = away * (end - start) / np.linalg.norm(end - start)
        style: Style = dict(textcoords="offset points", ha="center", va="center")
        axes.annotate(words, end, offset, fontsize=8, **style)

    step = float(
        np.diff(
            MaxNLocator(10, steps=[1, 2, 5, 10]).tick_values(0.0, (high - low).max())
        )[0]
    )
    for axis, other in ((0, 1), (1, 0)):
        line = np.array([low, high] if view[2, other] > 0.0 else [high, low])
        line[:, 2], middle = low[2], 0.5 * (low + high)[axis]
        for value in multiples(low[axis], high[axis], step):
            line[:, axis] = value
            draw(line, f"{value:g}")
        line[:, axis] = middle
        draw(line, NAMES[axis], "none", away=26.0)
    pole = np.tile(np.where(view[0] > 0.0, low, high), (2, 1))  # The leftmost corner.
    pole[:, 2] = low[2], high[2]
    draw(pole, NAMES[2], MUTED)
    for height in multiples(low[2], high[2], step):
        tick = pole[0] + [0.0, 0.0, height - low[2]]
        draw(np.array([tick, tick - 0.1 * step * view[0]]), f"{height:g}", MUTED)


def _draw_projected(axes: Axes, runs: Sequence[Run], view: Array) -> None:
    """The obstacles and every run's path, its start, target and failure.

    Args:
        axes: The axes.
        runs: The runs, the one to bring out last.
        view: What is drawn to the right and upwards, shape (2, 3).
    """

    def mark(point: Array, marker: str, **style: Any) -> None:
        axes.plot(*(view @ point)[:, None], marker, mec="white", zorder=4, **style)

    end = max(float(run.time[-1]) for run in runs)
    for solid in solids_of(runs[-1].scenario):
        _draw_solid(axes, solid, view, end)
    for run in runs:
        axes.plot(*(view @ run.path.T), **run.line(), zorder=3)
        if run.failure_tick is not None:
            mark(run.path[run.failure_tick], "X", ms=8, mfc=run.color)
        if not run.ghost:
            mark(run.path[0], "o", ms=6, mfc=START)
            mark(run.target, "*", ms=11, mfc=TARGET)


def path_extent(runs: Sequence[Run]) -> tuple[Array, Array]:
    """The corners of the space that holds paths and obstacles, shape (3,) each [m]."""
    found = [each for run in runs for each in (run.target, run.path)]
    found += [solid.surface for solid in solids_of(runs[-1].scenario)]
    points = np.vstack(found)
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.03 * float((high - low).max())
    return low - room, high + room


def _draw_solid(axes: Axes, solid: Solid, view: Array, end: float) -> None:
    """An obstacle with its margin, and where it is in the end if it moves."""
    body, whole = (hull(p @ view.T) for p in (surface(solid.body), solid.surface))
    if solid.moves:
        middle = 0.5 * (body.min(axis=0) + body.max(axis=0))
        times = solid.key_times(end)
        way = np.array([middle + view @ solid.offset_at(time) for time in times])
        dashed: Style = dict(fill=False, ec=MUTED, lw=0.6, ls=(0, (3, 2)))
        axes.fill(*(whole + way[-1] - middle).T, **dashed)
        axes.plot(*way.T, color=MUTED, lw=0.8, zorder=2.5)
        arrow = dict(arrowstyle="-|>", color=MUTED, lw=0.8)
        axes.annotate("", way[-1], way[-2], arrowprops=arrow, zorder=2.5)
    if solid.keep_out is not None:
        axes.fill(*whole.T, fc=OBSTACLE, alpha=0.3, lw=0)
    style: Style = dict(fc=OBSTACLE, alpha=0.75, ec=MUTED, lw=0.6, zorder=2)
    axes.fill(*body.T, **style)
