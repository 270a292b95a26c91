"""The vehicles in Drake's SceneGraph, as QuadrotorGeometry shows Drake's quadrotor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from vcbf_drake.plants import BlimpState, CarState
from vcbf_drake.viz.posed_geometry import Body, PosedGeometry
from vcbf_drake.viz.vehicles import Part, blimp, car

BLUE = "#0072b2"


class VehicleGeometry(PosedGeometry):
    """A vehicle whose state says where it is and where it heads.

    .. pydrake_system::

        name: VehicleGeometry
        input_ports:
        - state
        output_ports:
        - geometry_pose
    """

    _view: ClassVar[Any]  # The names of its states.
    _heading: ClassVar[str]  # Which of them turns it about z.
    _parts: ClassVar[Callable[[str], list[Part]]]

    def __init__(self, scene_graph: SceneGraph, name: str, color: str = BLUE) -> None:
        """Registers the vehicle.

        Args:
            scene_graph: Where to.
            name: The frame's name; give each vehicle its own.
            color: A hexadecimal colour.
        """
        super().__init__(scene_graph, [Body(name, type(self)._parts(color))])
        size = len(self._view.get_fields())
        self._state = self.DeclareVectorInputPort("state", size)

    def poses(self, context: Context) -> Sequence[RigidTransform]:
        """Returns the vehicle's pose."""
        state = self._view(self._state.Eval(context))
        place = [state.x, state.y, getattr(state, "z", 0.0)]
        turn = RotationMatrix.MakeZRotation(getattr(state, self._heading))
        return [RigidTransform(turn, place)]

    @classmethod
    def AddToBuilder(
        cls,
        builder: DiagramBuilder,
        state_port: OutputPort,
        scene_graph: SceneGraph,
        name: str,
        color: str = BLUE,
    ) -> VehicleGeometry:
        """Adds a vehicle's geometry and connects it to its state and the SceneGraph.

        Args:
            builder: Holds the plant and the SceneGraph.
            state_port: The vehicle's state.
            scene_graph: What to register with.
            name: The frame's name; give each vehicle its own.
            color: A hexadecimal colour.
        """
        geometry = cls(scene_graph, name, color)
        builder.AddNamedSystem(f"{name}_geometry", geometry)
        builder.Connect(state_port, geometry.get_input_port())
        geometry.ConnectTo(builder, scene_graph)
        return geometry


class BlimpGeometry(VehicleGeometry):
    """Shows a `Blimp`, an airship with its envelope in a colour."""

    _view, _heading, _parts = BlimpState, "yaw", blimp


class CarGeometry(VehicleGeometry):
    """Shows a `Car`, its wheels on the ground."""

    _view, _heading, _parts = CarState, "heading", car
