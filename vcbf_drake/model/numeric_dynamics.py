"""The dynamics of a System around a MultibodyPlant, in numbers and in AutoDiffXd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.autodiffutils import (
    AutoDiffXd,
    ExtractGradient,
    ExtractValue,
    InitializeAutoDiff,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    JacobianWrtVariable,
    ModelInstanceIndex,
    MultibodyForces_,
)

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.declared import declared_states
from vcbf_drake.model.symbolic_dynamics import (
    PortChoice,
    default_context,
    effort_limits_of,
    find_disturbance_port,
    find_input_port,
    vector_ports,
)


@dataclass(frozen=True)
class PortForces:
    """The generalised forces of a MultibodyPlant's two ports, tau = B u + B_d d.

    Attributes:
        input: B, shape (nv, m).
        disturbance: B_d, shape (nv, q).
    """

    input: Array
    disturbance: Array


@dataclass(frozen=True)
class NumericDynamics:
    """A System whose continuous state is a MultibodyPlant's, with two of its ports.

    Attributes:
        system: The MultibodyPlant, or a Diagram with it.
        plant: The MultibodyPlant.
        name: What the System is called in messages.
        input: The index of the input's port.
        disturbance: That of the disturbance's port; None without one.
        context: Holds the parameters and other ports' values; None for the defaults.
        effort_limits: How large each input may be, shape (m,).
        wrapped_states: Which states come round, as the System says.
        forces: The ports' generalised forces, where the System is the plant and they
            have some: it is then evaluated by its manipulator equation, which needs no
            SceneGraph and has no contact.
    """

    system: Any
    plant: Any
    name: str
    input: int
    disturbance: int | None
    context: Any
    effort_limits: Array
    wrapped_states: Any
    forces: PortForces | None

    @property
    def num_inputs(self) -> int:
        """M."""
        return int(self.system.get_input_port(self.input).size())

    @property
    def num_disturbances(self) -> int:
        """Q."""
        port = self.disturbance
        return 0 if port is None else int(self.system.get_input_port(port).size())

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """What the states are called, n names: positions, then velocities."""
        return tuple(self.plant.GetStateNames())

    @cached_property
    def in_numbers(self) -> Evaluation:
        """The System with plain numbers."""
        return Evaluation(self, self.system)

    @cached_property
    def in_autodiff(self) -> Evaluation:
        """The System with numbers that carry derivatives.

        Raises:
            ModelError: The System does not convert to AutoDiffXd.
        """
        try:
            return Evaluation(self, self.system.ToAutoDiffXd())
        except RuntimeError as error:
            raise ModelError(
                f"{self.name}: it does not convert to AutoDiffXd, which the volume"
                f" barrier needs: {error}"
            ) from None

    def regular_state(self, random: np.random.Generator, scale: float = 1.0) -> Array:
        """Returns a random state, shape (n,), its quaternions of unit length."""
        x = scale * random.normal(size=len(self.state_names))
        for i, name in enumerate(self.state_names):
            if name.endswith("_qw"):
                x[i : i + 4] /= np.linalg.norm(x[i : i + 4])
        return x


class Evaluation:
    """The System's derivatives and kinematics in one scalar type."""

    def __init__(self, dynamics: NumericDynamics, system: Any) -> None:
        self._system, self._dynamics = system, dynamics
        self._context = system.CreateDefaultContext()
        if dynamics.context is not None:
            _copy_values(dynamics, system, self._context)
        is_plant = dynamics.system is dynamics.plant
        name = dynamics.plant.get_name()
        self._plant = system if is_plant else system.GetSubsystemByName(name)
        self._plant_context = self._plant.GetMyContextFromRoot(self._context)
        scalar = float if system is dynamics.system else AutoDiffXd
        self._forces = MultibodyForces_[scalar](self._plant)
        self._input = system.get_input_port(dynamics.input)
        self._disturbance = (
            None
            if dynamics.disturbance is None
            else system.get_input_port(dynamics.disturbance)
        )
        # Unit inputs, halved where a plant would clamp them.
        self._steps = np.fmin(1.0, dynamics.effort_limits / 2.0)
        self._none = np.zeros(len(self._steps))
        if dynamics.forces is not None:
            return
        self._input.FixValue(self._context, self._none)
        if self._disturbance is not None:
            zero = np.zeros(dynamics.num_disturbances)
            self._disturbance.FixValue(self._context, zero)
        self._fix_needed_ports()

    def _fix_needed_ports(self) -> None:
        """Holds ports without a value at 0, if the System does not do without."""
        try:
            self._system.EvalTimeDerivatives(self._context)
        except RuntimeError as error:
            system = self._system
            ports = [system.get_input_port(i) for i in range(system.num_input_ports())]
            unset = [p for p in ports if p.size() and not p.HasValue(self._context)]
            if not unset:
                name = self._dynamics.name
                raise ModelError(f"{name}: it has no derivatives: {error}") from None
            for port in unset:
                port.FixValue(self._context, np.zeros(port.size()))
            self._fix_needed_ports()

    def set_state(self, x: Array) -> None:
        """Sets the state x, shape (n,)."""
        self._context.SetContinuousState(x)

    def rate(self, x: Array, u: Array, d: Array, t: float = 0.0) -> Array:
        """Returns dx/dt, shape (n,)."""
        if self._dynamics.forces is not None:
            f, g = self.affine_parts(x)
            return f + g @ u + self.disturbance_matrix(x) @ d
        self._context.SetTime(t)
        self.set_state(x)
        self._input.FixValue(self._context, u)
        if self._disturbance is not None:
            self._disturbance.FixValue(self._context, d)
        rate: Array = self._rate()
        self._context.SetTime(0.0)
        if self._disturbance is not None:
            self._disturbance.FixValue(self._context, np.zeros_like(d))
        return rate

    def _rate(self) -> Array:
        try:
            derivatives = self._system.EvalTimeDerivatives(self._context)
        except RuntimeError as error:  # A mass matrix that cannot be inverted, say.
            raise ArithmeticError(f"{self._dynamics.name}: {error}") from error
        rate: Array = derivatives.CopyToVector()
        return rate

    def affine_parts(self, x: Array) -> tuple[Array, Array]:
        """Returns f(x), shape (n,), and g(x), shape (n, m)."""
        forces = self._dynamics.forces
        if forces is not None:
            M, bias, rate = self.manipulator_equation(x)
            solved = _solve(M, np.column_stack([-bias, forces.input]))
            still = np.zeros((len(rate), forces.input.shape[1]))
            return np.append(rate, solved[:, 0]), np.vstack([still, solved[:, 1:]])
        self.set_state(x)
        self._input.FixValue(self._context, self._none)
        f = self._rate()
        columns = []
        for step, unit in zip(self._steps, np.eye(len(self._steps)), strict=True):
            self._input.FixValue(self._context, step * unit)
            columns.append((self._rate() - f) / step)
        return f, np.array(columns).T

    def disturbance_matrix(self, x: Array) -> Array:
        """Returns E(x), shape (n, q)."""
        forces, q = self._dynamics.forces, self._dynamics.num_disturbances
        if forces is not None:
            M, _, rate = self.manipulator_equation(x)
            still = np.zeros((len(rate), q))
            return np.vstack([still, _solve(M, forces.disturbance)])
        f = self.rate(x, self._none, np.zeros(q))
        return np.array([self.rate(x, self._none, unit) - f for unit in np.eye(q)]).T

    def manipulator_equation(self, x: Array) -> tuple[Array, Array, Array]:
        """Returns M (nv, nv), the bias (nv,) of M dv/dt + bias = tau, and dq/dt."""
        self.set_state(x)
        plant, context, forces = self._plant, self._plant_context, self._forces
        plant.CalcForceElementsContribution(context, forces)
        still = np.zeros(plant.num_velocities())
        bias = plant.CalcInverseDynamics(context, still, forces)
        rate = plant.MapVelocityToQDot(context, x[plant.num_positions() :])
        return plant.CalcMassMatrix(context), bias, rate

    def sensitivity(self, x: Array, parts: tuple[Array, Array]) -> tuple[Array, Array]:
        """Returns the derivatives of f (n, n) and of g (n, m, n) by x, in AutoDiffXd.

        Args:
            x: The state, shape (n,).
            parts: f and g there.
        """
        moving, n, (f, g) = InitializeAutoDiff(x).ravel(), len(x), parts
        if self._dynamics.forces is None:
            f, g = self.affine_parts(moving)
            g_x = ExtractGradient(g.reshape(-1, 1)).reshape(*g.shape, n)
            return ExtractGradient(f), g_x
        M, bias, rate = self.manipulator_equation(moving)
        nq, nv = len(rate), len(bias)
        M_x, M = ExtractGradient(M.reshape(-1, 1)), ExtractValue(M)
        M_x = M_x.reshape(nv, nv, n)
        # M dv/dt = B u - bias, by parts: M (dv/dt)_x = -bias_x - M_x dv/dt.
        f_x = _solve(M, -ExtractGradient(bias) - np.einsum("ijk,j->ik", M_x, f[nq:]))
        g_x = -np.einsum("ijk,jm->imk", M_x, g[nq:])
        g_x = _solve(M, g_x.reshape(nv, -1)).reshape(g_x.shape)
        still = np.zeros((nq, g.shape[1], n))
        return np.vstack([ExtractGradient(rate), f_x]), np.concatenate([still, g_x])

    def kinematics(
        self, frame: str, offset: tuple[float, ...]
    ) -> tuple[Array, Array, Array]:
        """Returns a point's place p (3,), Jacobian J (3, nv) and bias dJ/dt v (3,).

        Args:
            frame: The name of the frame or body that it moves with.
            offset: The point in that frame, shape (3,) [m].
        """
        plant, context = self._plant, self._plant_context
        moving, world = plant.GetFrameByName(frame), plant.world_frame()
        point, by = np.array(offset).reshape(3, 1), JacobianWrtVariable.kV
        J = plant.CalcJacobianTranslationalVelocity(
            context, by, moving, point, world, world
        )
        bias = plant.CalcBiasTranslationalAcceleration(
            context, by, moving, point, world, world
        )
        return self.place(frame, offset), J, np.ravel(bias)

    def place(self, frame: str, offset: tuple[float, ...]) -> Array:
        """Returns where a point of a frame is, shape (3,) [m]."""
        plant, point = self._plant, np.array(offset).reshape(3, 1)
        moving, world = plant.GetFrameByName(frame), plant.world_frame()
        places = plant.CalcPointsPositions(self._plant_context, moving, point, world)
        return np.ravel(places)


def _copy_values(dynamics: NumericDynamics, system: Any, target: Any) -> None:
    """Copies time, parameters and other ports' values from the given context."""
    source, context = dynamics.system, dynamics.context
    target.SetTimeStateAndParametersFrom(context)
    for i in range(source.num_input_ports()):
        port = source.get_input_port(i)
        if port.size() and port.HasValue(context):
            system.get_input_port(i).FixValue(target, port.Eval(context))


def _solve(M: Array, right: Array) -> Array:
    """Solves M X = right, of a matrix of inertia.

    Raises:
        ArithmeticError: M is singular.
    """
    try:
        return np.asarray(np.linalg.solve(M, right), dtype=float)
    except np.linalg.LinAlgError as error:
        raise ArithmeticError(f"the matrix of inertia is singular: {error}") from error


def numeric_dynamics(
    system: Any,
    input_port: PortChoice = None,
    disturbance_port: PortChoice = None,
    context: Any = None,
) -> NumericDynamics:
    """Returns the dynamics of a System whose state is a MultibodyPlant's.

    Args:
        system: The System; all its state must be continuous.
        input_port: The port of u: an InputPort, its name or its index; None for a
            MultibodyPlant's actuators, or the only vector input port beside the
            disturbance's.
        disturbance_port: The port of d, likewise; None for the port called
            "disturbance" if there is one, else q = 0.
        context: Holds the parameters, and values for the other input ports; None for
            the defaults.

    Raises:
        ModelError: The state is not continuous, or the ports are not what is needed.
    """
    plant = _plant_of(system)
    name = system.get_name() or system.GetSystemType()
    default_context(system, name)
    disturbance = find_disturbance_port(system, name, disturbance_port)
    port = find_input_port(system, name, input_port, disturbance)
    return NumericDynamics(
        system=system,
        plant=plant,
        name=name,
        input=int(port.get_index()),
        disturbance=None if disturbance is None else int(disturbance.get_index()),
        context=context,
        effort_limits=effort_limits_of(system, port),
        wrapped_states=declared_states(system).periods,
        forces=_port_forces(system, port, disturbance, context),
    )


def _port_forces(
    system: Any, port: Any, disturbance: Any, context: Any
) -> PortForces | None:
    """The generalised forces of a plant's ports; None where they are others'."""
    if not isinstance(system, MultibodyPlant):
        return None
    if context is not None and any(
        p.HasValue(context)
        for p in vector_ports(system)
        if p not in (port, disturbance)
    ):
        return None
    none = np.zeros((system.num_velocities(), 0))
    maps = none if port is None else _force_map(system, port)
    pushed = none if disturbance is None else _force_map(system, disturbance)
    return None if maps is None or pushed is None else PortForces(maps, pushed)


def _force_map(plant: Any, port: Any) -> Array | None:
    """The matrix (nv, k) from a port's vector to generalised forces, if it has one."""
    if port is plant.get_applied_generalized_force_input_port():
        return np.eye(plant.num_velocities())
    if not plant.num_actuated_dofs():
        return None
    matrix: Array = plant.MakeActuationMatrix()
    if port is plant.get_actuation_input_port():
        return matrix
    for index in range(plant.num_model_instances()):
        instance = ModelInstanceIndex(index)
        actuators = plant.GetJointActuatorIndices(instance)
        if actuators and port is plant.get_actuation_input_port(instance):
            starts = [plant.get_joint_actuator(i).input_start() for i in actuators]
            return matrix[:, starts]
    return None


def has_plant_state(system: Any) -> bool:
    """Returns whether a System's continuous state is that of one MultibodyPlant."""
    return _plant_of(system) is not None


def _plant_of(system: Any) -> Any:
    """The MultibodyPlant that a System is, or that has all its state."""
    if isinstance(system, MultibodyPlant):
        return system
    inside: Sequence[Any] = getattr(system, "GetSystems", lambda: ())()
    plants = [each for each in inside if isinstance(each, MultibodyPlant)]
    if len(plants) != 1:
        return None
    states = system.CreateDefaultContext().num_continuous_states()
    return plants[0] if plants[0].num_multibody_states() == states else None
