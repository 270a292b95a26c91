"""Figures over time: barriers, volume, slack, disturbance and inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.feasible_set import shown_inputs
from vcbf_drake.viz.runs import Run, barrier_unit
from vcbf_drake.viz.style import (
    ALARM,
    INK,
    MUTED,
    PAGE_WIDTH,
    Axes,
    Figure,
    Style,
    legend_above,
    new_figure,
)

BAND = "#c9d5e3"
MOST_BARRIERS = 12  # More curves than this tell nothing.


def barrier_figure(runs: Sequence[Run]) -> Figure:
    """Every barrier of the last run, and the least one of every run."""
    return _over_time(2.7, partial(draw_barriers, every=True), runs)


def volume_figure(runs: Sequence[Run]) -> Figure:
    """The volume barrier of every run."""
    return _over_time(2.5, draw_volume, runs)


def slack_figure(runs: Sequence[Run]) -> Figure:
    """The slack of the volume row of every run."""
    return _over_time(2.2, _draw_slack, runs)


def disturbance_figure(runs: Sequence[Run]) -> Figure:
    """The last run's disturbance with its estimate, and the error under its bound."""
    run = runs[-1]
    log, names = run.log, run.channels.disturbance_labels
    figure = new_figure(PAGE_WIDTH, 0.6 + 1.15 * (len(names) + 1))
    panels = figure.subplots(len(names) + 1, 1, sharex=True)
    draw_estimate_error(panels[-1], run)
    room = 0.9 * float(np.ptp(log["disturbance"], axis=0).max())
    room = room or 4.0 * float(np.median(log["error_bound"])) or 1.0
    for channel, (axes, name) in enumerate(zip(panels[:-1], names, strict=True)):
        true = log["disturbance"][:, channel]
        estimate = log["disturbance_estimate"][:, channel]
        low, high = estimate - log["error_bound"], estimate + log["error_bound"]
        axes.fill_between(
            run.time, low, high, color=BAND, lw=0, label="estimate ± error bound"
        )
        axes.plot(run.time, true, color=INK, lw=1.2, label="disturbance")
        style: Style = dict(color=run.color, lw=1.2, ls="--")
        style["label"] = f"estimate, {run.label}"
        axes.plot(run.time, estimate, **style)
        axes.set_ylabel(name)
        _time_axis(axes)
        # The bound starts at delta1; what there is to see comes later.
        middle = 0.5 * (true.max() + true.min())
        axes.set_ylim(middle - room, middle + room)
    legend_above(panels[0])
    figure.align_ylabels(panels)
    return figure


def input_figure(runs: Sequence[Run]) -> Figure:
    """The applied inputs of every run of such a vehicle, and the last reference."""
    last = runs[-1]
    names, limits = last.inputs, last.scenario.input_set
    alike = [run for run in runs if run.inputs == names]
    lower, upper = shown_inputs(last.log, limits)
    figure = new_figure(PAGE_WIDTH, 0.6 + 1.35 * len(names))
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for channel, (axes, name) in enumerate(zip(panels, names, strict=True)):
        low, high = lower[channel], upper[channel]
        for value in (limits.lower[channel], limits.upper[channel]):
            if np.isfinite(value):
                axes.axhline(value, color=ALARM, lw=0.8, ls=(0, (4, 2)))
        reference = last.log["reference"][:, channel]
        axes.plot(last.time, reference, color=MUTED, lw=0.8, label="reference")
        for run in alike:
            style = run.line(lw=1.2, drawstyle="steps-post", label=run.caption)
            axes.plot(run.time, run.log["input"][:, channel], **style)
        axes.set_ylabel(name)
        room = 0.12 * ((high - low) or 1.0)
        axes.set_ylim(low - room, high + room)
        _time_axis(axes)
    panels[0].plot([], [], color=ALARM, lw=0.8, ls=(0, (4, 2)), label="limits")
    panels[-1].set_xlabel("time [s]")
    legend_above(panels[0])
    figure.align_ylabels(panels)
    return figure


def draw_barriers(axes: Axes, runs: Sequence[Run], every: bool = False) -> None:
    """Draws the least barrier of every run, and thinly every barrier of the last."""
    last, top = runs[-1], None
    if every:
        barriers = last.log["barriers"]
        least = np.min(barriers, axis=0, initial=np.inf, where=np.isfinite(barriers))
        lowest = np.sort(np.argsort(least, kind="stable")[:MOST_BARRIERS])
        style: Style = dict(color=last.color, lw=0.6, alpha=0.45)
        axes.plot(last.time, barriers[:, lowest], **style)
        # The far obstacles' barriers leave the picture.
        top = 1.4 * max(float(np.nanmax(run.least_barrier)) for run in runs)
    unit = barrier_unit(last.scenario)
    label = "barrier $h$" + f" [{unit}]" * bool(unit)
    values = [run.least_barrier for run in runs]
    _draw_series(axes, runs, values, label, "unsafe", top, lw=2.0)


def draw_volume(axes: Axes, runs: Sequence[Run]) -> None:
    """Draws the volume barrier of every run."""
    labels = {run.scenario.volume.label for run in runs}
    is_volume = labels == {"volume"}
    name = "volume barrier" if is_volume else "; ".join(sorted(labels))
    below = r"less volume than $\xi$" if is_volume else "too little"
    values = [run.log["volume"] for run in runs]
    _draw_series(axes, runs, values, f"{name} $V_v$ [-]", below)


def draw_estimate_error(axes: Axes, run: Run) -> None:
    """Draws a run's error of the disturbance estimate and its bound, in decades."""
    log = run.log
    error = np.linalg.norm(log["disturbance"] - log["disturbance_estimate"], axis=1)
    bound, low = log["error_bound"], 0.2 * float(np.median(error))
    bottom = np.full(len(bound), 1e-3 * low)
    axes.fill_between(run.time, np.maximum(bound, bottom), bottom, color=BAND, lw=0)
    axes.plot(run.time, bound, color=MUTED, lw=0.8)
    axes.plot(run.time, error, **run.line(lw=1.0))
    if low > 0.0:
        axes.set_yscale("log")
        axes.set_ylim(low, 2.0 * float(max(error.max(), bound.max())))
    _time_axis(axes)
    axes.set(xlabel="time [s]", ylabel=r"$\Vert d - \hat d \Vert$, $\varepsilon$")


def _draw_slack(axes: Axes, runs: Sequence[Run]) -> None:
    series = [run.log["slack"] for run in runs]
    _draw_series(axes, runs, series, r"slack $\delta$ [-]")
    if not any(np.any(values) for values in series):
        axes.set_ylim(-0.25, 1.0)
        axes.annotate("exactly 0", (0.7, 0.28), xycoords="axes fraction", color=MUTED)


def _over_time(
    height: float, draw: Callable[[Axes, Sequence[Run]], None], runs: Sequence[Run]
) -> Figure:
    """A figure of one quantity, its legend above."""
    figure = new_figure(PAGE_WIDTH, height)
    axes = figure.subplots()
    draw(axes, runs)
    legend_above(axes)
    return figure


def _draw_series(
    axes: Axes,
    runs: Sequence[Run],
    series: Sequence[Array],
    label: str,
    below: str = "",
    top: float | None = None,
    **line: Any,
) -> None:
    """Draws a quantity of every run, with a cross where a run failed.

    When and how it failed stands in the legend, where no curve crosses the words. What
    is below 0 is shaded if there is a word for it; nothing above `top` is shown.
    """
    for run, values in zip(runs, series, strict=True):
        axes.plot(run.time, values, **run.line(label=run.caption, **line))
        if run.failure is not None:
            until = np.isfinite(values) & (run.time <= run.failure.time)
            style: Style = dict(marker="X", ms=8, mfc=run.color, mec="white", ls="none")
            axes.plot(run.failure.time, values[until][-1:], **style, zorder=5)
    axes.set_ylim(top=top)
    if below:
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -0.13 * (high - low)), high)
        axes.axhspan(axes.get_ylim()[0], 0.0, color=ALARM, alpha=0.07, lw=0)
        axes.axhline(0.0, color=ALARM, lw=0.8)
        place = dict(xycoords=axes.get_yaxis_transform(), textcoords="offset points")
        style = dict(color=ALARM, fontsize=7, ha="right", va="top")
        axes.annotate(below, (0.995, 0.0), (0, -2), **place, **style)
    _time_axis(axes)
    axes.set(xlabel="time [s]", ylabel=label)


def _time_axis(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.margins(x=0.01)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=10, integer=True))
