"""Paths among obstacles in space, in a parallel view: what is near hides the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.solids import hull, in_space
from vcbf_drake.viz.stage import Stage, View, set_stage
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

LIGHT = np.array([-0.35, -0.45, 0.82])  # Towards the light, in the world.
FROM_THE_WAY, ELEVATION = 112.0, 24.0  # Where the eye is [degrees].
FLOOR, SHADOW = "#f7f8fa", "#d9dee5"
LINES = 20  # Drawn after the balls, which hide lines by where they are.


def draw_space(axes: Axes, runs: Sequence[Run]) -> None:
    """Draws paths in space, the obstacles and their shadows, on axes without lines."""
    stage = set_stage([run.result for run in runs])
    (_, start, target) = stage.tasks[-1]
    way = target - start
    azimuth = float(np.rad2deg(np.arctan2(way[1], way[0]))) - FROM_THE_WAY
    view = ParallelView.from_angles(azimuth, ELEVATION)
    _draw_floor(axes, view, stage.view)
    _draw_height(axes, view, stage.view)
    _draw_shadows(axes, view, stage)
    bodies = [ConvexBody.of(solid.body.surface) for solid in stage.solids]
    for solid, body in zip(stage.solids, bodies, strict=True):
        view.draw_body(axes, body, OBSTACLE)
        if solid.keep_out is not None:
            _draw_shell(axes, view, solid.keep_out.surface)
    for run in runs:
        _draw_path(axes, view, run, bodies, stage.view.low[2])
    for _, start, target in stage.tasks:
        _draw_mark(axes, view, start, marker="o", ms=6, color=START)
        _draw_mark(axes, view, target, marker="*", ms=12, mfc=TARGET, mec="white")
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.autoscale_view()


def _draw_path(
    axes: Axes, view: ParallelView, run: Run, bodies: Sequence[ConvexBody], floor: float
) -> None:
    """A path with its shadow; it is faint where an obstacle hides it."""
    below = run.path * [1.0, 1.0, 0.0] + [0.0, 0.0, floor]
    view.draw_line(axes, below, color=SHADOW, lw=1.4, zorder=2)
    hidden = np.zeros(len(run.path), dtype=bool)
    for body in bodies:
        hidden |= view.hidden(run.path, body)
    for part, alpha in ((~hidden, 1.0), (hidden, 0.25)):
        shown = np.where(part[:, None], run.path, np.nan)
        view.draw_line(axes, shown, **run.line(lw=1.8, alpha=alpha, zorder=LINES))
    if run.failure_tick is not None:
        place = run.path[run.failure_tick]
        _draw_mark(axes, view, place, marker="X", ms=9, mfc=run.color, mec="white")


def _draw_floor(axes: Axes, view: ParallelView, room: View) -> None:
    """The floor with lines at round coordinates and their numbers at two edges."""
    (x0, y0, z), (x1, y1) = room.low, room.high[:2]
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    view.draw_face(axes, corners, fc=FLOOR, ec=GRID, lw=0.8, zorder=1)
    for axis, name in enumerate(("x [m]", "y [m]")):
        # Numbers stand at the nearer one of two edges, or where both are as near, at
        # the right one.
        other = 1 - axis
        right, nearer = view.right[other], view.toward[other]
        below = abs(nearer) >= abs(right)
        end = int((nearer if below else right) > 0.0)
        style = dict(ha="center", va="top") if below else dict(ha="left", va="center")
        for value in multiples(room.low[axis], room.high[axis], 2.0 * room.cell):
            line = np.array([room.low, room.high])
            line[:, axis], line[:, 2] = value, z
            view.draw_line(axes, line, color=GRID, lw=0.6, zorder=1)
            offset = (0, -4) if below else (5, -2)
            _write(axes, view, line[end], f"{value:g}", offset, **style)
        middle = 0.5 * (room.low + room.high)
        middle[other], middle[2] = (room.low, room.high)[end][other], z
        offset = (0, -15) if below else (36, -8)
        _write(axes, view, middle, name, offset, **style)


def _draw_height(axes: Axes, view: ParallelView, room: View) -> None:
    """A ruler for the height at the floor's leftmost corner."""
    x, y, _ = np.where(view.right > 0.0, room.low, room.high)
    marks = multiples(room.low[2], room.high[2], 2.0 * room.cell)
    pole = np.array([[x, y, room.low[2]], [x, y, room.high[2]]])
    view.draw_line(axes, pole, color=MUTED, lw=0.8, zorder=1)
    for z in marks:
        place = np.array([x, y, z])
        axes.plot(*view.flat(place), "_", color=MUTED, ms=5, zorder=1)
        _write(axes, view, place, f"{z:g}", (-5, 0), ha="right", va="center")
    _write(axes, view, pole[1], "z [m]", (0, 4), ha="center", va="bottom")


def _draw_shadows(axes: Axes, view: ParallelView, stage: Stage) -> None:
    """The shadows of the obstacles."""
    for solid in stage.solids:
        shadow = in_space(hull(solid.body.surface[:, :2]))
        shadow[:, 2] = stage.view.low[2]
        view.draw_face(axes, shadow, fc=SHADOW, lw=0, zorder=1.5)


def _draw_shell(axes: Axes, view: ParallelView, surface: Array) -> None:
    """The distance that has to be kept, as a pale sheet over the obstacle."""
    style: Style = dict(alpha=0.25, ec=MUTED, lw=0.6, zorder=view.order(surface))
    axes.fill(*hull(view.flat(surface)).T, fc=OBSTACLE, **style)


def _draw_mark(axes: Axes, view: ParallelView, place: Array, **style: Any) -> None:
    axes.plot(*view.flat(place), ls="none", zorder=LINES + 1, **style)


def _write(
    axes: Axes, view: ParallelView, place: Array, words: str, offset: Any, **style: Any
) -> None:
    """Words near a place, moved by an offset [points]."""
    style = dict(xytext=offset, textcoords="offset points", fontsize=8) | style
    axes.annotate(words, view.flat(place), **style)


@dataclass(frozen=True)
class ParallelView:
    """Space seen from far away: parallel lines stay parallel, balls stay round.

    Attributes:
        right: The direction that is drawn to the right, shape (3,).
        up: The direction that is drawn upwards, shape (3,).
        toward: The direction towards the eye, shape (3,).
    """

    right: Array
    up: Array
    toward: Array

    @classmethod
    def from_angles(cls, azimuth: float, elevation: float) -> ParallelView:
        """The view of an eye at an azimuth and an elevation [degrees]."""
        a, e = np.deg2rad([azimuth, elevation])
        ahead = np.array([np.cos(a), np.sin(a), 0.0])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        toward = np.cos(e) * ahead + np.sin(e) * np.array([0.0, 0.0, 1.0])
        return cls(right, np.cross(toward, right), toward)

    def flat(self, points: Array) -> Array:
        """Where points, shape (..., 3), are drawn, shape (..., 2)."""
        flat: Array = points @ np.stack([self.right, self.up], axis=-1)
        return flat

    def order(self, points: Array) -> float:
        """The drawing order of something around points, shape (..., 3)."""
        return 10.0 + float(np.mean(points @ self.toward)) / 1e3

    def draw_line(self, axes: Axes, points: Array, **style: Any) -> None:
        """Draws a line through points, shape (n, 3)."""
        axes.plot(*self.flat(points).T, **style)

    def draw_face(self, axes: Axes, corners: Array, **style: Any) -> None:
        """Draws a plane face with corners in order, shape (n, 3)."""
        from matplotlib.patches import Polygon

        axes.add_patch(Polygon(self.flat(corners), **style))

    def hidden(self, points: Array, body: ConvexBody) -> NDArray[np.bool_]:
        """Which points, shape (n, 3), a body hides, shape (n,)."""
        flat, sheet = self.flat(points), self.flat(body.corners)
        near = (flat >= sheet.min(axis=0)) & (flat <= sheet.max(axis=0))
        hidden = np.all(near, axis=1)
        # Towards the eye a point enters the body through some faces, leaves by others.
        outside = points[hidden] @ body.normals.T - body.offsets
        rate = body.normals @ self.toward
        enters, leaves = rate < -1e-12, rate > 1e-12
        first = np.max(-outside[:, enters] / rate[enters], axis=1, initial=0.0)
        last = np.min(-outside[:, leaves] / rate[leaves], axis=1, initial=np.inf)
        along = np.all(outside[:, ~(enters | leaves)] <= 0.0, axis=1)
        hidden[hidden] = (first < last) & along
        return hidden

    def draw_body(self, axes: Axes, body: ConvexBody, color: str) -> None:
        """Draws a convex body with light from above."""
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import to_rgb

        seen = body.normals @ self.toward > 0.0
        bright = 0.74 + 0.36 * body.normals[seen] @ LIGHT / np.linalg.norm(LIGHT)
        colors = np.clip(bright[:, None] * to_rgb(color), 0.0, 1.0)
        faces = PolyCollection(
            list(self.flat(body.corners[body.faces[seen]])),
            facecolors=colors,
            antialiaseds=False,  # Or the paper shines through between two faces.
            linewidths=0.0,
            rasterized=True,
            zorder=self.order(body.corners),
        )
        axes.add_collection(faces)
        rim = hull(self.flat(body.corners))
        shade = 0.8 * np.array(to_rgb(color))
        axes.fill(*rim.T, fill=False, ec=shade, lw=0.5, zorder=faces.get_zorder())


@dataclass(frozen=True)
class ConvexBody:
    """The hull of points in space, ``{p : normals p <= offsets}``.

    Attributes:
        corners: Shape (k, 3) [m].
        faces: Triangles, as indices into the corners, shape (f, 3).
        normals: The faces', outwards, of length 1, shape (f, 3).
        offsets: Shape (f,) [m].
    """

    corners: Array
    faces: NDArray[np.int_]
    normals: Array
    offsets: Array

    @classmethod
    def of(cls, points: Array) -> ConvexBody:
        """The hull of points, shape (k, 3) [m], found by Qhull."""
        from scipy.spatial import ConvexHull

        found = ConvexHull(points)
        sides = found.equations
        return cls(points, found.simplices, sides[:, :3], -sides[:, 3])
