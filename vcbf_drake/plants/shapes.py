"""Parts of a robot's body for pictures: Drake's shapes with poses and colours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import product
import json

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    InMemoryMesh,
    Mesh,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform

from vcbf_drake.checks import Array

PAINT = "paint"  # The material of a model that takes the given colour.


@dataclass(frozen=True)
class Part:
    """A piece of a robot's body.

    Attributes:
        name: The piece's name.
        shape: One of Drake's shapes: `Sphere`, `Box`, `Mesh` of a file, ...
        color: A hexadecimal colour; None for a file with colours of its own.
        pose: The pose of the shape in the body frame.
        body: The name of its body, for a robot of several; see `Vehicle.poses`.
    """

    name: str
    shape: Shape
    color: str | None = None
    pose: RigidTransform = field(default_factory=RigidTransform)
    body: str = ""


def painted_model(name: str, color: str) -> Mesh:
    """Returns a glTF model of this package, painted in a colour.

    Args:
        name: The file's name in `vcbf_drake/models`, without its ending.
        color: A hexadecimal colour.
    """
    text = (files("vcbf_drake") / "models" / f"{name}.gltf").read_text("utf-8")
    model = json.loads(text)
    for material in model["materials"]:
        if material["name"] == PAINT:
            linear = [*_linear(color), 1.0]
            material["pbrMetallicRoughness"]["baseColorFactor"] = linear
    file = MemoryFile(json.dumps(model), ".gltf", f"{name}.gltf")
    return Mesh(InMemoryMesh(mesh_file=file))


def of_body(parts: Iterable[Part], body: str = "") -> list[Part]:
    """Returns the parts that belong to a body."""
    return [part for part in parts if part.body == body]


def surface(part: Part) -> Array:
    """Returns points whose hull a part nearly is, in its body frame, shape (k, 3) [m].

    There are none of an unbounded shape, such as a `HalfSpace`.
    """
    shape, points = part.shape, np.empty((0, 3))
    if isinstance(shape, Sphere):
        points = shape.radius() * _BALL
    elif isinstance(shape, Ellipsoid):
        points = np.array([shape.a(), shape.b(), shape.c()]) * _BALL
    elif isinstance(shape, Capsule):
        end = np.array([0.0, 0.0, 0.5 * shape.length()])
        points = np.vstack([shape.radius() * _BALL + e for e in (-end, end)])
    elif isinstance(shape, Cylinder):
        end = np.array([0.0, 0.0, 0.5 * shape.length()])
        points = np.vstack([shape.radius() * CIRCLE + e for e in (-end, end)])
    elif isinstance(shape, Box):
        points = 0.5 * shape.size() * np.array([*product((-1.0, 1.0), repeat=3)])
    elif isinstance(shape, Convex | Mesh):
        hull = shape.GetConvexHull()
        points = np.array([hull.vertex(k) for k in range(hull.num_vertices())])
    return np.asarray((part.pose @ points.T).T)


def bounding_box(parts: Iterable[Part]) -> tuple[Array, Array]:
    """Returns the corners of the box around parts in the body frame, (3,) each [m]."""
    points = np.vstack([np.empty((0, 3)), *map(surface, parts)])
    points = points if len(points) else np.zeros((1, 3))
    return points.min(axis=0), points.max(axis=0)


def _linear(color: str) -> list[float]:
    """The linear red, green and blue of a hexadecimal sRGB colour, as in glTF."""
    channels = np.array([int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    dark, bright = channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
    linear: list[float] = np.where(channels <= 0.04045, dark, bright).round(5).tolist()
    return linear


def _ball() -> Array:
    """Points all over the unit sphere, its equator and meridians among them."""
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    rise = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
    turns, rises = (each.ravel() for each in np.meshgrid(turn, rise))
    around = [np.cos(turns) * np.cos(rises), np.sin(turns) * np.cos(rises)]
    return np.column_stack([*around, np.sin(rises)])


_BALL = _ball()
_ANGLE = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
CIRCLE = np.column_stack([np.cos(_ANGLE), np.sin(_ANGLE), 0.0 * _ANGLE])
