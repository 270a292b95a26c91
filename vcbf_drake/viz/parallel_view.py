"""A parallel view of space on flat axes: what is nearer hides what is behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array

LIGHT = np.array([-0.35, -0.45, 0.82])  # Towards the light, in the world.


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
