"""Drake's own controllers for a robot from a file, as in scenario files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.controllers import (
    InverseDynamicsController,
    JointStiffnessController,
    LinearQuadraticRegulator,
    PidController,
)
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource

from vcbf_drake.checks import Array, check_finite, require
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.model.interface import actuators_of
from vcbf_drake.plants.channels import channels_of
from vcbf_drake.plants.postures import Posture
from vcbf_drake.plants.robot_file import how_to_fix
from vcbf_drake.typed import Checked, NotNegative, Positive


@dataclass
class InverseDynamics(Checked):
    """Computed torque: every joint's error decays alike, for any load.

    It needs a motor at every joint and a base that does not float.

    Attributes:
        stiffness: k_p, from joint error to joint acceleration [1/s^2], one for all or
            one each.
        damping: k_d, from speed error to joint acceleration [1/s].
    """

    at_rest: ClassVar[bool] = False
    stiffness: list[Positive] = field(default_factory=lambda: [9.0])
    damping: list[Positive] = field(default_factory=lambda: [6.0])

    def check(self, plant: MultibodyPlant) -> None:
        """Checks that it suits the robot, and has as many numbers."""
        n = plant.num_velocities()
        if not is_driven(plant):
            problem = f"!InverseDynamics needs {n} motors for {n} velocities; there are"
            problem += f" {plant.num_actuators()} (!JointStiffness and !Lqr need fewer)"
            raise InvalidValueError((), problem + how_to_fix(plant))
        _check_sizes(self, ("stiffness", "damping"), n)

    def make(self, plant: MultibodyPlant, posture: Posture) -> System:
        """Returns the controller that takes a plant to a posture."""
        n = plant.num_velocities()
        law = InverseDynamicsController(
            plant,
            self.stiffness * np.ones(n),
            np.zeros(n),
            self.damping * np.ones(n),
            False,
        )
        return _steered(law, np.concatenate([posture.positions, np.zeros(n)]))


@dataclass
class JointStiffness(Checked):
    """A spring and a damper at every actuated joint, with gravity compensation.

    With joints without a motor there is no gravity compensation.

    Attributes:
        stiffness: Stiffness of the joints, one for all or one each [N m/rad].
        damping: Damping of the joints, one for all or one each [N m s/rad].
    """

    at_rest: ClassVar[bool] = False
    stiffness: list[Positive] = field(default_factory=lambda: [100.0])
    damping: list[Positive] = field(default_factory=lambda: [20.0])

    def check(self, plant: MultibodyPlant) -> None:
        """Checks that it suits the robot, and has as many numbers."""
        _check_sizes(self, ("stiffness", "damping"), plant.num_actuators())

    def make(self, plant: MultibodyPlant, posture: Posture) -> System:
        """Returns the controller that takes a plant to a posture."""
        m, wish = plant.num_actuators(), posture.positions
        stiff = self.stiffness * np.ones(m)
        damp = self.damping * np.ones(m)
        if is_driven(plant):
            law = JointStiffnessController(plant, stiff, damp)
            goal = np.concatenate([wish, np.zeros(m)])
            return _steered(law, goal)
        nq = plant.num_positions()
        choice = np.zeros((2 * m, nq + plant.num_velocities()))
        for j, actuator in enumerate(actuators_of(plant)):
            joint = actuator.joint()
            choice[j, joint.position_start()] = 1.0
            choice[m + j, nq + joint.velocity_start()] = 1.0
        law = PidController(choice, stiff, np.zeros(m), damp)
        goal = choice @ np.concatenate([wish, np.zeros(plant.num_velocities())])
        return _steered(law, goal)


@dataclass
class Lqr(Checked):
    """Drake's linear-quadratic regulator about rest at the target.

    It does not need a motor at every joint, but a start from which the linear law
    holds. It cannot hold a floating base: inner forces do not move a centre of mass.

    Attributes:
        state_weights: Q, its diagonal, (n,); empty for 1 each.
        input_weights: R, its diagonal, (m,); empty for 1 over the squared limits.
    """

    at_rest: ClassVar[bool] = True
    state_weights: list[NotNegative] = field(default_factory=list)
    input_weights: list[Positive] = field(default_factory=list)

    def check(self, plant: MultibodyPlant) -> None:
        """Checks that it suits the robot, and has as many numbers."""
        for body in map(plant.get_body, plant.GetFloatingBaseBodies()):
            problem = (
                f"!Lqr: the base {body.name()} floats, and no motor of a joint moves"
            )
            problem += " the centre of mass; take !JointStiffness for the joints,"
            problem += f" weld: {body.name()}, or a Vehicle in Python with propellers"
            raise InvalidValueError((), problem)
        names = plant.GetStateNames(add_model_instance_prefix=False)
        if len(self.state_weights):
            check_finite("state_weights", self.state_weights, names=names)
        if len(self.input_weights):
            names = [*channels_of(plant).inputs]
            check_finite("input_weights", self.input_weights, names=names)

    def make(self, plant: MultibodyPlant, posture: Posture) -> System:
        """Returns the regulator of a plant about a posture."""
        Q = self.state_weights or np.ones(plant.num_multibody_states())
        limits = np.fmin(plant.GetEffortUpperLimits(), -plant.GetEffortLowerLimits())
        limits = np.where(np.isfinite(limits), limits, 1.0)
        R = self.input_weights or limits**-2
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, posture.positions)
        port = plant.get_actuation_input_port()
        port.FixValue(context, posture.effort)
        try:
            law = LinearQuadraticRegulator(
                plant,
                context,
                np.diag(Q),
                np.diag(R),
                input_port_index=int(port.get_index()),
            )
        except RuntimeError as error:
            problem = f"!Lqr: {str(error).splitlines()[0]}"
            rule = "one for a robot that its motors can hold at the target"
            require(False, ("vehicle", "controller"), problem, rule)
        builder = DiagramBuilder()
        builder.AddNamedSystem("lqr", law)
        builder.ExportInput(law.get_input_port(), "state")
        builder.ExportOutput(law.get_output_port(), "reference")
        return builder.Build()


def is_driven(plant: MultibodyPlant) -> bool:
    """Returns whether a plant has a motor for each of its velocities."""
    n = plant.num_velocities()
    return bool(plant.num_actuators() == n == plant.num_positions())


def _check_sizes(law: object, names: Sequence[str], size: int) -> None:
    for name in names:
        values = getattr(law, name)
        rule = f"1 number for all, or {size}, one a joint"
        require(len(values) in (1, size), name, values, rule)


def _steered(law: System, goal: Array) -> System:
    """The diagram of a controller with a constant desired state."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("law", law)
    wanted = builder.AddNamedSystem("posture", ConstantVectorSource(goal))
    builder.Connect(wanted.get_output_port(), law.GetInputPort("desired_state"))
    builder.ExportInput(law.GetInputPort("estimated_state"), "state")
    builder.ExportOutput(law.get_output_port(0), "reference")
    return builder.Build()
