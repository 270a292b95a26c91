"""Paths among obstacles in space, in a parallel view: what is near hides the rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.solids import hull, in_space
from vcbf_drake.viz.stage import View, set_stage
from vcbf_drake.viz.style import (
    GRID,
    MUTED,
    OBSTACLE,
    START,
    TARGET,
    Axes,
    Style,
    multiples,
)

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

FROM_THE_WAY, ELEVATION = 112.0, 24.0  # Where the eye is [degrees].
LIGHT = np.array([-0.35, -0.45, 0.82])  # Towards the light, in the world.
FLOOR, SHADOW = "#f7f8fa", "#d9dee5"
LINES = 20  # Drawn after the bodies, which hide lines by where they are.


def draw_space(axes: Axes, runs: Sequence[Run]) -> None:
    """Draws paths in space, the obstacles and their shadows, on axes without lines."""
    from scipy.spatial import ConvexHull

    stage = set_stage([run.result for run in runs])
    _, start, target = stage.tasks[-1]
    azimuth = float(np.rad2deg(np.arctan2(*(target - start)[1::-1]))) - FROM_THE_WAY
    view = parallel_view(azimuth, ELEVATION)
    floor = np.array([0.0, 0.0, stage.view.low[2]])

    def line(points: Array, **style: Any) -> None:
        axes.plot(*(points @ view[:2].T).T, **style)

    _draw_room(axes, view, stage.view)
    bodies = [ConvexHull(solid.body.surface) for solid in stage.solids]
    for solid, body in zip(stage.solids, bodies, strict=True):
        shadow = in_space(hull(solid.body.surface[:, :2])) + floor
        axes.fill(*(shadow @ view[:2].T).T, fc=SHADOW, lw=0, zorder=1.5)
        _draw_body(axes, view, body)
        if solid.keep_out is not None:
            shell = hull(solid.keep_out.surface @ view[:2].T)
            style: Style = dict(fc=OBSTACLE, alpha=0.25, ec=MUTED, lw=0.6)
            axes.fill(*shell.T, **style, zorder=_order(view, solid.keep_out.surface))
    for run in runs:
        line(run.path * [1.0, 1.0, 0.0] + floor, color=SHADOW, lw=1.4, zorder=2)
        behind = np.zeros(len(run.path), dtype=bool)
        for body in bodies:
            behind |= hidden(run.path, body, view)
        for part, alpha in ((~behind, 1.0), (behind, 0.25)):
            shown = np.where(part[:, None], run.path, np.nan)
            line(shown, **run.line(lw=1.8, alpha=alpha, zorder=LINES))
        if run.failure_tick is not None:
            style = dict(marker="X", ms=9, mfc=run.color, mec="white", zorder=LINES + 1)
            line(run.path[run.failure_tick], **style)
    for _, start, target in stage.tasks:
        line(start, marker="o", ms=6, color=START, zorder=LINES + 1)
        line(target, marker="*", ms=12, mfc=TARGET, mec="white", zorder=LINES + 1)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.autoscale_view()


def parallel_view(azimuth: float, elevation: float) -> Array:
    """The axes of an eye far away, at an azimuth and an elevation [degrees].

    Returns:
        As rows, shape (3, 3): what is drawn to the right, what upwards, what is
        towards the eye. Points, shape (..., 3), are drawn at ``points @ view[:2].T``.
    """
    a, e = np.deg2rad([azimuth, elevation])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return np.stack([right, np.cross(toward, right), toward])


def hidden(points: Array, body: ConvexHull, view: Array) -> NDArray[np.bool_]:
    """Which points, shape (n, 3), a body hides, shape (n,)."""
    # Towards the eye a point enters the body through some faces, leaves by others.
    outside = points @ body.equations[:, :3].T + body.equations[:, 3]
    rate = body.equations[:, :3] @ view[2]
    enters, leaves = rate < -1e-12, rate > 1e-12
    first = np.max(-outside[:, enters] / rate[enters], axis=1, initial=0.0)
    last = np.min(-outside[:, leaves] / rate[leaves], axis=1, initial=np.inf)
    along = np.all(outside[:, ~(enters | leaves)] <= 0.0, axis=1)
    found: NDArray[np.bool_] = (first < last) & along
    return found


def _draw_room(axes: Axes, view: Array, room: View) -> None:
    """The floor with lines at round coordinates, their numbers, a ruler for heights."""

    def write(place: Array, words: str, offset: Any, **style: Any) -> None:
        style |= dict(xytext=offset, textcoords="offset points", fontsize=8)
        axes.annotate(words, place @ view[:2].T, **style)

    (x0, y0, z), (x1, y1) = room.low, room.high[:2]
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    axes.fill(*(corners @ view[:2].T).T, fc=FLOOR, ec=GRID, lw=0.8, zorder=1)
    for axis, name in enumerate(("x [m]", "y [m]")):
        # Numbers stand at the nearer one of two edges, or where both are as near, at
        # the right one.
        other = 1 - axis
        right, _, nearer = view[:, other]
        below = abs(nearer) >= abs(right)
        end = int((nearer if below else right) > 0.0)
        style = dict(ha="center", va="top") if below else dict(ha="left", va="center")
        for value in multiples(room.low[axis], room.high[axis], 2.0 * room.cell):
            line = np.array([room.low, room.high])
            line[:, axis], line[:, 2] = value, z
            axes.plot(*(line @ view[:2].T).T, color=GRID, lw=0.6, zorder=1)
            write(line[end], f"{value:g}", (0, -4) if below else (5, -2), **style)
        middle = 0.5 * (room.low + room.high)
        middle[other], middle[2] = (room.low, room.high)[end][other], z
        write(middle, name, (0, -15) if below else (36, -8), **style)
    x, y, _ = np.where(view[0] > 0.0, room.low, room.high)  # The leftmost corner.
    pole = np.array([[x, y, room.low[2]], [x, y, room.high[2]]])
    axes.plot(*(pole @ view[:2].T).T, color=MUTED, lw=0.8, zorder=1)
    for z in multiples(room.low[2], room.high[2], 2.0 * room.cell):
        place = np.array([x, y, z])
        axes.plot(*(place @ view[:2].T), "_", color=MUTED, ms=5, zorder=1)
        write(place, f"{z:g}", (-5, 0), ha="right", va="center")
    write(pole[1], "z [m]", (0, 4), ha="center", va="bottom")


def _draw_body(axes: Axes, view: Array, body: ConvexHull) -> None:
    """A convex body with light from above."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    normals, flat = body.equations[:, :3], body.points @ view[:2].T
    seen = normals @ view[2] > 0.0
    bright = 0.74 + 0.36 * normals[seen] @ LIGHT / np.linalg.norm(LIGHT)
    faces = PolyCollection(
        list(flat[body.simplices[seen]]),
        facecolors=np.clip(bright[:, None] * to_rgb(OBSTACLE), 0.0, 1.0),
        antialiaseds=False,  # Or the paper shines through between two faces.
        linewidths=0.0,
        rasterized=True,
        zorder=_order(view, body.points),
    )
    axes.add_collection(faces)
    shade = 0.8 * np.array(to_rgb(OBSTACLE))
    axes.fill(*hull(flat).T, fill=False, ec=shade, lw=0.5, zorder=faces.get_zorder())


def _order(view: Array, points: Array) -> float:
    """The drawing order of something around points, shape (n, 3)."""
    return 10.0 + float(np.mean(points @ view[2])) / 1e3
