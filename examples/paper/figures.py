"""Figures of the report: runs under several conditions, and trials counted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.figures import draw_plane, path_extent
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.series_figures import draw_estimate_error
from vcbf_drake.viz.style import (
    ALARM,
    INK,
    METHOD_STYLES,
    MUTED,
    PAGE_WIDTH,
    Style,
    legend_in_a_row,
    new_figure,
)

from .experiment import Numbers
from .words import OUTCOMES

Case = tuple[str, Sequence[Run]]
Drawer = Callable[[Any, Sequence[Run]], None]
# A condition in words, the method, and what `describe` says of its trials.
Row = tuple[str, str, Numbers]

_WIDTH = 1.25 * PAGE_WIDTH
_LEAST_HEIGHT, _MARGINS = 1.15, 0.45  # Of a row, and of what surrounds it [inch].
_LABEL_LETTERS = 20  # In a line of a label.

_OUTCOME_STYLES: dict[str, Style] = {
    "reached": dict(fc="#46566b", ec="white"),
    "timeout": dict(fc="#b4bfcc", ec="white"),
    "infeasible": dict(fc="#e58a94", ec="white"),
    "collision": dict(fc="white", ec=ALARM, hatch="////"),
    "error": dict(fc="white", ec=MUTED, hatch="..."),
}
_OUTCOME_WORDS = {"timeout": "feasible, not arrived", "error": "crashed"}


@dataclass(frozen=True)
class KnobColumn:
    """One setting that was varied alone.

    Attributes:
        label: What it is, with its unit.
        values: Its values in words, in order.
        trials: What `describe` says of the trials: for each method one a value.
    """

    label: str
    values: Sequence[str]
    trials: Mapping[str, Sequence[Numbers]]


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
    height = max(_LEAST_HEIGHT, share * (_WIDTH - 1.4) * up / across)
    figure = new_figure(_WIDTH, (height + _MARGINS) * len(cases) + 0.5)
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


def knob_figure(knobs: Sequence[KnobColumn]) -> Any:
    """The mean running time and the share that arrives, against every knob.

    Args:
        knobs: The knobs, from the left.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    figure = new_figure(_WIDTH, 4.1)
    widths = [max(len(knob.values), 3) for knob in knobs]
    panels = figure.subplots(
        2, len(knobs), squeeze=False, sharey="row", sharex="col", width_ratios=widths
    )
    for knob, (times, shares) in zip(knobs, panels.T, strict=True):
        for method, trials in knob.trials.items():
            _draw_knob(times, shares, method, trials)
        shares.set_xticks(range(len(knob.values)), knob.values, fontsize=7)
        shares.set_xlim(-0.4, len(knob.values) - 0.6)
        if len(knob.values) > 4:
            shares.tick_params(axis="x", rotation=55)
        shares.set_xlabel(fill(knob.label, _LABEL_LETTERS), fontsize=8)
    panels[0, 0].set(ylabel="mean running time [s]")
    panels[0, 0].set_ylim(bottom=0.0)
    panels[1, 0].set(ylabel="share that arrives [%]", ylim=(-4.0, 104.0))
    # Some knobs concern one method alone; the last panels need not have both.
    _add_legend(figure, panels[0])
    return figure


def _draw_knob(times: Any, shares: Any, method: str, trials: Sequence[Numbers]) -> None:
    style = METHOD_STYLES[method]
    line: Style = dict(color=style.color, lw=1.2, marker="o", ms=4, mec="white")
    if style.dashes:
        line |= dict(dashes=style.dashes)
    means = [each["mean_running_time"] for each in trials]
    places = [place for place, mean in enumerate(means) if mean is not None]
    for place in places:
        if trials[place]["interval"] is not None:
            times.vlines(place, *trials[place]["interval"], color=style.color, lw=1.2)
    times.plot(places, [means[p] for p in places], **line, label=style.label)
    shares.plot([100.0 * _share(each, "reached") for each in trials], **line)


def outcome_figure(rows: Sequence[Row]) -> Any:
    """Bars of the outcomes, and the mean running times with their intervals.

    Args:
        rows: From the top.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    from matplotlib.patches import Patch

    figure = new_figure(PAGE_WIDTH, 0.27 * len(rows) + 1.0)
    bars, times = figure.subplots(1, 2, sharey=True, width_ratios=[1.5, 1.0])
    figure.get_layout_engine().set(w_pad=0.12)  # Or 100 and 0 touch.
    for place, (_, method, trials) in enumerate(rows):
        _draw_bar(bars, place, trials)
        _draw_time(times, place, method, trials)
    bars.set_yticks(range(len(rows)), [words for words, _, _ in rows])
    for tick, (_, method, _) in zip(bars.get_yticklabels(), rows, strict=True):
        tick.set_color(METHOD_STYLES[method].color)
    bars.tick_params(axis="y", length=0)
    bars.grid(visible=False, axis="y")
    bars.set(xlim=(0.0, 100.0), xlabel="share of the trials [%]")
    bars.set_ylim(len(rows) - 0.45, -0.55)  # The first row on top.
    times.set_xlim(left=0.0)
    times.set_xlabel("mean running time [s], 95 % interval")
    handles = [
        Patch(**_OUTCOME_STYLES[each], label=_OUTCOME_WORDS.get(each, each))
        for each in OUTCOMES
        if any(trials["outcomes"].get(each) for _, _, trials in rows)
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=5)
    return figure


def _share(trials: Numbers, outcome: str) -> float:
    outcomes = trials["outcomes"]
    return float(outcomes.get(outcome, 0) / max(sum(outcomes.values()), 1))


def _draw_bar(axes: Any, place: int, trials: Numbers) -> None:
    left = 0.0
    for outcome in OUTCOMES:
        width = 100.0 * _share(trials, outcome)
        if width == 0.0:
            continue
        style = _OUTCOME_STYLES[outcome] | dict(height=0.66, lw=0.6)
        axes.barh(place, width, left=left, **style)
        if width > 5.0:
            words: Style = dict(ha="center", va="center", fontsize=7, color=INK)
            if outcome == "reached":
                words["color"] = "white"
            count = str(trials["outcomes"][outcome])
            axes.text(left + 0.5 * width, place, count, **words)
        left += width


def _draw_time(axes: Any, place: int, method: str, trials: Numbers) -> None:
    mean, color = trials["mean_running_time"], METHOD_STYLES[method].color
    if mean is None:
        return
    low, high = trials["interval"] or (mean, mean)
    axes.plot([low, high], [place, place], color=color, lw=1.6)
    axes.plot(mean, place, "o", ms=4.5, mfc=color, mec="white", mew=0.6)
