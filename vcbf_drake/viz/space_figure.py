"""Paths among obstacles in space, in a parallel view: what is near hides the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.stage import Stage, multiples, set_stage
from vcbf_drake.viz.style import (
    GRID,
    MUTED,
    OBSTACLE,
    START,
    TARGET,
    Style,
    add_circle,
)

LIGHT = np.array([-0.35, -0.45, 0.82])  # Towards the light, in the world.
FROM_THE_WAY, ELEVATION = 112.0, 24.0  # Where the eye is [degrees].
FLOOR, SHADOW = "#f7f8fa", "#d9dee5"
LINES = 20  # Drawn after the balls, which hide lines by where they are.


def draw_space(axes: Any, runs: Sequence[Run]) -> None:
    """Draws the paths of blimps in space, the obstacles and their shadows.

    Args:
        axes: Flat axes; they are framed to the picture and lose their lines.
        runs: The runs, the one to bring out last.
    """
    stage = set_stage([run.result for run in runs])
    way = stage.target - stage.start
    azimuth = float(np.rad2deg(np.arctan2(way[1], way[0]))) - FROM_THE_WAY
    view = ParallelView.from_angles(azimuth, ELEVATION)
    _draw_floor(axes, view, stage)
    _draw_height(axes, view, stage)
    _draw_shadows(axes, view, stage)
    # Of many balls each is small.
    pixels = int(np.clip(900.0 / np.sqrt(max(len(stage.spheres), 1)), 24.0, 160.0))
    for sphere in stage.spheres:
        view.draw_ball(axes, sphere.center, sphere.radius, OBSTACLE, pixels)
        if sphere.reach > sphere.radius:
            _draw_shell(axes, view, sphere.center, sphere.reach)
    for run in runs:
        _draw_path(axes, view, run, stage)
    _draw_mark(axes, view, stage.start, marker="o", ms=6, color=START)
    _draw_mark(axes, view, stage.target, marker="*", ms=12, mfc=TARGET, mec="white")
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.autoscale_view()


def _draw_path(axes: Any, view: ParallelView, run: Run, stage: Stage) -> None:
    """A path with its shadow; it is faint where an obstacle hides it."""
    path = stage.geometry.position(run.result.log["state"])
    below = path * [1.0, 1.0, 0.0] + [0.0, 0.0, stage.low[2]]
    view.draw_line(axes, below, color=SHADOW, lw=1.4, zorder=2)
    hidden = np.zeros(len(path), dtype=bool)
    for sphere in stage.spheres:
        hidden |= view.hidden(path, sphere.center, sphere.radius)
    for part, alpha in ((~hidden, 1.0), (hidden, 0.25)):
        shown = np.where(part[:, None], path, np.nan)
        view.draw_line(axes, shown, **run.line(lw=1.8, alpha=alpha, zorder=LINES))
    if run.failure_tick is not None:
        place = path[run.failure_tick]
        _draw_mark(axes, view, place, marker="X", ms=9, mfc=run.color, mec="white")


def _draw_floor(axes: Any, view: ParallelView, stage: Stage) -> None:
    """The floor with lines at round coordinates and their numbers at two edges."""
    (x0, y0, z), (x1, y1) = stage.low, stage.high[:2]
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    view.draw_face(axes, corners, fc=FLOOR, ec=GRID, lw=0.8, zorder=1)
    step = 2.0 * stage.cell
    for x in multiples(x0, x1, step):
        line = np.array([[x, y0, z], [x, y1, z]])
        view.draw_line(axes, line, color=GRID, lw=0.6, zorder=1)
        _write(axes, view, line[0], f"{x:g}", (0, -4), ha="center", va="top")
    for y in multiples(y0, y1, step):
        line = np.array([[x0, y, z], [x1, y, z]])
        view.draw_line(axes, line, color=GRID, lw=0.6, zorder=1)
        _write(axes, view, line[1], f"{y:g}", (5, -2), ha="left", va="center")
    middle = np.array([[0.5 * (x0 + x1), y0, z], [x1, 0.5 * (y0 + y1), z]])
    _write(axes, view, middle[0], "x [m]", (0, -15), ha="center", va="top")
    _write(axes, view, middle[1], "y [m]", (36, -8), ha="left", va="center")


def _draw_height(axes: Any, view: ParallelView, stage: Stage) -> None:
    """A ruler for the height at the far left corner of the floor."""
    x, y = stage.low[0], stage.high[1]
    marks = multiples(stage.low[2], stage.high[2], 2.0 * stage.cell)
    pole = np.array([[x, y, stage.low[2]], [x, y, stage.high[2]]])
    view.draw_line(axes, pole, color=MUTED, lw=0.8, zorder=1)
    for z in marks:
        place = np.array([x, y, z])
        axes.plot(*view.flat(place), "_", color=MUTED, ms=5, zorder=1)
        _write(axes, view, place, f"{z:g}", (-5, 0), ha="right", va="center")
    _write(axes, view, pole[1], "z [m]", (0, 4), ha="center", va="bottom")


def _draw_shadows(axes: Any, view: ParallelView, stage: Stage) -> None:
    """The shadows of the obstacles."""
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    for sphere in stage.spheres:
        below = np.array([*sphere.center[:2], stage.low[2]])
        corners = below + sphere.radius * ring
        view.draw_face(axes, corners, fc=SHADOW, lw=0, zorder=1.5)


def _draw_shell(axes: Any, view: ParallelView, center: Array, radius: float) -> None:
    """The distance that has to be kept, as a pale disc over the ball."""
    style: Style = dict(fc=OBSTACLE, alpha=0.25, ec=MUTED, lw=0.6)
    style["zorder"] = view.order(center)
    add_circle(axes, view.flat(center), radius, **style)


def _draw_mark(axes: Any, view: ParallelView, place: Array, **style: Any) -> None:
    axes.plot(*view.flat(place), ls="none", zorder=LINES + 1, **style)


def _write(
    axes: Any, view: ParallelView, place: Array, words: str, offset: Any, **style: Any
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

    def draw_line(self, axes: Any, points: Array, **style: Any) -> None:
        """Draws a line through points, shape (n, 3)."""
        axes.plot(*self.flat(points).T, **style)

    def draw_face(self, axes: Any, corners: Array, **style: Any) -> None:
        """Draws a plane face with corners in order, shape (n, 3)."""
        from matplotlib.patches import Polygon

        axes.add_patch(Polygon(self.flat(corners), **style))

    def hidden(self, points: Array, center: Array, radius: float) -> NDArray[np.bool_]:
        """Which points, shape (n, 3), a ball hides, shape (n,)."""
        offset = points - center
        along = offset @ self.toward
        across = np.linalg.norm(self.flat(offset), axis=-1)
        front = np.sqrt(np.clip(radius**2 - across**2, 0.0, None))
        return np.asarray((across < radius) & (along < front))

    def draw_ball(
        self, axes: Any, center: Array, radius: float, color: str, pixels: int = 160
    ) -> None:
        """Draws a ball, so many pixels wide, with light from above."""
        x, y = self.flat(center)
        axes.imshow(
            self._shaded(color, pixels),
            extent=(x - radius, x + radius, y - radius, y + radius),
            origin="lower",
            interpolation="bilinear",
            zorder=self.order(center),
        )

    def _shaded(self, color: str, pixels: int) -> Array:
        """The picture of a ball: red, green, blue and opacity, shape (k, k, 4)."""
        from matplotlib.colors import to_rgb

        side = np.linspace(-1.0, 1.0, pixels)
        x, y = np.meshgrid(side, side)
        distance = np.hypot(x, y)
        depth = np.sqrt(np.clip(1.0 - distance**2, 0.0, None))
        normal = np.stack([x, y, depth], axis=-1)
        frame = np.stack([self.right, self.up, self.toward])
        light = normal @ (frame @ LIGHT / np.linalg.norm(LIGHT))
        bright = 0.74 + 0.36 * light
        picture = np.empty((*x.shape, 4))
        picture[..., :3] = np.clip(
            bright[..., None] * np.array(to_rgb(color)), 0.0, 1.0
        )
        picture[..., 3] = np.clip((1.0 - distance) * pixels / 2.0, 0.0, 1.0)
        return picture
