"""Drake's own controllers for a robot from a file, as a scenario file has them."""

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

from vcbf_drake.checks import check_parameter, require
from vcbf_drake.plants.postures import Posture

_FIELD = "vehicle", "controller"  # Of a scenario, for messages.


@dataclass
class InverseDynamics:
    """Computed torque: every joint's error decays alike, whatever it carries.

    It needs a motor at every joint and a base that does not float.

    Attributes:
        stiffness: How a joint's error is undone (k_p), one for all or one each [1/s^2].
        damping: How its speed is (k_d) [1/s].
    """

    at_rest: ClassVar[bool] = False
    stiffness: list[float] = field(default_factory=lambda: [9.0])
    damping: list[float] = field(default_factory=lambda: [6.0])

    def __post_init__(self) -> None:
        check_parameter("stiffness", self.stiffness, size=len(self.stiffness))
        check_parameter("damping", self.damping, size=len(self.damping))

    def make(self, plant: MultibodyPlant, posture: Posture) -> System:
        """Returns the controller that takes a plant to a posture."""
        n = plant.num_velocities()
        found = f"{plant.num_actuators()} motors for {n} velocities"
        rule = "a motor each; !JointStiffness and !Lqr need fewer"
        require(is_driven(plant), _FIELD, found, rule)
        law = InverseDynamicsController(
            plant,
            _each("stiffness", self.stiffness, n),
            np.zeros(n),
            _each("damping", self.damping, n),
            False,
        )
        return _steered(
            law,
            np.concatenate([posture.positions, np.zeros(n)]),
            "estimated_state",
            "desired_state",
        )


@dataclass
class JointStiffness:
    """A spring and a damper at every driven joint, and its gravity taken off.

    Where joints without a motor are among them, nothing is taken off.

    Attributes:
        stiffness: Of a joint, one for all or one each [N m/rad].
        damping: Of a joint, one for all or one each [N m s/rad].
    """

    at_rest: ClassVar[bool] = False
    stiffness: list[float] = field(default_factory=lambda: [100.0])
    damping: list[float] = field(default_factory=lambda: [20.0])

    def __post_init__(self) -> None:
        check_parameter("stiffness", self.stiffness, size=len(self.stiffness))
        check_parameter("damping", self.damping, size=len(self.damping))

    def make(self, plant: MultibodyPlant, posture: Posture) -> System:
        """Returns the controller that takes a plant to a posture."""
        m, wish = plant.num_actuators(), posture.positions
        stiff = _each("stiffness", self.stiffness, m)
        damp = _each("damping", self.damping, m)
        if is_driven(plant):
            law = JointStiffnessController(plant, stiff, damp)
            goal = np.concatenate([wish, np.zeros(m)])
            return _steered(law, goal, "estimated_state", "desired_state")
        nq = plant.num_positions()
        choice = np.zeros((2 * m, nq + plant.num_velocities()))
        for j, index in enumerate(plant.GetJointActuatorIndices()):
            joint = plant.get_joint_actuator(index).joint()
            choice[j, joint.position_start()] = 1.0
            choice[m + j, nq + joint.velocity_start()] = 1.0
        law = PidController(choice, stiff, np.zeros(m), damp)
        goal = choice @ np.concatenate([wish, np.zeros(plant.num_velocities())])
        return _steered(law, goal, "estimated_state", "desired_state")


@dataclass
class Lqr:
    """Drake's linear-quadratic regulator about rest at the target.

    It needs no motor at every joint, but a start from which the linear law holds, and
    no floating base.

    Attributes:
        state_weights: Q, its diagonal, (n,); empty for 1 each.
        input_weights: R, its diagonal, (m,); empty for 1 over the squared limits.
    """

    at_rest: ClassVar[bool] = True
    state_weights: list[float] = field(default_factory=list)
    input_weights: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ("state_weights", "input_weights"):
            weights = getattr(self, name)
            check_parameter(name, weights, size=len(weights), zero_allowed=True)

    def make(self, plant: MultibodyPlant, posture: Posture) -> System:
        """Returns the regulator of a plant about a posture."""
        n, m = plant.num_multibody_states(), plant.num_actuators()
        is_fixed = plant.num_positions() == plant.num_velocities()
        rule = "!JointStiffness where the base floats: its quaternion has one to spare"
        require(is_fixed, _FIELD, "!Lqr", rule)
        names = plant.GetStateNames(add_model_instance_prefix=False)
        Q = np.array(self.state_weights or np.ones(n))
        rule = f"{n} numbers, one each of {', '.join(names)}"
        require(len(Q) == n, (*_FIELD, "state_weights"), [*Q], rule)
        limits = np.fmin(plant.GetEffortUpperLimits(), -plant.GetEffortLowerLimits())
        R = np.array(
            self.input_weights or np.where(np.isfinite(limits), limits, 1) ** -2
        )
        rule = f"{m} numbers, one a motor"
        require(len(R) == m, (*_FIELD, "input_weights"), [*R], rule)
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
            require(False, _FIELD, problem, rule)
        builder = DiagramBuilder()
        builder.AddNamedSystem("lqr", law)
        builder.ExportInput(law.get_input_port(), "state")
        builder.ExportOutput(law.get_output_port(), "reference")
        return builder.Build()


RobotController = InverseDynamics | JointStiffness | Lqr


def is_driven(plant: MultibodyPlant) -> bool:
    """Returns whether a plant has a motor for each of its velocities."""
    n = plant.num_velocities()
    return bool(plant.num_actuators() == n == plant.num_positions())


def _each(name: str, values: Sequence[float], size: int) -> np.ndarray:
    """One for all, or one each."""
    rule = f"1 number, or {size}, one a joint"
    require(len(values) in (1, size), (*_FIELD, name), [*values], rule)
    return np.array(values) * np.ones(size)


def _steered(law: System, goal: np.ndarray, state: str, wish: str) -> System:
    """A controller's diagram that wants one and the same state."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("law", law)
    wanted = builder.AddNamedSystem("posture", ConstantVectorSource(goal))
    builder.Connect(wanted.get_output_port(), law.GetInputPort(wish))
    builder.ExportInput(law.GetInputPort(state), "state")
    builder.ExportOutput(law.get_output_port(0), "reference")
    return builder.Build()
