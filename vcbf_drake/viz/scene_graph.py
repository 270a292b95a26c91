"""Vehicles and obstacles in Drake's SceneGraph, for any visualiser and camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    IllustrationProperties,
    PerceptionProperties,
    RenderLabel,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, OutputPort

from vcbf_drake.barriers.shapes import Shape
from vcbf_drake.model.interface import state_port_of
from vcbf_drake.plants.shapes import Part, of_body
from vcbf_drake.plants.vehicle import Vehicle
from vcbf_drake.viz.solids import place_at, solids
from vcbf_drake.viz.style import BLUE, OBSTACLE

PILLAR_HEIGHT = 0.3  # Of an obstacle in the plane [m].


def rgba(color: str) -> Rgba:
    """Drake's colour of a hexadecimal one, of three bytes or four."""
    return Rgba(*(byte / 255.0 for byte in bytes.fromhex(color.removeprefix("#"))))


class PosedGeometry(LeafSystem):
    """Registers rigid bodies with a SceneGraph and poses them.

    Every piece has the illustration and the perception role. A subclass implements
    `poses`; its input ports, if any, are its own.

    Ports:
        geometry_pose, output: the poses, a ``FramePoseVector``.
    """

    def __init__(
        self, scene_graph: SceneGraph, bodies: Mapping[str, Sequence[Part]]
    ) -> None:
        """Registers the bodies.

        Args:
            scene_graph: The SceneGraph to register with.
            bodies: Their pieces, by the name of each one's frame, one of its kind.

        Raises:
            RuntimeError: The SceneGraph refuses one.
        """
        super().__init__()
        self.source_id = scene_graph.RegisterSource()
        self.frame_ids = []
        for name, parts in bodies.items():
            frame = scene_graph.RegisterFrame(self.source_id, GeometryFrame(name))
            self.frame_ids.append(frame)
            for part in parts:
                geometry = _geometry(f"{name}/{part.name}", part)
                scene_graph.RegisterGeometry(self.source_id, frame, geometry)
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


class VehicleGeometry(PosedGeometry):
    """Shows a vehicle at the pose of its state.

    Ports:
        state (n): the vehicle's state.
        geometry_pose, output: as for every `PosedGeometry`.
    """

    def __init__(
        self, scene_graph: SceneGraph, vehicle: Vehicle, name: str, color: str = BLUE
    ) -> None:
        """Registers the vehicle.

        Args:
            scene_graph: The SceneGraph to register with.
            vehicle: The vehicle of the geometry and the pose.
            name: The frame's name; give each vehicle its own.
            color: A hexadecimal colour.
        """
        parts = vehicle.geometry(color)
        self._bodies = list(dict.fromkeys(part.body for part in parts))
        frames = {
            f"{name}/{each}" if each else name: of_body(parts, each)
            for each in self._bodies
        }
        super().__init__(scene_graph, frames)
        size = state_port_of(vehicle.make_plant()).size()
        self._vehicle = vehicle
        self._state = self.DeclareVectorInputPort("state", size)

    def poses(self, context: Context) -> Sequence[RigidTransform]:
        """Returns the poses of the vehicle's bodies."""
        poses = self._vehicle.poses(self._state.Eval(context))
        return [poses[body] for body in self._bodies]

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        vehicle: Vehicle,
        state_port: OutputPort,
        scene_graph: SceneGraph,
        name: str,
        color: str = BLUE,
    ) -> VehicleGeometry:
        """Adds a vehicle's geometry and connects it to its state and the SceneGraph."""
        geometry = VehicleGeometry(scene_graph, vehicle, name, color)
        builder.AddNamedSystem(f"{name}_geometry", geometry)
        builder.Connect(state_port, geometry.get_input_port())
        geometry.ConnectTo(builder, scene_graph)
        return geometry


class ObstacleGeometry(PosedGeometry):
    """Shows obstacles of any shape at their positions at the context's time."""

    def __init__(
        self,
        scene_graph: SceneGraph,
        obstacles: Sequence[Shape],
        name: str = "obstacle",
        color: str = OBSTACLE,
    ) -> None:
        """Registers the obstacles, margins left out; in the plane they are pillars.

        Args:
            scene_graph: The SceneGraph to register with.
            obstacles: The obstacles to show.
            name: The name of the frames; a number is added.
            color: A hexadecimal colour.
        """
        bodies: dict[str, list[Part]] = {}
        for number, obstacle in enumerate(obstacles):
            to_frame = RigidTransform(-place_at(obstacle, 0.0))
            parts = [each.body for each in solids(obstacle, PILLAR_HEIGHT)]
            bodies[f"{name}_{number}"] = [
                Part(f"body_{i}" if i else "body", p.shape, color, to_frame @ p.pose)
                for i, p in enumerate(parts)
            ]
        super().__init__(scene_graph, bodies)
        self._obstacles = tuple(obstacles)

    def poses(self, context: Context) -> Sequence[RigidTransform]:
        """Returns every obstacle's pose."""
        time = context.get_time()
        return [RigidTransform(place_at(each, time)) for each in self._obstacles]

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        obstacles: Sequence[Shape],
        scene_graph: SceneGraph,
        name: str = "obstacle",
        color: str = OBSTACLE,
    ) -> ObstacleGeometry:
        """Adds the obstacles' geometry and connects it to the SceneGraph."""
        geometry = ObstacleGeometry(scene_graph, obstacles, name, color)
        builder.AddNamedSystem(f"{name}_geometry", geometry)
        geometry.ConnectTo(builder, scene_graph)
        return geometry


def _geometry(name: str, part: Part) -> GeometryInstance:
    """A piece for visualisers and for cameras."""
    instance = GeometryInstance(part.pose, part.shape, name)
    illustration, perception = IllustrationProperties(), PerceptionProperties()
    if part.color is not None:
        for properties in (illustration, perception):
            properties.AddProperty("phong", "diffuse", rgba(part.color))
    perception.AddProperty("label", "id", RenderLabel.kDontCare)
    instance.set_illustration_properties(illustration)
    instance.set_perception_properties(perception)
    return instance
