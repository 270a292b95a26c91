"""A vehicle in Drake's SceneGraph, as QuadrotorGeometry shows Drake's quadrotor."""

from __future__ import annotations

from collections.abc import Sequence

from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from vcbf_drake.plants.vehicle import Vehicle
from vcbf_drake.viz.posed_geometry import Body, PosedGeometry

BLUE = "#0072b2"


class VehicleGeometry(PosedGeometry):
    """Shows a vehicle where its state says that it is.

    .. pydrake_system::

        name: VehicleGeometry
        input_ports:
        - state
        output_ports:
        - geometry_pose
    """

    def __init__(
        self, scene_graph: SceneGraph, vehicle: Vehicle, name: str, color: str = BLUE
    ) -> None:
        """Registers the vehicle.

        Args:
            scene_graph: Where to.
            vehicle: Whose geometry and pose it has.
            name: The frame's name; give each vehicle its own.
            color: A hexadecimal colour.
        """
        super().__init__(scene_graph, [Body(name, vehicle.geometry(color))])
        size = vehicle.make_plant().GetOutputPort("state").size()
        self._vehicle = vehicle
        self._state = self.DeclareVectorInputPort("state", size)

    def poses(self, context: Context) -> Sequence[RigidTransform]:
        """Returns the vehicle's pose."""
        return [self._vehicle.pose(self._state.Eval(context))]

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        vehicle: Vehicle,
        state_port: OutputPort,
        scene_graph: SceneGraph,
        name: str,
        color: str = BLUE,
    ) -> VehicleGeometry:
        """Adds a vehicle's geometry and connects it to its state and the SceneGraph.

        Args:
            builder: Holds the plant and the SceneGraph.
            vehicle: Whose geometry and pose it has.
            state_port: The vehicle's state.
            scene_graph: What to register with.
            name: The frame's name; give each vehicle its own.
            color: A hexadecimal colour.
        """
        geometry = VehicleGeometry(scene_graph, vehicle, name, color)
        builder.AddNamedSystem(f"{name}_geometry", geometry)
        builder.Connect(state_port, geometry.get_input_port())
        geometry.ConnectTo(builder, scene_graph)
        return geometry
