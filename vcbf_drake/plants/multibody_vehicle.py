"""A robot from a file: a MultibodyPlant under Drake's inverse-dynamics controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from importlib.resources import files
import math
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.solvers import Solve
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource

from vcbf_drake.barriers import Barrier, StateInputLimit, StateLimit
from vcbf_drake.checks import Array, check_finite, check_parameter, require
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.model.position import point_position
from vcbf_drake.plants.vehicle import Vehicle

_NEAR = 0.005  # How near the target the controller's posture has to come [m].


@dataclass
class MultibodyVehicle(Vehicle):
    """A robot arm from a URDF or SDFormat file, every joint of which has a motor.

    Drake's `InverseDynamicsController` takes the point to the target; ranges and speeds
    of the joints as the file has them are barriers, its efforts the input set.

    Attributes:
        file: The URDF or SDFormat file; ``package://vcbf_drake/`` is this package.
        frame: The body or frame that carries the point which goes to the target.
        point: The point in that frame [m].
        weld: The body that is fixed to the world; empty where the file fixes one.
        stiffness: How a joint's error is undone (k_p) [1/s^2].
        damping: How its speed is (k_d) [1/s].
        range_gains: K of (E4) for the joints' ranges.
        speed_gain: k_1 of (E4) for their speeds [1/s].
    """

    file: str
    frame: str
    point: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    weld: str = ""
    stiffness: float = 9.0
    damping: float = 6.0
    range_gains: list[float] = field(default_factory=lambda: [10.0, 25.0])
    speed_gain: float = 10.0

    def __post_init__(self) -> None:
        check_finite("point", self.point, size=3)
        check_parameter("stiffness", self.stiffness)
        check_parameter("damping", self.damping)
        check_parameter("range_gains", self.range_gains, size=2)
        check_parameter("speed_gain", self.speed_gain)
        plant = self.make_plant()
        bodies = [plant.get_body(i).name() for i in _bodies(plant)]
        there = plant.HasFrameNamed(self.frame)
        require(there, "frame", self.frame, f"one of {', '.join(bodies)}")
        is_driven = plant.num_actuators() == plant.num_velocities()
        found = f"{plant.num_actuators()} motors for {plant.num_velocities()} joints"
        require(is_driven, "file", found, "a robot with a motor at every joint")

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def make_plant(self) -> MultibodyPlant:
        """Returns the robot's plant: the same one at every call."""
        return self._plant

    @cached_property
    def _plant(self) -> MultibodyPlant:
        plant = MultibodyPlant(0.0)
        parser = Parser(plant)
        parser.package_map().Add("vcbf_drake", str(files("vcbf_drake")))
        is_here = self.file.startswith("package://") or Path(self.file).is_file()
        require(is_here, "file", self.file, "a URDF or SDFormat file")
        try:
            if self.file.startswith("package://"):
                (robot,) = parser.AddModelsFromUrl(self.file)
            else:
                (robot,) = parser.AddModels(self.file)
        except (RuntimeError, ValueError) as error:
            problem = f"{self.file!r}; Drake does not read it: {error}"
            raise InvalidValueError("file", " ".join(problem.split())) from None
        if self.weld:
            bodies = [plant.get_body(i).name() for i in plant.GetBodyIndices(robot)]
            rule = f"one of {', '.join(bodies)}"
            require(self.weld in bodies, "weld", self.weld, rule)
            base = plant.GetFrameByName(self.weld, robot)
            plant.WeldFrames(plant.world_frame(), base)
        plant.Finalize()
        return plant

    @cached_property
    def _place(self) -> Any:
        return point_position(self._plant, self.frame, self.point)

    def position(self, x: Any) -> Any:
        """Returns where the point is in the world."""
        return self._place(x)

    def make_controller(self, target: Sequence[float]) -> System:
        """Returns Drake's controller, told of a posture whose point is at the target.

        Raises:
            InvalidValueError: No posture within the joints' ranges reaches it.
        """
        plant = self._plant
        q = self._posture(target)
        n = len(q)
        builder = DiagramBuilder()
        stiff, damp = n * [self.stiffness], n * [self.damping]
        law = builder.AddNamedSystem(
            "inverse_dynamics",
            InverseDynamicsController(plant, stiff, n * [0.0], damp, False),
        )
        wish = ConstantVectorSource(np.concatenate([q, np.zeros(n)]))
        wanted = builder.AddNamedSystem("posture", wish)
        builder.Connect(wanted.get_output_port(), law.get_input_port_desired_state())
        builder.ExportInput(law.get_input_port_estimated_state(), "state")
        builder.ExportOutput(law.get_output_port_control(), "reference")
        return builder.Build()

    def _posture(self, target: Sequence[float]) -> Array:
        plant, point = self._plant, np.array(self.point)
        found = InverseKinematics(plant)
        goal = np.array(target)
        found.AddPositionConstraint(
            *(plant.GetFrameByName(self.frame), point, plant.world_frame()),
            *(goal - 0.5 * _NEAR, goal + 0.5 * _NEAR),
        )
        q, prog = found.q(), found.prog()
        middle = np.zeros(len(q)) + 0.1  # Off the outstretched arm, which is singular.
        prog.AddQuadraticErrorCost(np.eye(len(q)), middle, q)
        solved = Solve(prog, middle)
        rule = "a place that the robot reaches within its joints' ranges"
        require(solved.is_success(), "target", [*target], rule)
        posture: Array = solved.GetSolution(q)
        return posture

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


def _bodies(plant: MultibodyPlant) -> list[Any]:
    """The indices of all bodies but the world."""
    return [
        index
        for instance in range(1, plant.num_model_instances())
        for index in plant.GetBodyIndices(ModelInstanceIndex(instance))
    ]
