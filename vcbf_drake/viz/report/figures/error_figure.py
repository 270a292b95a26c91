"""The errors of disturbance estimates under their bounds, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.series_figures import draw_estimate_error
from vcbf_drake.viz.style import PAGE_WIDTH, new_figure


def error_figure(cases: Sequence[tuple[str, Run]]) -> Any:
    """A panel for each case, with the same axes in all.

    Args:
        cases: The condition in words and its run.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    figure = new_figure(PAGE_WIDTH, 2.4)
    panels = figure.subplots(1, len(cases), squeeze=False)[0]
    for axes, (words, run) in zip(panels, cases, strict=True):
        draw_estimate_error(axes, run)
        axes.set_title(words, loc="left")
    low = min(axes.get_ylim()[0] for axes in panels)
    high = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(low, high)
    for axes in panels[1:]:
        axes.set_ylabel("")
    return figure
