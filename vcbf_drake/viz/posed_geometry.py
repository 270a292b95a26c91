"""Bodies in Drake's SceneGraph that a system poses, for any visualiser of Drake's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    InMemoryMesh,
    MakePhongIllustrationProperties,
    PerceptionProperties,
    RenderLabel,
    SceneGraph,
)
from pydrake.geometry import Mesh as MeshShape
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from vcbf_drake.plants.mesh import Mesh, Part
from vcbf_drake.viz.replay.scene import rgba


@dataclass(frozen=True)
class Body:
    """A rigid body to show.

    Attributes:
        name: Its frame's name; one of its kind in the scene.
        parts: Its pieces, in the body frame.
        opacity: From 0, invisible, to 1.
    """

    name: str
    parts: Sequence[Part]
    opacity: float = 1.0


class PosedGeometry(LeafSystem):
    """Registers bodies with a SceneGraph and poses them.

    .. pydrake_system::

        name: PosedGeometry
        output_ports:
        - geometry_pose

    Every piece has the illustration and the perception role. A subclass implements
    `poses`; its input ports, if any, are its own.
    """

    def __init__(self, scene_graph: SceneGraph, bodies: Sequence[Body]) -> None:
        """Registers the bodies.

        Raises:
            RuntimeError: The SceneGraph refuses one.
        """
        super().__init__()
        self.source_id = scene_graph.RegisterSource()
        self.frame_ids = [
            _register(scene_graph, self.source_id, body) for body in bodies
        ]
        self.DeclareAbstractOutputPort(
            "geometry_pose",
            lambda: AbstractValue.Make(FramePoseVector()),
            self._calc_poses,
        )

    def poses(self, context: Context) -> Sequence[RigidTransform]:
        """Returns the pose of every body in the world."""
        raise NotImplementedError

    def ConnectTo(self, builder: DiagramBuilder, scene_graph: SceneGraph) -> None:
        """Connects the poses to the SceneGraph that the bodies are registered with."""
        poses = scene_graph.get_source_pose_port(self.source_id)
        builder.Connect(self.GetOutputPort("geometry_pose"), poses)

    def _calc_poses(self, context: Context, output: AbstractValue) -> None:
        poses = FramePoseVector()
        for frame, pose in zip(self.frame_ids, self.poses(context), strict=True):
            poses.set_value(frame, pose)
        output.set_value(poses)


def _register(scene_graph: SceneGraph, source: object, body: Body) -> object:
    frame = scene_graph.RegisterFrame(source, GeometryFrame(body.name))
    for part in body.parts:
        color = rgba(part.color, body.opacity)
        instance = GeometryInstance(
            RigidTransform(), _shape(part.mesh, part.name), f"{body.name}/{part.name}"
        )
        instance.set_illustration_properties(
            MakePhongIllustrationProperties(color.rgba)
        )
        perception = PerceptionProperties()
        perception.AddProperty("phong", "diffuse", color)
        perception.AddProperty("label", "id", RenderLabel.kDontCare)
        instance.set_perception_properties(perception)
        scene_graph.RegisterGeometry(source, frame, instance)
    return frame


def _shape(mesh: Mesh, name: str) -> MeshShape:
    """Returns a mesh as Drake takes it, a Wavefront file in memory."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    lines = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.vertices]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals]
    lines += [f"f {i}//{i} {j}//{j} {k}//{k}" for i, j, k in mesh.faces + 1]
    file = MemoryFile("\n".join(lines) + "\n", ".obj", name)
    return MeshShape(InMemoryMesh(mesh_file=file))
