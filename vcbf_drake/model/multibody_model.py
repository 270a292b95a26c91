"""The control-affine model of a MultibodyPlant, evaluated by Drake in plain numbers."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import cached_property

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Variable
from pydrake.systems.framework import Context, System

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel, Dynamics
from vcbf_drake.model.graph import variable
from vcbf_drake.model.interface import (
    Port,
    declared_states,
    default_context,
    effort_limits_of,
    name_of,
    unit_quaternions,
)
from vcbf_drake.model.numeric_dynamics import NumericDynamics

# The number of seeded states at which a constant or an affine form is checked.
_NUM_SAMPLES = 6


class MultibodyModel(ControlAffineModel):
    """The functions f, g and E of a MultibodyPlant of any size (E1, the plant).

    It has no symbolic formulas, which grow too large beyond two or three joints: f and
    g are the plant's own time derivatives at no input and at unit inputs, and their
    sensitivities are Drake's with AutoDiffXd. Barriers on it are functions of
    *outputs*: positions and velocities of the state, and points of its bodies.

    Attributes:
        plant: The MultibodyPlant.
        num_positions: The number of positions q in the state; the velocities v follow.
    """

    def __init__(
        self,
        system: System,
        input_port: Port,
        disturbance_port: Port,
        context: Context | None,
    ) -> None:
        """Checks the System at a few seeded states.

        Args:
            system: The MultibodyPlant, or a Diagram whose state is its.
            input_port: The port of u.
            disturbance_port: That of d; None without one.
            context: Holds the parameters and other ports' values.

        Raises:
            ModelError: Its state is not continuous, it depends on time, is not affine
                in u and d, or E is not constant or lacks rank.
        """
        default_context(system)
        ports = input_port, disturbance_port
        self._dynamics = NumericDynamics(system, *ports, context)
        self.plant = self._dynamics.plant
        self.num_positions = self.plant.num_positions()
        names, name = tuple(self.plant.GetStateNames()), name_of(system)
        self._describe(
            num_inputs=input_port.size(),
            disturbance_matrix=_constant_matrix(self._dynamics, names, name),
            state_names=names,
            name=name,
            effort_limits=effort_limits_of(system, input_port),
            wrapped_states=declared_states(system).periods,
            position=getattr(system, "position_indices", None),
        )
        self.speed_matrix = np.eye(len(names))[self.num_positions :]
        self.state = np.array([Variable(name) for name in names])
        x = tuple(variable(f"x{i}") for i in range(len(names)))
        E = tuple(map(tuple, self.disturbance_matrix.tolist()))
        self.dynamics = Dynamics(x, (), (), E)  # f and g have no formulas.
        self.compiled_rate = self._rate
        self._motion: Motion | None = None
        _require_affine(self._dynamics, self)

    @cached_property
    def velocity_of_position(self) -> dict[int, int]:
        """The state j that is the rate of position i, where one is: {i: j}."""
        plant, context = self.plant, self.plant.CreateDefaultContext()
        random, maps = np.random.default_rng(0), []
        for _ in range(_NUM_SAMPLES):
            plant.SetPositions(
                context, self.regular_state(random)[: self.num_positions]
            )
            maps.append(plant.MakeVelocityToQDotMap(context).toarray())
        rates = maps[0]
        is_unit = (np.ptp(maps, axis=0) == 0.0).all(axis=1)
        is_unit &= (np.count_nonzero(rates, axis=1) == 1) & (rates.sum(axis=1) == 1.0)
        velocities = self.num_positions + rates.argmax(axis=1)
        return {int(i): int(velocities[i]) for i in np.flatnonzero(is_unit)}

    def regular_state(self, random: np.random.Generator, scale: float = 1.0) -> Array:
        """Returns a random state, shape (n,), its quaternions of unit length."""
        return _regular_state(self.state_names, random, scale)

    def at(self, x: Array) -> Motion:
        """Returns the bodies' motion at a state x (n,); cached for one state."""
        key = x.tobytes()
        if self._motion is None or self._motion.key != key:
            self._motion = Motion(
                self._dynamics, self.disturbance_matrix, x.copy(), key
            )
        return self._motion

    def drift_and_input_matrix(self, x: Array) -> tuple[Array, Array]:
        """Evaluates f(x), shape (n,), and g(x), shape (n, m), at once.

        Raises:
            ValueError: x has the wrong shape.
        """
        x = np.asarray(x, dtype=float)
        if x.shape != (self.num_states,):
            raise ValueError(
                f"{self.name}: x has shape {x.shape}; it must be ({self.num_states},)"
            )
        return self.at(x).parts

    def _rate(self, *arguments: float) -> list[float]:
        x, u = np.split(np.array(arguments), [self.num_states])
        rate: list[float] = self.nominal_rate(x, u).tolist()
        return rate

    def nominal_rate(self, x: Array, u: Array) -> Array:
        """Evaluates f(x) + g(x) u, shape (n,): dx/dt without disturbance."""
        d = np.zeros(self.num_disturbances)
        return self._dynamics.rate(x, np.asarray(u, dtype=float), d)


class Motion:
    """The motion of a MultibodyPlant's bodies at one state.

    Attributes:
        key: The key of the state.
    """

    def __init__(
        self, dynamics: NumericDynamics, disturbance_matrix: Array, x: Array, key: bytes
    ) -> None:
        self.key = key
        self._dynamics, self._E, self._x = dynamics, disturbance_matrix, x
        self._points: dict[Hashable, Array] = {}
        self._sensitive_points: dict[Hashable, Array] = {}

    @cached_property
    def parts(self) -> tuple[Array, Array]:
        """f, shape (n,), and g, shape (n, m)."""
        return self._dynamics.affine_parts(self._x)

    @cached_property
    def sensitivity(self) -> tuple[Array, Array]:
        """The derivatives of f, shape (n, n), and of g, shape (n, m, n), by x."""
        return self._dynamics.in_autodiff.sensitivity(self._x, self.parts)

    def place(self, frame: str, offset: tuple[float, ...]) -> Array:
        """Returns the position of a point of a frame, shape (3,) [m]."""
        numbers = self._dynamics
        numbers.set_state(self._x)
        return numbers.place(frame, offset)

    def point(self, frame: str, offset: tuple[float, ...]) -> Array:
        """Returns the motion of a point p: d^2p/dt^2 = a + b u + c d.

        Args:
            frame: The name of the frame or body.
            offset: The point in that frame, shape (3,) [m].

        Returns:
            [p, dp/dt, a, b, c] of each world axis, shape (3, 3 + m + q) [m, m/s, ...].
        """
        key = frame, offset
        if key not in self._points:
            (f, g), numbers = self.parts, self._dynamics
            numbers.set_state(self._x)
            p, J, bias = numbers.kinematics(frame, offset)
            nq = len(f) - J.shape[1]
            drift = J @ f[nq:] + bias
            columns = p, J @ self._x[nq:], drift, J @ g[nq:], J @ self._E[nq:]
            self._points[key] = np.column_stack(columns)
        return self._points[key]

    def point_sensitivity(self, frame: str, offset: tuple[float, ...]) -> Array:
        """Returns the derivatives of `point` by x, shape (3, 3 + m + q, n).

        Args:
            frame: The name of the frame or body.
            offset: The point in that frame, shape (3,) [m].
        """
        key = frame, offset
        if key not in self._sensitive_points:
            (f, g), (f_x, g_x) = self.parts, self.sensitivity
            numbers = self._dynamics.in_autodiff
            numbers.set_state(InitializeAutoDiff(self._x).ravel())
            p, J, bias = numbers.kinematics(frame, offset)
            n, nv = len(self._x), J.shape[1]
            nq = n - nv
            # Columns [v, f, g, E] that J takes to the point, and how they change.
            moved = np.column_stack([self._x[nq:], f[nq:], g[nq:], self._E[nq:]])
            still = np.zeros((nv, self._E.shape[1], n))
            v_x = np.eye(n)[nq:]
            moved_x = np.concatenate(
                [v_x[:, None], f_x[nq:, None], g_x[nq:], still], axis=1
            )
            J_x = ExtractGradient(J.reshape(-1, 1)).reshape(3, nv, n)
            found = np.einsum("ijk,jm->imk", J_x, moved)
            found += np.einsum("ij,jmk->imk", ExtractValue(J), moved_x)
            found[:, 1] += ExtractGradient(bias)
            self._sensitive_points[key] = np.concatenate(
                [ExtractGradient(p)[:, None], found], axis=1
            )
        return self._sensitive_points[key]


def _regular_state(
    names: Sequence[str], random: np.random.Generator, scale: float = 1.0
) -> Array:
    return unit_quaternions(scale * random.normal(size=len(names)), names)


def _constant_matrix(
    dynamics: NumericDynamics, names: Sequence[str], name: str
) -> Array:
    """E, shape (n, q), the same at a few seeded states."""
    random, q = np.random.default_rng(0), dynamics.num_disturbances
    if not q:
        return np.zeros((len(names), 0))
    found = [
        dynamics.disturbance_matrix(_regular_state(names, random))
        for _ in range(_NUM_SAMPLES)
    ]
    spread = np.ptp(found, axis=0)
    varying = np.argwhere(spread > 1e-9 * np.abs(found).max())
    if len(varying):
        i, j = varying[0]
        raise ModelError(
            f"{name}: the disturbance matrix E is not constant: disturbance {j} acts on"
            f" the derivative of {names[i]} differently from state to state"
        )
    matrix: Array = found[0]
    return matrix


def _require_affine(dynamics: NumericDynamics, model: MultibodyModel) -> None:
    """Checks dx/dt = f + g u + E d at seeded states, inputs, disturbances and times."""
    random = np.random.default_rng(1)
    limits = np.fmin(model.effort_limits, 1e3)
    for scale in np.geomspace(0.1, 10.0, _NUM_SAMPLES):
        x = model.regular_state(random, scale)
        u = random.uniform(-limits, limits)
        d = np.asarray(random.normal(size=model.num_disturbances))
        f, g = model.drift_and_input_matrix(x)
        expected = f + g @ u + model.disturbance_matrix @ d
        size = np.abs(f) + np.abs(g) @ np.abs(u) + 1.0
        for t, word in ((0.0, "is not affine in the input"), (1.3, "depends on time")):
            found = dynamics.rate(x, u, d, t)
            wrong = np.abs(found - expected) > 1e-7 * size
            if wrong.any():
                state = model.state_names[int(wrong.argmax())]
                raise ModelError(f"{model.name}: the derivative of {state} {word}")
