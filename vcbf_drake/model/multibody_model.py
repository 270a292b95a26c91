"""The control-affine model of a MultibodyPlant, evaluated by Drake in plain numbers."""

from __future__ import annotations

from collections.abc import Hashable
from functools import cached_property
from typing import TypeAlias

import numpy as np
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Variable

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel, Dynamics, rows_of
from vcbf_drake.model.formulas import read
from vcbf_drake.model.graph import variable
from vcbf_drake.model.interface import (
    NOT_AFFINE,
    Ports,
    declared_states,
    name_of,
)
from vcbf_drake.model.multibody_parts import effort_limits_of
from vcbf_drake.model.numeric_dynamics import (
    NUM_SAMPLES,
    NumericDynamics,
    constant_matrix,
    derivatives,
    numeric_dynamics,
    regular_state,
)
from vcbf_drake.model.position import PointCoordinate

Output: TypeAlias = int | PointCoordinate
"""An argument z of a barrier: the state of an index, or a point's coordinate."""


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

    def __init__(self, ports: Ports) -> None:
        """Checks the System at a few seeded states."""
        system = ports.system
        self._numbers = numeric_dynamics(ports)
        self.plant = self._numbers.plant
        self.num_positions = self.plant.num_positions()
        about, name = declared_states(system), name_of(system)
        names, limits = about.names, effort_limits_of(system, ports.input)
        E = constant_matrix(self._numbers.disturbance_matrix, names, name)
        self._describe(about, E, name, limits)
        self.speed_matrix = np.eye(len(names))[self.num_positions :]
        self.state = np.array([Variable(name) for name in names])
        x = tuple(variable(f"x{i}") for i in range(len(names)))
        self.dynamics = Dynamics(x, (), (), rows_of(read(E, {})))  # f, g: no formulas.
        self._motion: Motion | None = None
        self._require_affine()

    def _require_affine(self) -> None:
        """Checks dx/dt = f + g u + E d at seeded states, inputs and times."""
        random, limits = np.random.default_rng(1), np.fmin(self.effort_limits, 1e3)
        for scale in np.geomspace(0.1, 10.0, NUM_SAMPLES):
            x = regular_state(self.state_names, random, scale)
            u = random.uniform(-limits, limits)
            d = np.asarray(random.normal(size=self.num_disturbances))
            f, g = self.drift_and_input_matrix(x)
            expected = f + g @ u + self.disturbance_matrix @ d
            size = np.abs(f) + np.abs(g) @ np.abs(u) + 1.0
            for t, problem in ((0.0, NOT_AFFINE), (1.3, "depends on time")):
                found = self._numbers.rate(x, u, d, t)
                wrong = np.abs(found - expected) > 1e-7 * size
                if wrong.any():
                    state = self.state_names[int(wrong.argmax())]
                    raise ModelError(
                        f"{self.name}: the derivative of {state} {problem}"
                    )

    @cached_property
    def velocity_of_position(self) -> dict[int, int]:
        """The state j that is the rate of position i, where one is: {i: j}."""
        plant, context = self.plant, self.plant.CreateDefaultContext()
        random, maps = np.random.default_rng(0), []
        for _ in range(NUM_SAMPLES):
            x = regular_state(self.state_names, random)
            plant.SetPositions(context, x[: self.num_positions])
            maps.append(plant.MakeVelocityToQDotMap(context).toarray())
        rates = maps[0]
        is_unit = (np.ptp(maps, axis=0) == 0.0).all(axis=1)
        is_unit &= (np.count_nonzero(rates, axis=1) == 1) & (rates.sum(axis=1) == 1.0)
        velocities = self.num_positions + rates.argmax(axis=1)
        return {int(i): int(velocities[i]) for i in np.flatnonzero(is_unit)}

    def at(self, x: Array) -> Motion:
        """Returns the bodies' motion at a state x (n,); cached for one state."""
        if self._motion is None or self._motion.key != x.tobytes():
            self._motion = Motion(self, self._numbers, x.copy())
        return self._motion

    def drift_and_input_matrix(self, x: Array) -> tuple[Array, Array]:
        """Evaluates f(x), shape (n,), and g(x), shape (n, m), at once."""
        return self.at(self._checked(x)).parts

    def compiled_rate(self, *x_and_u: float) -> list[float]:
        """Returns f(x) + g(x) u as a list: Drake evaluates it, so it has no code."""
        x, u = np.split(np.array(x_and_u), [self.num_states])
        rate = self._numbers.rate(x, u, np.zeros(self.num_disturbances))
        values: list[float] = rate.tolist()
        return values


class Motion:
    """The motion of a MultibodyPlant's bodies at one state.

    Of an output z it knows the jet [z, dz/dt, a, b, c], shape (3 + m + q,): the
    derivative of z of the order 1 or 2 is a + b u + c d.

    Attributes:
        key: The key of the state.
    """

    def __init__(
        self, model: MultibodyModel, numbers: NumericDynamics, x: Array
    ) -> None:
        self.key = x.tobytes()
        self._model, self._numbers, self._x = model, numbers, x
        self._points: dict[Hashable, Array] = {}
        self._sensitive_points: dict[Hashable, Array] = {}

    @cached_property
    def parts(self) -> tuple[Array, Array]:
        """f, shape (n,), and g, shape (n, m)."""
        return self._numbers.affine_parts(self._x)

    @cached_property
    def sensitivity(self) -> tuple[Array, Array]:
        """The derivatives of f, shape (n, n), and of g, shape (n, m, n), by x."""
        return self._numbers.in_autodiff.sensitivity(self._x, self.parts)

    def value(self, output: Output) -> float:
        """Returns z."""
        if isinstance(output, int):
            return float(self._x[output])
        self._numbers.set_state(self._x)
        return float(self._numbers.place(output.frame, output.offset)[output.axis])

    def jet(self, output: Output, order: int) -> Array:
        """Returns the jet of an output, shape (3 + m + q,)."""
        if isinstance(output, int):
            (f, g), i = self.parts, self._moved(output, order)
            E = self._model.disturbance_matrix
            return np.concatenate([[self._x[output], self._x[i], f[i]], g[i], E[i]])
        point = self._point(output.frame, output.offset)
        return _of_order(point[output.axis], order)

    def jet_by_state(self, output: Output, order: int) -> Array:
        """Returns the jet's derivatives by x, shape (3 + m + q, n)."""
        if isinstance(output, int):
            (f_x, g_x), i = self.sensitivity, self._moved(output, order)
            unit, q = np.eye(len(self._x)), self._model.num_disturbances
            still = np.zeros((q, len(self._x)))
            return np.vstack([unit[output], unit[i], f_x[i], g_x[i], still])
        point = self._point_sensitivity(output.frame, output.offset)
        return _of_order(point[output.axis], order)

    def _moved(self, state: int, order: int) -> int:
        """The state whose derivative contains the inputs, up to an order."""
        if order == 1:
            return state
        velocities = self._model.velocity_of_position
        if state not in velocities:
            raise ModelError(
                f"h is a function of {self._model.state_names[state]}, whose rate is no"
                " velocity of the plant: take points of its bodies (point_position),"
                " or other states"
            )
        return velocities[state]

    def _point(self, frame: str, offset: tuple[float, ...]) -> Array:
        """The jets of a point's world coordinates, shape (3, 3 + m + q)."""
        key = frame, offset
        if key not in self._points:
            (f, g), numbers = self.parts, self._numbers
            numbers.set_state(self._x)
            p, J, bias = numbers.kinematics(frame, offset)
            nq = len(f) - J.shape[1]
            E = self._model.disturbance_matrix[nq:]
            columns = p, J @ self._x[nq:], J @ f[nq:] + bias, J @ g[nq:], J @ E
            self._points[key] = np.column_stack(columns)
        return self._points[key]

    def _point_sensitivity(self, frame: str, offset: tuple[float, ...]) -> Array:
        """The derivatives of `_point` by x, shape (3, 3 + m + q, n)."""
        key = frame, offset
        if key not in self._sensitive_points:
            (f, g), (f_x, g_x) = self.parts, self.sensitivity
            numbers = self._numbers.in_autodiff
            numbers.set_state(InitializeAutoDiff(self._x).ravel())
            p, J, bias = numbers.kinematics(frame, offset)
            n, nv = len(self._x), J.shape[1]
            nq = n - nv
            E = self._model.disturbance_matrix[nq:]
            # Columns [v, f, g, E] that J takes to the point, and how they change.
            moved = np.column_stack([self._x[nq:], f[nq:], g[nq:], E])
            still = np.zeros((*E.shape, n))
            v_x = np.eye(n)[nq:]
            moved_x = np.concatenate(
                [v_x[:, None], f_x[nq:, None], g_x[nq:], still], axis=1
            )
            found = np.einsum("ijk,jm->imk", derivatives(J), moved)
            found += np.einsum("ij,jmk->imk", ExtractValue(J), moved_x)
            found[:, 1] += derivatives(bias)
            self._sensitive_points[key] = np.concatenate(
                [derivatives(p)[:, None], found], axis=1
            )
        return self._sensitive_points[key]


def _of_order(jet: Array, order: int) -> Array:
    """A jet of order 2, or that of order 1: its rate is known, whatever the input."""
    if order == 2:
        return jet
    return np.concatenate([jet[:2], jet[1:2], np.zeros_like(jet[3:])])
