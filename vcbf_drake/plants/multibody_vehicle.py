"""A robot from a file: a MultibodyPlant under one of Drake's own controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
import math
from typing import Any, ClassVar

import numpy as np
from pydrake.geometry import Capsule, Rgba, Role, SceneGraph, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import System

from vcbf_drake.barriers import Barrier, StateInputLimit, StateLimit
from vcbf_drake.checks import Array, check_finite, check_parameter, require_choice
from vcbf_drake.errors import below
from vcbf_drake.model.interface import unit_quaternions
from vcbf_drake.model.multibody_parts import bodies_of, frames_of, joints_of
from vcbf_drake.model.position import Position, point_position
from vcbf_drake.plants.robot_controllers import (
    InverseDynamics,
    JointStiffness,
    Lqr,
    posture_at,
)
from vcbf_drake.plants.robot_file import RobotFile
from vcbf_drake.plants.shapes import Part
from vcbf_drake.plants.vehicle import Vehicle
from vcbf_drake.typed import Positive, check_fields

_BALL = 0.02  # The radius of the ball that marks the point in pictures [m].


@dataclass
class MultibodyVehicle(RobotFile, Vehicle):
    """A robot from a URDF or SDFormat file, on a base that is fixed or floats.

    One of Drake's own controllers takes a point of it to the target; ranges and speeds
    of the joints as the file has them are barriers, its efforts the input set.

    Attributes:
        frame: The body or frame of the point that moves to the target.
        point: Coordinates of the point in that frame [m].
        controller: Drake's controller, towards a posture with the point at the target.
        posture: Positions near which a posture is chosen if several reach the target,
            (nq,); empty for 0.1 each.
        range_gains: K of (E4, gains and decay rates) for the joints' ranges.
        speed_gain: k_1 of (E4) for their speeds [1/s].
    """

    # The new keys of values in older files.
    MOVED: ClassVar[dict[str, str]] = {
        "stiffness": "vehicle.controller.stiffness",
        "damping": "vehicle.controller.damping",
    }

    frame: str
    point: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    controller: InverseDynamics | JointStiffness | Lqr = field(
        default_factory=InverseDynamics
    )
    posture: list[float] = field(default_factory=list)
    range_gains: list[float] = field(default_factory=lambda: [10.0, 25.0])
    speed_gain: Positive = 10.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_finite("point", self.point, size=3)
        check_parameter("range_gains", self.range_gains, size=2)
        plant = self.make_plant()
        require_choice("frame", self.frame, frames_of(plant))
        with below("controller"):
            self.controller.check(plant)
        if len(self.posture):
            names = plant.GetPositionNames(add_model_instance_prefix=False)
            check_finite("posture", self.posture, names=names)

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def make_plant(self) -> MultibodyPlant:
        """Returns the robot's plant: the same one at every call."""
        return self._plant

    @cached_property
    def _plant(self) -> MultibodyPlant:
        return self.parse()

    @cached_property
    def _place(self) -> Any:
        return point_position(self._plant, self.frame, self.point)

    def position(self, x: Any) -> Any:
        """Returns the position of the point in the world."""
        return self._place(x)

    def moved(self, state: Array, offset: Array) -> Array:
        """Returns a state whose position is off by an offset; see `Vehicle`."""
        found = super().moved(state, offset)
        return unit_quaternions(found, self._plant.GetStateNames())

    def body_position(self, point: Sequence[float], frame: str = "") -> Position:
        """Returns the position of a point of one of its frames; see `Vehicle`."""
        if not frame:
            return point_position(
                self._plant, self.frame, np.add(self.point, point or [0.0] * 3)
            )
        return point_position(self._plant, frame, point or [0.0] * 3)

    def make_controller(self, target: Sequence[float]) -> System:
        """Returns Drake's controller, towards a posture with the point at the target.

        Raises:
            InvalidValueError: No posture within the joints' ranges reaches it, or the
                controller does not suit the robot.
        """
        plant, law = self._plant, self.controller
        near = self.posture or plant.num_positions() * [0.1]  # Off singularities.
        where = self.frame, self.point, target
        return law.make(plant, posture_at(plant, *where, near, law.at_rest))

    def input_limits(self) -> tuple[list[float], list[float]]:
        """Returns the file's effort limits."""
        plant = self._plant
        low, high = plant.GetEffortLowerLimits(), plant.GetEffortUpperLimits()
        return low.tolist(), high.tolist()

    def barriers(self) -> list[Barrier | StateInputLimit]:
        """Returns a barrier at each end of every joint's range, and of its speed."""
        plant, found = self._plant, []
        n = plant.num_positions()
        for i, name in enumerate(plant.GetPositionNames(False, False)):
            ends = plant.GetPositionLowerLimits()[i], plant.GetPositionUpperLimits()[i]
            if any(map(math.isfinite, ends)):
                found += StateLimit(i, *ends).barriers(self.range_gains, name)
        for i, name in enumerate(plant.GetVelocityNames(False, False)):
            ends = plant.GetVelocityLowerLimits()[i], plant.GetVelocityUpperLimits()[i]
            if any(map(math.isfinite, ends)):
                limit = StateLimit(n + i, *ends)
                found += limit.barriers([self.speed_gain], f"{name} speed")
        return [*found]

    length = 2.0 * _BALL  # The diameter of the ball that marks the point [m].

    def geometry(self, color: str) -> list[Part]:
        """Returns the file's geometry, body by body, and a ball for the point.

        A body without geometry that Drake draws is shown as rods between its joints.
        """
        scene_graph = SceneGraph()
        plant = self.parse(scene_graph)
        inspector = scene_graph.model_inspector()
        parts = [Part("point", Sphere(_BALL), color)]
        for body in bodies_of(plant):
            frame = plant.GetBodyFrameIdOrThrow(body.index())
            shown = inspector.GetGeometries(frame, Role.kIllustration)
            parts += [] if shown else _rods(plant, body, color)
            for each in shown:
                looks = inspector.GetIllustrationProperties(each)
                rgba = looks.GetPropertyOrDefault("phong", "diffuse", _NO_COLOR)
                parts.append(
                    Part(
                        f"{body.name()}/{each.get_value()}",
                        inspector.GetShape(each),
                        None if rgba == _NO_COLOR else _hexadecimal(rgba),
                        inspector.GetPoseInFrame(each),
                        body.name(),
                    )
                )
        return parts

    @cached_property
    def _context(self) -> Any:
        return self._plant.CreateDefaultContext()

    def pose(self, state: Array) -> RigidTransform:
        """Returns the point's pose, with its frame's rotation, at a state (n,)."""
        plant, context = self._plant, self._context
        plant.SetPositions(context, state[: plant.num_positions()])
        frame = plant.GetFrameByName(self.frame).CalcPoseInWorld(context)
        return frame @ RigidTransform(self.point)

    def poses(self, state: Array) -> dict[str, RigidTransform]:
        """Returns the pose of every body at the state (n,)."""
        plant, context = self._plant, self._context
        plant.SetPositions(context, state[: plant.num_positions()])
        return super().poses(state) | {
            body.name(): plant.EvalBodyPoseInWorld(context, body)
            for body in bodies_of(plant)
        }


def _rods(plant: MultibodyPlant, body: RigidBody, color: str) -> list[Part]:
    """A rod from a body's frame to every joint of a body that hangs on it."""
    rods = []
    for joint in joints_of(plant):
        if joint.parent_body().index() == body.index():
            end = joint.frame_on_parent().GetFixedPoseInBodyFrame().translation()
            length = float(np.linalg.norm(end))
            if length > _BALL:
                turn = RotationMatrix.MakeFromOneVector(end, 2)
                shape, pose = Capsule(_BALL, length), RigidTransform(turn, 0.5 * end)
                rods.append(
                    Part(f"{joint.name()}/rod", shape, color, pose, body.name())
                )
    return rods


_NO_COLOR = Rgba(0.0, 0.0, 0.0, 0.0)


def _hexadecimal(color: Rgba) -> str:
    channels = (color.r(), color.g(), color.b())
    return "#" + "".join(f"{round(255 * each):02x}" for each in channels)
