"""Triangle meshes with outward faces, made from curves and outlines."""

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

    def scaled(self, factor: ArrayLike) -> Mesh:
        """The mesh scaled by a positive factor, or by one an axis (3,)."""
        return Mesh(self.vertices * np.asarray(factor), self.faces)

    def faceted(self) -> Mesh:
        """The same surface with no vertex shared, so that its edges stay sharp."""
        vertices = self.vertices[self.faces].reshape(-1, 3)
        return Mesh(vertices, _indices(np.arange(len(vertices)).reshape(-1, 3)))


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        _indices(np.vstack([m.faces + s for m, s in zip(meshes, starts, strict=True)])),
    )


def lattice(points: Array) -> Mesh:
    """A surface through a grid of points, shape (rows, columns, 3), columns closed.

    The triangles are in the order of the rows.
    """
    rows, columns, _ = points.shape
    here = np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    beside = np.roll(here, -1, axis=1)
    above, diagonal = here + columns, beside + columns
    faces = np.stack([here, beside, above, beside, diagonal, above], axis=-1)
    return Mesh(points.reshape(-1, 3), _indices(faces.reshape(-1, 3)))


def revolve(profile: ArrayLike, sides: int = 32) -> Mesh:
    """The surface that a profile of (x, radius), x rising, sweeps about the x axis."""
    along, radius = np.asarray(profile, dtype=float).T
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    y, z = np.multiply.outer(radius, [np.cos(angle), np.sin(angle)]).swapaxes(0, 1)
    x = np.broadcast_to(along[:, None], y.shape)
    return lattice(np.stack([x, y, z], axis=-1))


def sphere(radius: float, sides: int = 36) -> Mesh:
    """A ball around the origin."""
    angle = np.linspace(0.0, np.pi, sides // 2 + 1)
    return revolve(radius * np.stack([-np.cos(angle), np.sin(angle)], axis=1), sides)


def cylinder(radius: float, height: float, sides: int = 48) -> Mesh:
    """A rounded pillar that stands on the origin."""
    edge = min(0.08 * radius, 0.2 * height)
    angle = np.linspace(0.0, 0.5 * np.pi, 6)
    rim = [
        (height - edge + edge * np.sin(a), radius - edge + edge * np.cos(a))
        for a in angle
    ]
    profile = [(0.0, radius), *rim, (height, 0.6 * radius), (height, 0.0)]
    upright = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    return revolve(profile, sides).moved(turn=upright)


def torus(radius: float, thickness: float, sides: int = 40) -> Mesh:
    """A ring about the x axis."""
    angle = np.linspace(np.pi, -np.pi, 9)
    profile = [np.cos(angle) * thickness, radius + np.sin(angle) * thickness]
    return revolve(np.stack(profile, axis=1), sides)


def prism(outline: ArrayLike, half_width: float, chamfer: float = 0.0) -> Mesh:
    """An outline in the x-z plane, given clockwise, drawn out along y.

    Args:
        outline: Shape (k, 2) [m], seen from every side of its centroid.
        half_width: Half the extent along y [m].
        chamfer: How much is taken off the edges [m].
    """
    shape = np.asarray(outline, dtype=float)
    middle = shape.mean(axis=0)
    reach = np.linalg.norm(shape - middle, axis=1).max()
    inset = 1.0 - chamfer / reach
    levels = [
        (-half_width, 0.0),
        (-half_width, inset),
        (chamfer - half_width, 1.0),
        (half_width - chamfer, 1.0),
        (half_width, inset),
        (half_width, 0.0),
    ]
    points = np.empty((len(levels), len(shape), 3))
    for row, (y, size) in enumerate(levels):
        points[row, :, 1] = y
        points[row, :, [0, 2]] = (middle + size * (shape - middle)).T
    return lattice(points).faceted()


def tube(points: Array, radius: float, sides: int = 6) -> Mesh:
    """A round tube along a path, shape (n, 3), whose triangles follow the path."""
    tangents = _tangents(points)
    across = _carried_along(tangents)
    upward = np.cross(tangents, across)
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[:, None]
    ring = np.cos(angle) * across[:, None] + np.sin(angle) * upward[:, None]
    return lattice(points[:, None] + radius * ring)


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


@dataclass(frozen=True)
class Part:
    """A piece of a vehicle.

    Attributes:
        name: The piece's name.
        mesh: Its surface in the body frame.
        color: A hexadecimal colour.
    """

    name: str
    mesh: Mesh
    color: str


def about_x(angle: float) -> Array:
    """The rotation matrix of a turn about x [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def about_z(angle: float) -> Array:
    """The rotation matrix of a turn about z [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
