"""How trials ended and how long they ran, a row for each condition and method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vcbf_drake.viz.report.tally import OUTCOMES, Tally
from vcbf_drake.viz.style import (
    ALARM,
    INK,
    METHOD_STYLES,
    MUTED,
    PAGE_WIDTH,
    Style,
    new_figure,
)

Row = tuple[str, Tally]

OUTCOME_STYLES: dict[str, Style] = {
    "reached": dict(fc="#46566b", ec="white"),
    "timeout": dict(fc="#b4bfcc", ec="white"),
    "infeasible": dict(fc="#e58a94", ec="white"),
    "collision": dict(fc="white", ec=ALARM, hatch="////"),
    "error": dict(fc="white", ec=MUTED, hatch="..."),
}
OUTCOME_WORDS = {"timeout": "feasible, not arrived", "error": "crashed"}


def outcome_figure(rows: Sequence[Row]) -> Any:
    """Bars of the outcomes, and the mean running times with their intervals.

    Args:
        rows: A condition in words and what became of its trials, from the top; the
            running times are left out where no row has any.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    figure = new_figure(PAGE_WIDTH, 0.27 * len(rows) + 1.0)
    if any(tally.mean is not None for _, tally in rows):
        bars, times = figure.subplots(1, 2, sharey=True, width_ratios=[1.5, 1.0])
        figure.get_layout_engine().set(w_pad=0.12)  # Or 100 and 0 touch.
        _draw_times(times, rows)
    else:
        bars = figure.subplots()
    for place, (_, tally) in enumerate(rows):
        _draw_bar(bars, place, tally)
    bars.set_yticks(range(len(rows)), [words for words, _ in rows])
    for tick, (_, tally) in zip(bars.get_yticklabels(), rows, strict=True):
        tick.set_color(METHOD_STYLES[tally.method].color)
    bars.tick_params(axis="y", length=0)
    bars.grid(visible=False, axis="y")
    bars.set(xlim=(0.0, 100.0), xlabel="share of the trials [%]")
    bars.set_ylim(len(rows) - 0.45, -0.55)  # The first row on top.
    figure.legend(handles=_legend(rows), loc="outside upper left", ncols=5)
    return figure


def _draw_bar(axes: Any, place: int, tally: Tally) -> None:
    left = 0.0
    for outcome in OUTCOMES:
        width = 100.0 * tally.share(outcome)
        if width == 0.0:
            continue
        style = OUTCOME_STYLES[outcome] | dict(height=0.66, lw=0.6)
        axes.barh(place, width, left=left, **style)
        if width > 5.0:
            words: Style = dict(ha="center", va="center", fontsize=7, color=INK)
            if outcome == "reached":
                words["color"] = "white"
            axes.text(left + 0.5 * width, place, str(tally.count(outcome)), **words)
        left += width


def _draw_times(axes: Any, rows: Sequence[Row]) -> None:
    for place, (_, tally) in enumerate(rows):
        if tally.mean is None:
            continue
        color = METHOD_STYLES[tally.method].color
        low, high = tally.interval or (tally.mean, tally.mean)
        axes.plot([low, high], [place, place], color=color, lw=1.6)
        axes.plot(tally.mean, place, "o", ms=4.5, mfc=color, mec="white", mew=0.6)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("mean running time [s], 95 % interval")


def _legend(rows: Sequence[Row]) -> list[Any]:
    from matplotlib.patches import Patch

    return [
        Patch(**OUTCOME_STYLES[each], label=OUTCOME_WORDS.get(each, each))
        for each in OUTCOMES
        if any(tally.count(each) for _, tally in rows)
    ]
