"""The feasible sets of three inputs as solids, at chosen times, for every method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.feasible_set import (
    FeasibleSet,
    feasible_set_at,
    moment,
    polytope_vertices,
)
from vcbf_drake.viz.figures import parallel_view
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.style import ALARM, INK, MUTED, PAGE_WIDTH, new_figure

_NAME = dict(fontsize=7, color=INK)
VIEW = parallel_view(azimuth=-62.0, elevation=22.0)
REACH = 1.25  # How far beyond the limits a reference is still drawn at its place.


def feasible_solid_figure(runs: Sequence[Run], times: Sequence[float]) -> Any:
    """The feasible sets of three inputs, each input in shares of its range.

    Args:
        runs: The runs, the one to bring out last.
        times: The times, one a column [s].

    Returns:
        The ``matplotlib.figure.Figure``.
    """
    size = PAGE_WIDTH / max(len(times), 2)
    figure = new_figure(PAGE_WIDTH, 0.9 * size * len(runs) + 0.3)
    panels = figure.subplots(len(runs), len(times), squeeze=False)
    names = runs[-1].channels.input_labels
    for row, run in enumerate(reversed(runs)):
        for axes, time in zip(panels[row], times, strict=True):
            draw_feasible_solid(axes, feasible_set_at(run, time), run.color, names)
            if row == 0:
                axes.set_title(moment(runs, time))
        style = dict(rotation=90, va="center", weight="bold", color=run.color)
        panels[row, 0].text(-2.35, 0.0, run.label, ha="center", fontsize=8, **style)
    return figure


def draw_feasible_solid(
    axes: Any, chosen: FeasibleSet, color: str, names: Sequence[str]
) -> None:
    """Draws a feasible set of three inputs in the box of the input limits.

    Args:
        axes: Flat axes; they lose their lines.
        chosen: The set and what was chosen from it.
        color: The method's colour.
        names: The inputs' names.
    """
    middle, half = 0.5 * (chosen.low + chosen.high), 0.5 * (chosen.high - chosen.low)
    box_rows, box_sides = np.vstack([np.eye(3), -np.eye(3)]), np.ones(6)
    box = polytope_vertices(box_rows, box_sides, -np.ones(3), np.ones(3))
    dashed = dict(fill=False, ec=MUTED, lw=0.6, ls=(0, (3, 2)), zorder=1)
    for _, face in polytope_faces(box_rows, box_sides, box):
        _draw_face(axes, face, **dashed)
    if chosen.empty:
        style = dict(ha="center", va="center", color=ALARM, fontsize=12, weight="bold")
        ring = _flat((chosen.reference - middle) / half)
        covered = abs(ring[0]) < 0.6 and -0.3 < ring[1] < 0.3
        axes.text(0.0, -0.5 if covered else 0.0, "empty", **style)
    else:
        rows, sides = chosen.A * half, chosen.b - chosen.A @ middle
        corners = (chosen.corners - middle) / half
        for row, face in polytope_faces(rows, sides, corners):
            _draw_side(axes, rows[row], face, color)
    _draw_choice(axes, chosen, middle, half, color)
    _name_edges(axes, chosen, names)
    axes.set(xlim=(-2.2, 1.9), ylim=(-1.75, 1.6), aspect="equal")
    axes.set_axis_off()


def polytope_faces(A: Array, b: Array, corners: Array) -> list[tuple[int, Array]]:
    """The faces of a polytope in space.

    Args:
        A: The rows, shape (n, 3).
        b: The right-hand sides, shape (n,).
        corners: Its corners, shape (k, 3).

    Returns:
        The row and the corners in order, shape (j, 3), of every face.
    """
    faces = []
    gap = np.abs(corners @ A.T - b)
    touching = gap <= 1e-7 * (np.abs(b) + np.abs(corners) @ np.abs(A).T)
    for row, normal in enumerate(A):
        face = corners[touching[:, row]]
        if len(face) < 3:
            continue
        across = np.linalg.svd(normal[None])[2][1:]
        x, y = across @ (face - face.mean(axis=0)).T
        faces.append((row, face[np.argsort(np.arctan2(y, x))]))
    return faces


def _flat(points: Array) -> Array:
    """Where points, shape (..., 3), are drawn, shape (..., 2)."""
    return np.asarray(points @ VIEW[:2].T)


def _draw_face(axes: Any, corners: Array, **style: Any) -> None:
    axes.fill(*_flat(corners).T, **style)


def _draw_side(axes: Any, normal: Array, face: Array, color: str) -> None:
    """A face, paler when it is seen from inside."""
    near = bool(normal @ VIEW[2] > 0.0)
    _draw_face(axes, face, fc=color, alpha=0.28 if near else 0.12, lw=0, zorder=2)
    edge = dict(fill=False, ec=color, lw=1.1 if near else 0.5)
    _draw_face(axes, face, **edge, zorder=3 if near else 2)


def _draw_choice(
    axes: Any, chosen: FeasibleSet, middle: Array, half: Array, color: str
) -> None:
    reference = np.clip((chosen.reference - middle) / half, -REACH, REACH)
    places = [_flat(reference)]
    if not chosen.empty:
        places.append(_flat((chosen.input - middle) / half))
        axes.plot(*np.transpose(places), color=INK, lw=0.7, zorder=4)
        axes.plot(*places[1], "o", mfc=color, mec="white", ms=7, zorder=5)
    axes.plot(*places[0], "o", mfc="white", mec=INK, ms=5.5, mew=1.2, zorder=5)


def _name_edges(axes: Any, chosen: FeasibleSet, names: Sequence[str]) -> None:
    """The name of every input along an edge of the box, its limits at the ends."""
    edges = (
        (0, np.array([[-1.0, -1.0, -1.0], [1.0, -1.0, -1.0]]), (-0.12, -0.26)),
        (1, np.array([[1.0, -1.0, -1.0], [1.0, 1.0, -1.0]]), (0.26, -0.2)),
        (2, np.array([[-1.0, -1.0, -1.0], [-1.0, -1.0, 1.0]]), (-0.5, 0.0)),
    )
    for index, edge, offset in edges:
        ends = _flat(edge) + offset
        style = dict(ha="center", va="center", fontsize=6.5, color=MUTED)
        for end, inner, value in zip(
            ends, ends[::-1], (chosen.low[index], chosen.high[index]), strict=True
        ):
            axes.text(*(0.9 * end + 0.1 * inner), f"{value:.3g}", **style)
        axes.text(*ends.mean(axis=0), names[index], **(style | _NAME))
