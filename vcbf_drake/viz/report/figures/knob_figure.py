"""The method against its own knobs: a column each, the same axes in all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

from vcbf_drake.viz.report.tally import Tally
from vcbf_drake.viz.style import METHOD_STYLES, PAGE_WIDTH, Style, new_figure

LABEL_LETTERS = 20  # In a line of a label.


@dataclass(frozen=True)
class Knob:
    """One setting that was varied alone.

    Attributes:
        label: What it is, with its unit.
        values: Its values in words, in order.
        tallies: What became of the trials: for each method one a value; None where a
            value was not tried.
        usual: The index of the value that the other experiments use; None when none is.
    """

    label: str
    values: Sequence[str]
    tallies: dict[str, Sequence[Tally | None]]
    usual: int | None = None


def knob_figure(knobs: Sequence[Knob]) -> Any:
    """The mean running time and the share that arrives, against every knob.

    Args:
        knobs: The knobs, from the left.

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    figure = new_figure(1.25 * PAGE_WIDTH, 4.1)
    widths = [max(len(knob.values), 3) for knob in knobs]
    panels = figure.subplots(
        2, len(knobs), squeeze=False, sharey="row", sharex="col", width_ratios=widths
    )
    for knob, (times, shares) in zip(knobs, panels.T, strict=True):
        for method, tallies in knob.tallies.items():
            _draw_times(times, method, tallies)
            _draw_shares(shares, method, tallies)
        shares.set_xticks(range(len(knob.values)), knob.values, fontsize=7)
        shares.set_xlim(-0.4, len(knob.values) - 0.6)
        if len(knob.values) > 4:
            shares.tick_params(axis="x", rotation=55)
        shares.set_xlabel(fill(knob.label, LABEL_LETTERS), fontsize=8)
        if knob.usual is not None:
            for axes in (times, shares):
                axes.axvspan(
                    knob.usual - 0.3, knob.usual + 0.3, color="#eef1f5", lw=0, zorder=0
                )
    panels[0, 0].set(ylabel="mean running time [s]")
    panels[0, 0].set_ylim(bottom=0.0)
    panels[1, 0].set(ylabel="share that arrives [%]", ylim=(-4.0, 104.0))
    # Some knobs concern one method alone; the last panels need not have both.
    entries = {
        label: handle
        for axes in panels[0]
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(entries.values(), entries.keys(), loc="outside upper left", ncols=4)
    return figure


def _line(method: str) -> Style:
    style = METHOD_STYLES[method]
    line: Style = dict(color=style.color, lw=1.2, marker="o", ms=4, mec="white")
    return line | (dict(dashes=style.dashes) if style.dashes else {})


def _draw_times(axes: Any, method: str, tallies: Sequence[Tally | None]) -> None:
    style = METHOD_STYLES[method]
    means = [tally.mean if tally else None for tally in tallies]
    places = [place for place, mean in enumerate(means) if mean is not None]
    for place in places:
        tally = tallies[place]
        if tally is not None and tally.interval is not None:
            axes.vlines(place, *tally.interval, color=style.color, lw=1.2)
    axes.plot(places, [means[p] for p in places], **_line(method), label=style.label)


def _draw_shares(axes: Any, method: str, tallies: Sequence[Tally | None]) -> None:
    known = [(p, 100.0 * t.share("reached")) for p, t in enumerate(tallies) if t]
    axes.plot([p for p, _ in known], [share for _, share in known], **_line(method))
