"""Drake's own controllers for a robot from a file, and the postures that they hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces_
from pydrake.solvers import Solve
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
from vcbf_drake.model.multibody_parts import (
    actuators_of,
    floating_bodies_of,
    how_to_fix,
)
from vcbf_drake.plants.controllers import StateFeedback
from vcbf_drake.plants.vehicle import channels_of
from vcbf_drake.typed import Checked, NotNegative, Positive

_TRIES = 20
_NEAR = 0.005  # The tolerance of the posture at the target [m].


class Posture(NamedTuple):
    """A posture in which a robot rests.

    Attributes:
        positions: q, shape (nq,).
        effort: The input that holds it there, shape (m,); 0 if not requested.
    """

    positions: Array
    effort: Array


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
        for body in floating_bodies_of(plant):
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
        return StateFeedback(
            lambda x: law.D() @ x + law.y0(), len(Q), plant.num_actuators()
        )


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


def posture_at(
    plant: MultibodyPlant,
    frame: str,
    point: Sequence[float],
    target: Sequence[float],
    near: Sequence[float],
    at_rest: bool,
) -> Posture:
    """Returns a posture within the joints' ranges whose point is at the target.

    It is chosen near the positions `near`, (nq,); a floating base keeps the file's
    pose. With `at_rest` the motors must be able to hold it.
    """
    kinematics = InverseKinematics(plant)
    q, program = kinematics.q(), kinematics.prog()
    goal, reach = np.array(target), 0.5 * _NEAR
    kinematics.AddPositionConstraint(
        *(plant.GetFrameByName(frame), np.array(point), plant.world_frame()),
        *(goal - reach, goal + reach),
    )
    seed = np.array(near, dtype=float)
    for body in floating_bodies_of(plant):
        base = np.arange(body.floating_positions_start(), len(q))[:7]
        base = base[: 7 if body.has_quaternion_dofs() else 6]
        seed[base] = plant.GetDefaultPositions()[base]
        program.AddBoundingBoxConstraint(seed[base], seed[base], q[base])
    program.AddQuadraticErrorCost(np.eye(len(q)), seed, q)
    u = program.NewContinuousVariables(plant.num_actuators(), "u")
    program.AddBoundingBoxConstraint(
        plant.GetEffortLowerLimits(), plant.GetEffortUpperLimits(), u
    )
    program.AddQuadraticErrorCost(1e-6 * np.eye(len(u)), np.zeros(len(u)), u)
    rule = "a place that the robot reaches within its joints' ranges"
    if at_rest:
        none = np.zeros(plant.num_velocities())
        still = _StaticBalance(plant)
        program.AddConstraint(still, none, none, np.concatenate([q, u]))
        rule += ", and where its motors can hold it"
    for guess in _guesses(plant, seed):
        solved = Solve(program, np.concatenate([guess, np.zeros(len(u))]))
        if solved.is_success():
            return Posture(solved.GetSolution(q), solved.GetSolution(u))
    raise InvalidValueError("target", f"{[*target]}; it must be {rule}")


def _guesses(plant: MultibodyPlant, seed: Array) -> Iterator[Array]:
    """The initial guesses: a posture, then seeded ones within the joints' ranges."""
    low = np.fmax(plant.GetPositionLowerLimits(), -np.pi)
    high = np.fmin(plant.GetPositionUpperLimits(), np.pi)
    yield np.clip(seed, low, high)
    random = np.random.default_rng(0)
    for _ in range(_TRIES):
        yield random.uniform(low, high)


class _StaticBalance:
    """The residual generalised forces at rest, a function of [q; u]; 0 in balance."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self._plants = {float: plant, object: plant.ToAutoDiffXd()}
        self._contexts = {
            kind: each.CreateDefaultContext() for kind, each in self._plants.items()
        }
        self._matrix = plant.MakeActuationMatrix()

    def __call__(self, q_and_u: Any) -> Any:
        kind = object if q_and_u.dtype == object else float
        plant, context = self._plants[kind], self._contexts[kind]
        q, u = np.split(q_and_u, [plant.num_positions()])
        still = np.zeros(plant.num_velocities())
        plant.SetPositionsAndVelocities(context, np.concatenate([q, still]))
        forces = MultibodyForces_[AutoDiffXd if kind is object else float](plant)
        plant.CalcForceElementsContribution(context, forces)
        return self._matrix @ u - plant.CalcInverseDynamics(context, still, forces)
