"""The paths in space, from above and from the side, obstacles true to scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.solids import Solid, outline, solids_of, walls_of
from vcbf_drake.viz.space_figure import draw_space
from vcbf_drake.viz.style import (
    MUTED,
    OBSTACLE,
    PAGE_WIDTH,
    START,
    TARGET,
    Style,
    legend_above,
    legend_in_a_row,
    new_figure,
)

NAMES = ("x [m]", "y [m]", "z [m]")


def path_figure(runs: Sequence[Run]) -> Any:
    """The paths in space, from above and from the side; in the plane from above.

    Args:
        runs: The runs, the one to bring out last.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    low, high = path_extent(runs)
    x, y, z = high - low
    scale = 0.86 * PAGE_WIDTH / x
    if runs[-1].is_flat:
        figure = new_figure(PAGE_WIDTH, scale * y + 0.8)
        axes = figure.subplots()
        draw_plane(axes, runs, (0, 1))
        legend_above(axes)
    elif x > 1.8 * max(y, z):
        heights = [0.36 * PAGE_WIDTH, scale * y + 0.6, scale * z + 0.6]
        figure = new_figure(PAGE_WIDTH, sum(heights) + 0.4)
        grid = figure.add_gridspec(3, 1, height_ratios=heights)
        _draw_views(figure, runs, [grid[0], grid[1], grid[2]])
    else:
        figure = new_figure(PAGE_WIDTH, 0.62 * PAGE_WIDTH)
        grid = figure.add_gridspec(2, 2, width_ratios=[1.35, 1.0])
        _draw_views(figure, runs, [grid[:, 0], grid[0, 1], grid[1, 1]])
    return figure


def draw_plane(axes: Any, runs: Sequence[Run], plane: tuple[int, int]) -> None:
    """Draws paths and obstacles projected on two coordinates, to scale.

    Args:
        axes: Where to draw.
        runs: The runs.
        plane: The coordinates across and up.
    """
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
    axes.plot(*last.path[0, pair], "o", ms=5, color=START, zorder=4)
    axes.plot(*last.target[pair], "*", ms=11, mfc=TARGET, mec="white", zorder=4)
    low, high = (corner[pair] for corner in path_extent(runs))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=NAMES[plane[0]], ylabel=NAMES[plane[1]])


def path_extent(runs: Sequence[Run]) -> tuple[Array, Array]:
    """The corners of the space that holds paths and obstacles, shape (3,) each [m].

    Args:
        runs: The runs.
    """
    found = [runs[-1].target, *(run.path for run in runs)]
    found += [solid.whole.surface for solid in solids_of(runs[-1].scenario)]
    points = np.vstack(found)
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.03 * float((high - low).max())
    return low - room, high + room


def _draw_views(figure: Any, runs: Sequence[Run], cells: list[Any]) -> None:
    space, above, side = (figure.add_subplot(cell) for cell in cells)
    draw_space(space, runs)
    draw_plane(above, runs, (0, 1))
    draw_plane(side, runs, (0, 2))
    entries = above.get_legend_handles_labels()
    options = legend_in_a_row(entries[1])
    figure.legend(*entries, loc="outside upper left", **options)


def _draw_solid(axes: Any, solid: Solid, pair: list[int], end: float) -> None:
    """An obstacle with its margin, and where it is in the end if it moves."""
    body, whole = (outline(p.surface, pair) for p in (solid.body, solid.whole))
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
