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
    GeometryInstance,
    IllustrationProperties,
    InMemoryMesh,
    Mesh,
    SceneGraph,
    Shape,
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


def bounding_box(parts: Iterable[Part]) -> tuple[Array, Array]:
    """Returns the corners of a box around parts in the body frame, shape (3,) each [m].

    Unbounded shapes, such as a `HalfSpace`, are left out.
    """
    scene_graph = SceneGraph()
    source, inspector = scene_graph.RegisterSource(), scene_graph.model_inspector()
    corners = []
    for part in parts:
        instance = GeometryInstance(part.pose, part.shape, part.name)
        instance.set_illustration_properties(IllustrationProperties())
        geometry = scene_graph.RegisterAnchoredGeometry(source, instance)
        hull = inspector.GetConvexHull(geometry)  # For meshes only.
        box = inspector.GetObbInGeometryFrame(geometry)
        if hull is not None:
            inside = np.transpose([hull.vertex(i) for i in range(hull.num_vertices())])
            corners.append((part.pose @ inside).T)
        elif box is not None:
            signs = np.array(list(product((-1.0, 1.0), repeat=3)))
            inside = box.pose() @ (signs * box.half_width()).T
            corners.append((part.pose @ inside).T)
    points = np.vstack(corners or [np.zeros((1, 3))])
    return points.min(axis=0), points.max(axis=0)


def _linear(color: str) -> list[float]:
    """The linear red, green and blue of a hexadecimal sRGB colour, as in glTF."""
    channels = np.array([int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    dark, bright = channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
    linear: list[float] = np.where(channels <= 0.04045, dark, bright).round(5).tolist()
    return linear
