"""Round tubes along paths: trails, rings, dashes; Drake has no shape for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array


@dataclass(frozen=True)
class Mesh:
    """A surface of triangles; vertices that are shared are shaded smoothly.

    Attributes:
        vertices: Shape (n, 3) [m].
        faces: Indices into the vertices, counter-clockwise from outside, shape (k, 3).
    """

    vertices: Array
    faces: NDArray[np.int32]

    def moved(self, offset: ArrayLike = 0.0, turn: ArrayLike | None = None) -> Mesh:
        """The mesh turned by a rotation matrix (3, 3), then moved by an offset (3,)."""
        rotation = np.eye(3) if turn is None else np.asarray(turn, dtype=float)
        return Mesh(self.vertices @ rotation.T + np.asarray(offset), self.faces)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        _indices(np.vstack([m.faces + s for m, s in zip(meshes, starts, strict=True)])),
    )


def tube(points: Array, radius: float, sides: int = 6) -> Mesh:
    """A round tube along a path, shape (n, 3), whose triangles follow the path."""
    tangents = _tangents(points)
    across = _carried_along(tangents)
    upward = np.cross(tangents, across)
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[:, None]
    ring = np.cos(angle) * across[:, None] + np.sin(angle) * upward[:, None]
    return _lattice(points[:, None] + radius * ring)


def ring(radius: float, thickness: float, sides: int = 60) -> Mesh:
    """A ring about the x axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    circle = radius * np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    return tube(circle, thickness, 9)


def _lattice(points: Array) -> Mesh:
    """A surface through a grid of points, shape (rows, columns, 3), columns closed.

    The triangles are in the order of the rows.
    """
    rows, columns, _ = points.shape
    here = np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    beside = np.roll(here, -1, axis=1)
    above, diagonal = here + columns, beside + columns
    faces = np.stack([here, beside, above, beside, diagonal, above], axis=-1)
    return Mesh(points.reshape(-1, 3), _indices(faces.reshape(-1, 3)))


def _tangents(points: Array) -> Array:
    """Unit tangents, shape (n, 3); where the path rests, those from before."""
    steps = np.gradient(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    moving = lengths > 1e-9
    if not moving.any():
        return np.tile([1.0, 0.0, 0.0], (len(points), 1))
    latest = np.maximum.accumulate(np.where(moving, np.arange(len(points)), -1))
    latest = np.where(latest < 0, np.argmax(moving), latest)
    tangents: Array = steps[latest] / lengths[latest, None]
    return tangents


def _carried_along(tangents: Array) -> Array:
    """Unit vectors across the tangents that turn as little as they can, (n, 3)."""
    across = np.empty_like(tangents)
    latest = np.zeros(3)
    for index, tangent in enumerate(tangents):
        latest = latest - (latest @ tangent) * tangent
        if np.linalg.norm(latest) < 1e-6:  # At the start, and after a sharp corner.
            latest = np.cross(tangent, np.eye(3)[np.argmin(np.abs(tangent))])
        latest = latest / np.linalg.norm(latest)
        across[index] = latest
    return across


def _indices(values: Any) -> NDArray[np.int32]:
    return np.ascontiguousarray(values, dtype=np.int32)
