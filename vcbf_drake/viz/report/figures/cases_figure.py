"""The same experiment under several conditions, a row each: paths and a series."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.path_figure import draw_plane, path_extent
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.style import PAGE_WIDTH, legend_in_a_row, new_figure

Case = tuple[str, Sequence[Run]]
Drawer = Callable[[Any, Sequence[Run]], None]

WIDTH = 1.25 * PAGE_WIDTH
LEAST_HEIGHT, MARGINS = 1.15, 0.45  # Of a row, and of what surrounds it [inch].


def cases_figure(
    cases: Sequence[Case],
    plane: tuple[int, int],
    draw_series: Drawer,
    share: float = 0.5,
) -> Any:
    """Every case as a row: the paths at the left, something over time at the right.

    Args:
        cases: The condition in words and its runs, the one to bring out last.
        plane: The coordinates of the paths, across and up.
        draw_series: Draws the runs over time.
        share: The share of the width that the paths get.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    low, high = _common_extent(cases, plane)
    across, up = high - low
    height = max(LEAST_HEIGHT, share * (WIDTH - 1.4) * up / across)
    figure = new_figure(WIDTH, (height + MARGINS) * len(cases) + 0.5)
    panels = figure.subplots(
        len(cases), 2, squeeze=False, sharex="col", width_ratios=[share, 1.0 - share]
    )
    for (words, runs), (path, series) in zip(cases, panels, strict=True):
        draw_plane(path, runs, plane)
        path.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        path.set_title(words, loc="left")
        draw_series(series, runs)
    for axes in panels[:-1].flat:
        axes.set_xlabel("")
    _add_legend(figure, panels[:, 0])
    return figure


def _common_extent(
    cases: Sequence[Case], plane: tuple[int, int]
) -> tuple[Array, Array]:
    extents = np.array([path_extent(runs) for _, runs in cases])[:, :, list(plane)]
    return extents[:, 0].min(axis=0), extents[:, 1].max(axis=0)


def _add_legend(figure: Any, panels: Sequence[Any]) -> None:
    """Each label once, whatever the cases it is in."""
    entries: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    options = legend_in_a_row(list(entries))
    figure.legend(entries.values(), entries.keys(), loc="outside upper left", **options)
