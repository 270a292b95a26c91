"""The dynamics of a System in numbers, of a MultibodyPlant's in AutoDiffXd too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    MultibodyForces_,
)

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.interface import (
    Port,
    actuators_of,
    copy_values,
    effort_limits_of,
    name_of,
    unit_quaternions,
    vector_ports,
    with_ports_held,
)

# The number of seeded states at which the form of the dynamics is checked.
NUM_SAMPLES = 6


class NumericDynamics:
    """Derivatives of a System, and kinematics of its MultibodyPlant, in numbers.

    Where the System is the plant itself, its ports are generalised forces and it is
    evaluated by its manipulator equation, which needs no SceneGraph and has no contact.
    Ports and context are those of `ControlAffineModel.from_system`; with `autodiff` the
    numbers carry derivatives.

    Attributes:
        plant: The MultibodyPlant as it was given; None where there is none.
    """

    def __init__(
        self,
        system: Any,
        input_port: Port,
        disturbance_port: Port,
        context: Any = None,
        autodiff: bool = False,
    ) -> None:
        self._given = system, input_port, disturbance_port, context
        self.plant = plant_of(system)
        self._system = twin = _in_autodiff(system) if autodiff else system
        self._context = twin.CreateDefaultContext()
        if context is not None:
            copy_values(system, context, twin, self._context)
        if self.plant is not None:
            is_plant, name = system is self.plant, self.plant.get_name()
            self._plant = twin if is_plant else twin.GetSubsystemByName(name)
            self._plant_context = self._plant.GetMyContextFromRoot(self._context)
            forces = MultibodyForces_[AutoDiffXd if autodiff else float]
            self._forces = forces(self._plant)
        self._input = twin.get_input_port(input_port.get_index())
        self._disturbance = disturbance_port and twin.get_input_port(
            disturbance_port.get_index()
        )
        self.num_inputs = int(input_port.size())
        self.num_disturbances = int(disturbance_port.size()) if disturbance_port else 0
        # Unit inputs, halved where a plant would clamp them.
        self._steps = np.fmin(1.0, effort_limits_of(system, input_port) / 2.0)
        self._none = np.zeros(self.num_inputs)
        self._port_forces = _port_forces(*self._given)
        if self.plant is not None and self._port_forces is None:
            self._set_ports(self._none, np.zeros(self.num_disturbances))
            try:
                self._rate()
            except ArithmeticError as error:
                raise ModelError(f"it has no derivatives: {error}") from None

    @cached_property
    def in_autodiff(self) -> NumericDynamics:
        """The same with numbers that carry derivatives."""
        return NumericDynamics(*self._given, autodiff=True)

    def _set_ports(self, u: Array, d: Array) -> None:
        self._input.FixValue(self._context, u)
        if self._disturbance is not None:
            self._disturbance.FixValue(self._context, d)

    def set_state(self, x: Array) -> None:
        """Sets the state x, shape (n,)."""
        self._context.SetContinuousState(x)

    def rate(self, x: Array, u: Array, d: Array, t: float = 0.0) -> Array:
        """Returns dx/dt, shape (n,)."""
        if self._port_forces is not None:
            f, g = self.affine_parts(x)
            return f + g @ u + self.disturbance_matrix(x) @ d
        self._context.SetTime(t)
        self.set_state(x)
        self._set_ports(u, d)
        rate = self._rate()
        self._context.SetTime(0.0)
        self._set_ports(self._none, np.zeros_like(d))
        return rate

    def _rate(self) -> Array:
        try:
            derivatives = with_ports_held(
                self._system,
                self._context,
                lambda: self._system.EvalTimeDerivatives(self._context),
            )
        except RuntimeError as error:  # A mass matrix that cannot be inverted, say.
            raise ArithmeticError(f"{name_of(self._system)}: {error}") from error
        rate: Array = derivatives.CopyToVector()
        return rate

    def affine_parts(self, x: Array) -> tuple[Array, Array]:
        """Returns f(x), shape (n,), and g(x), shape (n, m)."""
        forces = self._port_forces
        if forces is not None:
            M, bias, rate = self.manipulator_equation(x)
            solved = _solve(M, np.column_stack([-bias, forces[0]]))
            still = np.zeros((len(rate), self.num_inputs))
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
        forces, q = self._port_forces, self.num_disturbances
        if forces is not None:
            M, _, rate = self.manipulator_equation(x)
            still = np.zeros((len(rate), q))
            return np.vstack([still, _solve(M, forces[1])])
        f = self.rate(x, self._none, np.zeros(q))
        columns = [self.rate(x, self._none, unit) - f for unit in np.eye(q)]
        return np.reshape(columns, (q, len(f))).T

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
        """Returns the derivatives of f (n, n) and of g (n, m, n), in AutoDiffXd.

        They are at the state x, where f and g are `parts`.
        """
        moving, n, (f, g) = InitializeAutoDiff(x).ravel(), len(x), parts
        if self._port_forces is None:
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
        """Returns a point's position p (3,), Jacobian J (3, nv) and bias dJ/dt v (3,).

        The point is at the offset [m] in the frame or body of that name.
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
        """Returns the position of a point of a frame, shape (3,) [m]."""
        plant, point = self._plant, np.array(offset).reshape(3, 1)
        moving, world = plant.GetFrameByName(frame), plant.world_frame()
        places = plant.CalcPointsPositions(self._plant_context, moving, point, world)
        return np.ravel(places)


def _solve(M: Array, right: Array) -> Array:
    """Solves M X = right for a mass matrix M."""
    try:
        return np.asarray(np.linalg.solve(M, right), dtype=float)
    except np.linalg.LinAlgError as error:
        raise ArithmeticError(f"the matrix of inertia is singular: {error}") from error


def regular_state(
    names: Sequence[str], random: np.random.Generator, scale: float = 1.0
) -> Array:
    """Returns a random state, shape (n,), its quaternions of unit length."""
    return unit_quaternions(scale * random.normal(size=len(names)), names)


def constant_matrix(
    matrix_at: Callable[[Array], Array], names: Sequence[str], name: str
) -> Array:
    """Returns E, shape (n, q), from its values at a few seeded states.

    Raises:
        ModelError: They differ.
    """
    random = np.random.default_rng(0)
    found = [matrix_at(regular_state(names, random)) for _ in range(NUM_SAMPLES)]
    largest = np.abs(found).max(initial=0.0)
    varying = np.argwhere(~(np.ptp(found, axis=0) <= 1e-9 * largest))
    if len(varying):
        i, j = varying[0]
        raise ModelError(
            f"{name}: the disturbance matrix E is not constant: disturbance {j} acts on"
            f" the derivative of {names[i]} differently from state to state"
        )
    return found[0]


def _in_autodiff(system: Any) -> Any:
    try:
        return system.ToAutoDiffXd()
    except RuntimeError as error:
        raise ModelError(
            f"{name_of(system)}: it does not convert to AutoDiffXd, which the volume"
            f" barrier needs: {error}"
        ) from None


def _port_forces(
    system: Any, port: Port, disturbance: Port, context: Any
) -> tuple[Array, Array] | None:
    """B (nv, m) and B_d (nv, q) of a plant's generalised forces tau = B u + B_d d.

    None if its ports are no such forces, or other ports have a value.
    """
    if not isinstance(system, MultibodyPlant):
        return None
    others = [p for p in vector_ports(system) if p not in (port, disturbance)]
    if context is not None and any(p.HasValue(context) for p in others):
        return None
    maps, pushed = _force_map(system, port), _force_map(system, disturbance)
    return None if maps is None or pushed is None else (maps, pushed)


def _force_map(plant: Any, port: Any) -> Array | None:
    """The matrix (nv, k) from a port's vector to generalised forces, if it has one."""
    if port is None:
        return np.zeros((plant.num_velocities(), 0))
    if port is plant.get_applied_generalized_force_input_port():
        return np.eye(plant.num_velocities())
    columns = [each.input_start() for each in actuators_of(plant, port)]
    return plant.MakeActuationMatrix()[:, columns] if columns else None


def plant_of(system: Any) -> Any:
    """Returns the MultibodyPlant that a System is, or that contains all its state."""
    if isinstance(system, MultibodyPlant):
        return system
    inside: Sequence[Any] = getattr(system, "GetSystems", lambda: ())()
    plants = [each for each in inside if isinstance(each, MultibodyPlant)]
    if len(plants) != 1:
        return None
    states = system.num_continuous_states()
    return plants[0] if plants[0].num_multibody_states() == states else None
