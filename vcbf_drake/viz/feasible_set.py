"""The feasible set of a tick and the filter's choice, with their picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.safety.polytope import emptiness_certificate
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.solids import hull
from vcbf_drake.viz.style import (
    ALARM,
    INK,
    MUTED,
    PAGE_WIDTH,
    Axes,
    Figure,
    Style,
    new_figure,
)

if TYPE_CHECKING:
    from vcbf_drake.simulation.sections import InputLimits

FORBIDDEN = "#b3bcc7"
MARGIN = 0.35  # Room around the limits [share of their width].


@dataclass(frozen=True)
class FeasibleSet:
    """The feasible set ``{u : A u <= b}`` of one tick, and the choice from it.

    That of a single input is a band in the plane, for the eye.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        limits: The number of leading rows that are the input set's.
        low: The least inputs to show, shape (m,): the limits where they are finite.
        high: The greatest inputs to show, shape (m,).
        shape: The inscribed ellipsoid's matrix, shape (m, m); nan when there is none.
        center: Its centre, shape (m,).
        reference: The reference input, shape (m,).
        input: The chosen input, shape (m,).
        corners: The corners of the set between low and high, shape (k, m).
        volume: The volume barrier V_v; nan when the filter did not know it.
        decay: The factor of faster decay rates than in A and b (E69); 1 for none.
    """

    A: Array
    b: Array
    limits: int
    low: Array
    high: Array
    shape: Array
    center: Array
    reference: Array
    input: Array
    corners: Array
    volume: float
    decay: float

    @property
    def empty(self) -> bool:
        """Whether the feasible set is empty."""
        return len(self.corners) == 0

    @property
    def has_choice(self) -> bool:
        """Whether an input satisfies the rows, at faster decay rates perhaps."""
        return not self.empty or self.decay > 1.0

    @property
    def conflict(self) -> list[int]:
        """The rows that exclude each other when the set is empty."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        certificate = emptiness_certificate(self.A * half, self.b - self.A @ middle)
        return [] if certificate is None else list(certificate.conflict)


def feasible_set_at(run: Run, time: float) -> FeasibleSet:
    """The feasible set at the last tick that is not after a time [s]."""
    tick = max(int(np.searchsorted(run.time, time + 1e-9)) - 1, 0)
    return feasible_set_of_tick(run.log, run.scenario.input_set, tick)


def moment(runs: Sequence[Run], time: float) -> str:
    """A time for a title, with the run of which it is the last feasible tick."""
    words = f"$t$ = {time:.2f} s"
    for run in runs:
        failed_at = run.result.summary["infeasible_at"]
        before = [] if failed_at is None else run.time[run.time < failed_at - 1e-9]
        if len(before) and abs(before[-1] - time) < 1e-9:
            return f"{words}, the last feasible\ntick of {run.label}"
    return words


def feasible_set_of_tick(
    log: Mapping[str, Array], limits: InputLimits, tick: int
) -> FeasibleSet:
    """The feasible set of a log's tick, counted from 0."""
    A, b = log["polytope_A"][tick], log["polytope_b"][tick]
    # At an obstacle's very centre its row is not finite; an infinite limit is none.
    finite = np.isfinite(A).all(axis=1) & np.isfinite(b)
    low, high = shown_inputs(log, limits)
    # A single input gets a second one that nothing depends on.
    flat = max(2 - len(low), 0)
    A, b = np.pad(A[finite], ((0, 0), (0, flat))), b[finite]
    low, high = (
        np.pad(e, (0, flat), constant_values=v) for e, v in ((low, -1.0), (high, 1.0))
    )
    shape = np.pad(log["ellipsoid_shape"][tick], (0, flat))
    shape[len(shape) - flat :, len(shape) - flat :] = 1.0
    center, reference, chosen = (
        np.pad(log[name][tick], (0, flat))
        for name in ("ellipsoid_center", "reference", "input")
    )
    return FeasibleSet(
        A,
        b,
        limits=int(finite[: 2 * len(limits.lower) + len(limits.b)].sum()),
        low=low,
        high=high,
        shape=shape,
        center=center,
        reference=reference,
        input=chosen,
        corners=polytope_vertices(A, b, low, high),
        volume=float(log["volume"][tick]),
        decay=float(log["decay"][tick]) if "decay" in log else 1.0,
    )


def shadow(shape: Array) -> Array:
    """The shadow of ``{B v : |v| <= 1}`` on the plane of two inputs, of a flat one too.

    Args:
        shape: B, shape (m, m), m >= 2.

    Returns:
        L with L L' = (B B')[:2, :2], lower triangular, its diagonal not negative.
    """
    triangle: Array = np.linalg.qr(shape[:2].T)[1].T
    return triangle * np.where(np.diag(triangle) < 0.0, -1.0, 1.0)


def shown_inputs(log: Mapping[str, Array], limits: InputLimits) -> tuple[Array, Array]:
    """The least and the greatest shown inputs, shape (m,) each.

    They are the input's limits; where these are infinite, what the run asked for and
    got, with as much again on either side.
    """
    low, high = np.array(limits.lower, float), np.array(limits.upper, float)
    seen = np.vstack([log["reference"], log["input"]])
    least, most = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    room = np.maximum(most - least, 1e-3 + 0.1 * np.abs(most))
    return (
        np.where(np.isfinite(low), low, least - room),
        np.where(np.isfinite(high), high, most + room),
    )


def telling_times(runs: Sequence[Run]) -> list[float]:
    """Two seconds, the tick before the first infeasible one, and that tick [s].

    Where every run stays feasible: two seconds, the middle, and three quarters.
    """
    failures = [e.time for run in runs for e in run.events if e.kind == "infeasible"]
    if not failures:
        end = min(float(run.time[-1]) for run in runs)
        return [min(2.0, 0.25 * end), 0.5 * end, 0.75 * end]
    first = min(failures)
    period = float(runs[-1].scenario.period)
    return sorted({min(2.0, 0.5 * first), first - period, first})


def polytope_vertices(A: Array, b: Array, low: Array, high: Array) -> Array:
    """The corners of ``{u : A u <= b, low <= u <= high}``, found by Drake's Qhull.

    Rows that no point of the box violates are dropped first: among a thousand
    obstacles a few cut.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        low: The box's least corner, shape (m,), finite.
        high: Its greatest corner, shape (m,), finite.

    Returns:
        Shape (k, m), no corner twice; k is 0 when the set is empty.
    """
    # Importing Drake takes time that a table in a terminal need not spend.
    from pydrake.geometry.optimization import HPolyhedron, VPolytope

    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    scale = np.where(half > 0.0, half, 1.0)  # A fixed input has no width.
    rows, sides, box = A * scale, b - A @ middle, half / scale
    cuts = sides < np.abs(rows) @ box
    size = np.linalg.norm(rows, axis=1)
    if np.any(size[cuts] == 0.0):  # It asks for 0 < 0.
        return np.empty((0, len(low)))
    axes = np.eye(len(low))
    rows = np.vstack([axes, -axes, rows[cuts] / size[cuts, None]])
    sides = np.concatenate([box, box, sides[cuts] / size[cuts]])
    corners = VPolytope(HPolyhedron(rows, sides)).vertices().T
    return np.asarray(middle + scale * corners)


def feasible_set_figure(runs: Sequence[Run], times: Sequence[float]) -> Figure:
    """The feasible sets in the plane of the first two inputs: a row a method.

    Args:
        runs: The runs, the one to bring out last.
        times: The times, one a column [s].
    """
    size = PAGE_WIDTH / max(len(times), 2)
    figure = new_figure(PAGE_WIDTH, 0.84 * size * len(runs) + 0.6)
    panels = figure.subplots(
        len(runs), len(times), sharex=True, sharey=True, squeeze=False
    )
    names = [*runs[-1].inputs, ""]
    for row, run in enumerate(reversed(runs)):
        for axes, time in zip(panels[row], times, strict=True):
            _draw_or_tell(axes, run, time)
            if row == 0:
                axes.set_title(moment(runs, time))
            if row == len(runs) - 1:
                axes.set_xlabel(names[0])
        panels[row, 0].set_ylabel(names[1])
        panels[row, 0].annotate(run.label, (0.03, 0.95), **_CORNER, color=run.color)
    found = [zip(*a.get_legend_handles_labels(), strict=True) for a in panels.flat]
    entries = {label: handle for each in found for handle, label in each}
    style = dict(fontsize=7, columnspacing=1.2, handlelength=2.0)
    place = "outside lower center"
    figure.legend(entries.values(), entries, loc=place, ncols=6, **style)
    return figure


def draw_feasible_set(axes: Axes, chosen: FeasibleSet, color: str) -> None:
    """Draws a feasible set and the choice in the plane of the first two inputs."""
    low, high = chosen.low[:2], chosen.high[:2]
    room = MARGIN * np.where(high > low, high - low, 1.0)  # A fixed input has no range.
    view = np.stack([low - room, high + room])
    axes.set(xlim=view[:, 0], ylim=view[:, 1])
    axes.grid(False)
    limits: Style = dict(color=MUTED, lw=0.9, ls=(0, (4, 2)), zorder=2)
    (x0, y0), (x1, y1) = low, high
    box = [x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0]
    axes.plot(*box, **limits, label="input limits")
    conflict = [] if chosen.has_choice else chosen.conflict
    for row in range(chosen.limits, len(chosen.b)):
        _draw_forbidden(axes, chosen, row, view, row in conflict)
    if chosen.empty:
        middle, extent = view.mean(axis=0), view[1] - view[0]
        away = np.abs(chosen.reference[:2] - middle) / extent
        if away[0] < 0.25 and away[1] < 0.12:  # The ring would be on the word.
            middle = middle - [0.0, 0.2 * extent[1]]
        words, style = "empty", dict(color=ALARM, fontsize=12)
        if chosen.has_choice:
            words, style = "empty but for\nfaster decay", dict(color=MUTED, fontsize=8)
        style |= dict(ha="center", va="center", weight="bold", bbox=_PAPER, zorder=6)
        axes.text(*middle, words, **style)
    else:
        outline = hull(chosen.corners[:, :2]).T
        axes.fill(*outline, fc=color, alpha=0.2, lw=0, zorder=2)
        axes.fill(*outline, fill=False, ec=color, lw=1.5, zorder=3)
        if np.all(np.isfinite(chosen.shape)):
            turn = np.linspace(0.0, 2.0 * np.pi, 121)
            circle = np.stack([np.cos(turn), np.sin(turn)])
            ring = chosen.center[:2, None] + shadow(chosen.shape) @ circle
            style = dict(color=color, lw=1.0, ls=(0, (2, 1.2)), zorder=3)
            axes.plot(*ring, **style, label="largest ellipsoid")
            axes.plot(*chosen.center[:2], "+", color=color, ms=6, zorder=3)
    _draw_choice(axes, chosen, view, color)


def _draw_or_tell(axes: Axes, run: Run, time: float) -> None:
    """The set at a time with its volume, or the note that the run had ended."""
    chosen = feasible_set_at(run, time)
    draw_feasible_set(axes, chosen, run.color)
    if time > run.time[-1] + 1e-9:
        words = f"run over since {run.time[-1]:.2f} s"
    elif not chosen.empty and np.isfinite(chosen.volume):
        words = f"$V_v$ = {chosen.volume:.3g}"
    else:
        return
    axes.annotate(words, (0.97, 0.04), **(_CORNER | _LOWER_RIGHT), color=MUTED)


def _draw_forbidden(
    axes: Axes, chosen: FeasibleSet, row: int, view: Array, conflicting: bool
) -> None:
    """The inputs that one barrier excludes in every case; in red in a conflict."""
    normal, others = chosen.A[row, :2], chosen.A[row, 2:]
    least = np.minimum(others * chosen.low[2:], others * chosen.high[2:]).sum()
    bound = chosen.b[row] - least
    if np.where(normal > 0.0, view[1], view[0]) @ normal <= bound:
        return  # Nothing of what is shown.
    corners = polytope_vertices(-normal[None], np.array([-bound]), *view)
    if len(corners) < 3:
        return
    style: Style = dict(ec=FORBIDDEN, hatch="///", zorder=1.5)
    style["label"] = "forbidden by a barrier"
    if conflicting:
        style = dict(ec=ALARM, hatch="////", zorder=2.5, label="in conflict")
    axes.fill(*hull(corners).T, fc="none", lw=0.8, **style)


def _draw_choice(axes: Axes, chosen: FeasibleSet, view: Array, color: str) -> None:
    """The reference, square where it is out of view, and the chosen input."""
    inner = view + 0.03 * np.array([[1.0], [-1.0]]) * (view[1] - view[0])
    reference = np.clip(chosen.reference[:2], *inner)
    inside = bool(np.all(reference == chosen.reference[:2]))
    style: Style = dict(mfc="white", mec=INK, ms=6, mew=1.2, zorder=5)
    axes.plot(*reference, "o" if inside else "s", **style, label="reference")
    if chosen.has_choice:
        if np.isfinite(reference).all():
            arrow = dict(arrowstyle="-", color=INK, lw=0.7, shrinkA=3, shrinkB=3)
            axes.annotate("", chosen.input[:2], reference, arrowprops=arrow, zorder=4)
        style = dict(mfc=color, mec="white", ms=7, zorder=5, label="chosen input")
        axes.plot(*chosen.input[:2], "o", **style)


_PAPER = dict(boxstyle="round,pad=0.2", fc="white", ec="none", alpha=0.9)
_CORNER: Style = dict(xycoords="axes fraction", va="top", zorder=7, bbox=_PAPER)
_CORNER |= dict(fontsize=8, weight="bold")
_LOWER_RIGHT: Style = dict(ha="right", va="bottom", weight="normal", fontsize=7.5)
