"""The inputs that the filter may choose from, at chosen times, for every method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.feasible_set import (
    FeasibleSet,
    feasible_set_at,
    in_plane,
    moment,
    polytope_vertices,
    shadow,
)
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.solids import hull
from vcbf_drake.viz.style import ALARM, INK, MUTED, PAGE_WIDTH, Style, new_figure

MARGIN = 0.35  # Room around the limits [share of their width].


def feasible_set_figure(runs: Sequence[Run], times: Sequence[float]) -> Any:
    """The feasible sets in the plane of the first two inputs: a row a method.

    Args:
        runs: The runs, the one to bring out last.
        times: The times, one a column [s].

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    size = PAGE_WIDTH / max(len(times), 2)
    figure = new_figure(PAGE_WIDTH, 0.84 * size * len(runs) + 0.6)
    panels = figure.subplots(
        len(runs), len(times), sharex=True, sharey=True, squeeze=False
    )
    names = [*runs[-1].channels.input_labels, ""]
    for row, run in enumerate(reversed(runs)):
        for axes, time in zip(panels[row], times, strict=True):
            _draw_or_tell(axes, run, time)
            if row == 0:
                axes.set_title(moment(runs, time))
            if row == len(runs) - 1:
                axes.set_xlabel(names[0])
        panels[row, 0].set_ylabel(names[1])
        panels[row, 0].annotate(run.label, (0.03, 0.95), **_CORNER, color=run.color)
    style = dict(fontsize=7, columnspacing=1.2, handlelength=2.0)
    figure.legend(
        handles=_legend_handles(), loc="outside lower center", ncols=6, **style
    )
    return figure


def draw_feasible_set(axes: Any, chosen: FeasibleSet, color: str) -> None:
    """Draws a feasible set in the plane of the first two inputs.

    Args:
        axes: Where to draw.
        chosen: The set and what was chosen from it.
        color: The method's colour.
    """
    from matplotlib.patches import Polygon

    low, high = chosen.low[:2], chosen.high[:2]
    room = MARGIN * np.where(high > low, high - low, 1.0)  # A fixed input has no range.
    view = np.stack([low - room, high + room])
    axes.set(xlim=view[:, 0], ylim=view[:, 1])
    axes.grid(False)
    limits: Style = dict(fill=False, ec=MUTED, lw=0.9, ls=(0, (4, 2)), zorder=2)
    box = [low, (high[0], low[1]), high, (low[0], high[1])]
    axes.add_patch(Polygon(np.array(box), **limits))
    conflict = [] if chosen.has_choice else chosen.conflict
    for row in range(chosen.limits, len(chosen.b)):
        _draw_forbidden(axes, chosen, row, view, row in conflict)
    if chosen.empty:
        words = dict(ha="center", va="center", color=ALARM, fontsize=12, weight="bold")
        if chosen.has_choice:
            words |= dict(color=MUTED, fontsize=8)
        paper = dict(boxstyle="round,pad=0.25", fc="white", ec="none", alpha=0.85)
        middle, extent = view.mean(axis=0), view[1] - view[0]
        away = np.abs(chosen.reference[:2] - middle) / extent
        if away[0] < 0.25 and away[1] < 0.12:  # The ring would be on the word.
            middle = middle - [0.0, 0.2 * extent[1]]
        told = "empty but for\nfaster decay" if chosen.has_choice else "empty"
        axes.text(*middle, told, **words, bbox=paper, zorder=6)
    else:
        outline = hull(chosen.corners[:, :2])
        axes.add_patch(Polygon(outline, fc=color, alpha=0.2, lw=0, zorder=2))
        axes.add_patch(Polygon(outline, fill=False, ec=color, lw=1.5, zorder=3))
        _draw_ellipse(axes, chosen, color)
    _draw_choice(axes, chosen, view, color)


def _draw_or_tell(axes: Any, run: Run, time: float) -> None:
    """The set at a time with its volume, or that the run was over by then."""
    chosen = in_plane(feasible_set_at(run, time))
    draw_feasible_set(axes, chosen, run.color)
    if time > run.time[-1] + 1e-9:
        words = f"run over since {run.time[-1]:.2f} s"
    elif not chosen.empty and np.isfinite(chosen.volume):
        words = f"$V_v$ = {chosen.volume:.3f}"
    else:
        return
    axes.annotate(words, (0.97, 0.04), **(_CORNER | _LOWER_RIGHT), color=MUTED)


def _draw_forbidden(
    axes: Any, chosen: FeasibleSet, row: int, view: Array, conflicting: bool
) -> None:
    """What one barrier forbids, whatever the other inputs are: hatched.

    In red when it is part of a conflict.
    """
    from matplotlib.patches import Polygon

    normal, others = chosen.A[row, :2], chosen.A[row, 2:]
    least = np.minimum(others * chosen.low[2:], others * chosen.high[2:]).sum()
    bound = chosen.b[row] - least
    if np.where(normal > 0.0, view[1], view[0]) @ normal <= bound:
        return  # Nothing of what is shown.
    corners = polytope_vertices(-normal[None], np.array([-bound]), *view)
    if len(corners) < 3:
        return
    color = ALARM if conflicting else "#b3bcc7"
    style: Style = dict(
        fc="none", ec=color, hatch="////" if conflicting else "///", lw=0.8
    )
    axes.add_patch(Polygon(hull(corners), **style, zorder=1.5 + conflicting))


def _draw_ellipse(axes: Any, chosen: FeasibleSet, color: str) -> None:
    if not np.all(np.isfinite(chosen.shape)):
        return
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    ring = chosen.center[:2, None] + shadow(chosen.shape) @ [
        np.cos(angle),
        np.sin(angle),
    ]
    axes.plot(*ring, color=color, lw=1.0, ls=(0, (2, 1.2)), zorder=3)
    axes.plot(*chosen.center[:2], "+", color=color, ms=6, zorder=3)


def _draw_choice(axes: Any, chosen: FeasibleSet, view: Array, color: str) -> None:
    """The reference, square where it is out of view, and the chosen input.

    A reference that is not finite has no place in it.
    """
    inner = view + 0.03 * np.array([[1.0], [-1.0]]) * (view[1] - view[0])
    reference = np.clip(chosen.reference[:2], *inner)
    inside = bool(np.all(reference == chosen.reference[:2]))
    style: Style = dict(mfc="white", mec=INK, ms=6, mew=1.2, zorder=5)
    axes.plot(*reference, "o" if inside else "s", **style)
    if chosen.has_choice:
        if np.isfinite(reference).all():
            arrow = dict(arrowstyle="-", color=INK, lw=0.7, shrinkA=3, shrinkB=3)
            axes.annotate("", chosen.input[:2], reference, arrowprops=arrow, zorder=4)
        axes.plot(*chosen.input[:2], "o", mfc=color, mec="white", ms=7, zorder=5)


def _legend_handles() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    dot: Style = dict(ls="none", marker="o")
    return [
        Line2D([], [], color=MUTED, lw=0.9, ls=(0, (4, 2)), label="input limits"),
        Patch(fc="none", ec="#b3bcc7", hatch="////", label="forbidden by a barrier"),
        Patch(fc="none", ec=ALARM, hatch="////", label="in conflict"),
        Line2D([], [], color=INK, lw=1.0, ls=(0, (2, 1.2)), label="largest ellipsoid"),
        Line2D([], [], **dot, mfc="white", mec=INK, label="reference"),
        Line2D([], [], **dot, mfc=INK, mec="white", label="chosen input"),
    ]


_CORNER = dict(
    xycoords="axes fraction",
    fontsize=8,
    weight="bold",
    va="top",
    zorder=7,
    bbox=dict(boxstyle="round,pad=0.15", fc="white", ec="none", alpha=0.9),
)
_LOWER_RIGHT = dict(ha="right", va="bottom", weight="normal", fontsize=7.5)
