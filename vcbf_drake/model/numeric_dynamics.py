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
    Ports,
    declared_states,
    name_of,
    unit_quaternions,
    vector_ports,
    with_ports_held,
)
from vcbf_drake.model.multibody_parts import actuators_of, effort_limits_of, plant_of

# The number of seeded states at which the form of the dynamics is checked.
NUM_SAMPLES = 6


class NumericDynamics:
    """Derivatives of a System, and kinematics of its MultibodyPlant, in numbers.

    Attributes:
        plant: The MultibodyPlant as it was given; None where there is none.
    """

    def __init__(self, ports: Ports, autodiff: bool = False) -> None:
        """Makes a context; with `autodiff` the numbers carry derivatives."""
        self._ports, system = ports, ports.system
        self._system = twin = _in_autodiff(system) if autodiff else system
        self._context, self._own_ports = ports.context_of(twin), ports.of(twin)
        self.plant = plant_of(system)
        if self.plant is not None:
            is_plant, name = system is self.plant, self.plant.get_name()
            self._plant = twin if is_plant else twin.GetSubsystemByName(name)
            self._plant_context = self._plant.GetMyContextFromRoot(self._context)
        # Unit inputs, halved where a plant would clamp them.
        self._steps = np.fmin(1.0, effort_limits_of(system, ports.input) / 2.0)
        self._no_input = np.zeros(ports.input.size())
        self._no_disturbance = np.zeros(ports.num_disturbances)

    @cached_property
    def in_autodiff(self) -> NumericDynamics:
        """The same with numbers that carry derivatives."""
        return numeric_dynamics(self._ports, autodiff=True)

    def set_state(self, x: Array) -> None:
        """Sets the state x, shape (n,)."""
        self._context.SetContinuousState(x)

    def rate(self, x: Array, u: Array, d: Array, t: float = 0.0) -> Array:
        """Returns dx/dt, shape (n,)."""
        self._context.SetTime(t)
        self.set_state(x)
        self._own_ports.fix(self._context, u, d)
        return self._rate()

    def _rate(self) -> Array:
        try:
            found = with_ports_held(
                self._system,
                self._context,
                lambda: self._system.EvalTimeDerivatives(self._context),
            )
        except RuntimeError as error:  # A mass matrix that cannot be inverted, say.
            raise ArithmeticError(f"{name_of(self._system)}: {error}") from error
        rate: Array = found.CopyToVector()
        return rate

    def affine_parts(self, x: Array) -> tuple[Array, Array]:
        """Returns f(x), shape (n,), and g(x), shape (n, m)."""
        f, columns = self.rate(x, self._no_input, self._no_disturbance), []
        for step, unit in zip(self._steps, np.eye(len(self._steps)), strict=True):
            # The state stays, and with it what Drake has computed of it.
            self._own_ports.input.FixValue(self._context, step * unit)
            columns.append((self._rate() - f) / step)
        return f, np.array(columns).T

    def disturbance_matrix(self, x: Array) -> Array:
        """Returns E(x), shape (n, q)."""
        u, calm = self._no_input, self._no_disturbance
        f, q = self.rate(x, u, calm), len(calm)
        columns = [self.rate(x, u, unit) - f for unit in np.eye(q)]
        return np.reshape(columns, (q, len(f))).T

    def sensitivity(self, x: Array, parts: tuple[Array, Array]) -> tuple[Array, Array]:
        """Returns the derivatives of f (n, n) and of g (n, m, n), in AutoDiffXd.

        They are at the state x, where f and g are `parts`.
        """
        f, g = self.affine_parts(InitializeAutoDiff(x).ravel())
        return derivatives(f), derivatives(g)

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


class _ManipulatorEquation(NumericDynamics):
    """A MultibodyPlant whose ports are generalised forces.

    They are those of M dv/dt + bias = B u + B_d d, which needs no SceneGraph and has no
    contact.
    """

    def __init__(
        self, ports: Ports, forces: tuple[Array, Array], autodiff: bool
    ) -> None:
        """Takes B (nv, m) and B_d (nv, q)."""
        super().__init__(ports, autodiff)
        self._B, self._B_d = forces
        of_elements = MultibodyForces_[AutoDiffXd if autodiff else float]
        self._forces = of_elements(self._plant)

    def _terms(self, x: Array) -> tuple[Array, Array, Array]:
        """M (nv, nv), the bias (nv,) and dq/dt (nq,)."""
        self.set_state(x)
        plant, context, forces = self._plant, self._plant_context, self._forces
        plant.CalcForceElementsContribution(context, forces)
        still = np.zeros(plant.num_velocities())
        bias = plant.CalcInverseDynamics(context, still, forces)
        rate = plant.MapVelocityToQDot(context, x[plant.num_positions() :])
        return plant.CalcMassMatrix(context), bias, rate

    def rate(self, x: Array, u: Array, d: Array, t: float = 0.0) -> Array:
        M, bias, rate = self._terms(x)
        return np.append(rate, _solve(M, self._B @ u + self._B_d @ d - bias))

    def affine_parts(self, x: Array) -> tuple[Array, Array]:
        M, bias, rate = self._terms(x)
        solved = _solve(M, np.column_stack([-bias, self._B]))
        still = np.zeros((len(rate), self._B.shape[1]))
        return np.append(rate, solved[:, 0]), np.vstack([still, solved[:, 1:]])

    def disturbance_matrix(self, x: Array) -> Array:
        M, _, rate = self._terms(x)
        still = np.zeros((len(rate), self._B_d.shape[1]))
        return np.vstack([still, _solve(M, self._B_d)])

    def sensitivity(self, x: Array, parts: tuple[Array, Array]) -> tuple[Array, Array]:
        n, (f, g) = len(x), parts
        M, bias, rate = self._terms(InitializeAutoDiff(x).ravel())
        nq, nv = len(rate), len(bias)
        M_x, M = derivatives(M), ExtractValue(M)
        # M dv/dt = B u - bias, by parts: M (dv/dt)_x = -bias_x - M_x dv/dt.
        f_x = _solve(M, -derivatives(bias) - np.einsum("ijk,j->ik", M_x, f[nq:]))
        g_x = -np.einsum("ijk,jm->imk", M_x, g[nq:])
        g_x = _solve(M, g_x.reshape(nv, -1)).reshape(g_x.shape)
        still = np.zeros((nq, g.shape[1], n))
        return np.vstack([derivatives(rate), f_x]), np.concatenate([still, g_x])


def derivatives(values: Array) -> Array:
    """Returns the derivatives of an array of AutoDiffXd by x, shape (..., n)."""
    flat = ExtractGradient(values.reshape(-1, 1))
    found: Array = flat.reshape(*values.shape, flat.shape[1])
    return found


def numeric_dynamics(ports: Ports, autodiff: bool = False) -> NumericDynamics:
    """Returns the dynamics of a System; of forces on a plant, by its own equation.

    Raises:
        ModelError: A plant has none, as one whose bodies have no mass.
    """
    forces = _port_forces(ports)
    if forces is not None:
        made: NumericDynamics = _ManipulatorEquation(ports, forces, autodiff)
    else:
        made = NumericDynamics(ports, autodiff)
    if made.plant is not None and not autodiff:
        names = declared_states(ports.system).names
        try:
            made.affine_parts(regular_state(names, np.random.default_rng(0)))
        except ArithmeticError as error:
            raise ModelError(f"it has no derivatives: {error}") from None
    return made


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


def _port_forces(ports: Ports) -> tuple[Array, Array] | None:
    """B (nv, m) and B_d (nv, q) of a plant's generalised forces tau = B u + B_d d.

    None if its ports are no such forces, or other ports have a value.
    """
    plant, context = ports.system, ports.context
    if not isinstance(plant, MultibodyPlant):
        return None
    others = [
        p for p in vector_ports(plant) if p not in (ports.input, ports.disturbance)
    ]
    if context is not None and any(p.HasValue(context) for p in others):
        return None
    B, B_d = _force_map(plant, ports.input), _force_map(plant, ports.disturbance)
    return None if B is None or B_d is None else (B, B_d)


def _force_map(plant: Any, port: Any) -> Array | None:
    """The matrix (nv, k) from a port's vector to generalised forces, if it has one."""
    if port is None:
        return np.zeros((plant.num_velocities(), 0))
    if port is plant.get_applied_generalized_force_input_port():
        return np.eye(plant.num_velocities())
    columns = [each.input_start() for each in actuators_of(plant, port)]
    return plant.MakeActuationMatrix()[:, columns] if columns else None
