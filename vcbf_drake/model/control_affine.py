"""The control-affine model dx/dt = f(x) + g(x) u + E d of any Drake System."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context, System

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.agreement import require_agreement, sample_points
from vcbf_drake.model.formulas import Expressions, compile_nodes, read
from vcbf_drake.model.graph import (
    ONE,
    ZERO,
    Node,
    Nodes,
    along,
    gradients,
    variable,
)
from vcbf_drake.model.interface import (
    DeclaredStates,
    PortChoice,
    Ports,
    declared_states,
    find_disturbance_port,
    find_input_port,
    name_of,
    unit_quaternions,
    wrapping,
)
from vcbf_drake.model.manoeuvre import MakeManoeuvres, Manoeuvre
from vcbf_drake.model.multibody_parts import effort_limits_of, plant_of
from vcbf_drake.model.numeric_dynamics import numeric_dynamics
from vcbf_drake.model.position import Position, named_position
from vcbf_drake.model.symbolic_dynamics import symbolic_dynamics
from vcbf_drake.typed import typed


class Dynamics(NamedTuple):
    """The formulas of dx/dt = f + g u + E d; equal for equal models.

    Attributes:
        x: The state's variables, n nodes.
        f: n nodes.
        g: n rows of m nodes.
        E: n rows of q nodes.
    """

    x: tuple[Node, ...]
    f: tuple[Node, ...]
    g: tuple[tuple[Node, ...], ...]
    E: tuple[tuple[Node, ...], ...]

    def drift_rate(self, phi: Node, time: Node) -> Node:
        """Returns the Lie derivative along the extended drift [f; 1] (E2)."""
        (rate,) = along([phi], {**dict(zip(self.x, self.f, strict=True)), time: ONE})
        return rate

    def input_rates(self, phi: Node) -> Nodes:
        """Returns L_g phi, shape (m,)."""
        return self._rates(phi, self.g)

    def disturbance_rates(self, phi: Node) -> Nodes:
        """Returns E' grad phi, shape (q,)."""
        return self._rates(phi, self.E)

    def _rates(self, phi: Node, columns: Sequence[Sequence[Node]]) -> Nodes:
        """Grad phi times the columns, summed over the states in phi."""
        slopes = gradients([phi], self.x)[0]
        moves = [i for i, slope in enumerate(slopes) if slope is not ZERO] or [0]
        return slopes[moves] @ np.array([columns[i] for i in moves], dtype=object)


def rows_of(nodes: Nodes) -> tuple[tuple[Node, ...], ...]:
    """Returns a matrix of nodes as a tuple of its rows."""
    return tuple(map(tuple, nodes))


class ControlAffineModel:
    """The functions f and g and the matrix E of dx/dt = f(x) + g(x) u + E d (E1).

    Args:
        state: The state's variables, shape (n,).
        drift: f(x), shape (n,), expressions over `state`.
        input_matrix: g(x), shape (n, m), expressions over `state`.
        disturbance_matrix: E, shape (n, q), constant, of full column rank.
        state_names: The names of the states; None for x0, x1, ...
        name: The model's name in messages.
        effort_limits: The limits at which the plant itself clamps its inputs; None for
            none.
        wrapped_states: The names of angles that may jump by 2 pi; or of states that
            jump by other periods, with these.
        position: The indices of the position, or a function from x to it; None for the
            states called x, y and z, if any.

    Attributes:
        num_states: n.
        num_inputs: m.
        num_disturbances: q; 0 for a model without a disturbance.
        dynamics: The formulas of f, g and E.
        effort_limits: The greatest |u_j|, shape (m,): beyond it the plant clamps its
            input (as a MultibodyPlant does), and the model does not hold. Usually
            infinite.
        wrapping_periods: The period of each state, shape (n,); usually infinite.
        speed_matrix: S of the speed v = S x that a brake reduces, shape (k, n): the
            velocities of a MultibodyPlant; for other plants E⁺, the states that a
            disturbance acts on, or without one Drake's generalized velocities.
        make_manoeuvres: Makes the plant's backup manoeuvres; None where it has none.

    Raises:
        ModelError: E does not have full column rank.
        ValueError: The shapes do not fit.
    """

    @typed
    def __init__(
        self,
        state: Expressions,
        drift: Expressions,
        input_matrix: Expressions,
        disturbance_matrix: Array,
        state_names: Sequence[str] | None = None,
        name: str = "model",
        effort_limits: Array | None = None,
        wrapped_states: Sequence[str] | Mapping[str, float] = (),
        position: Position | None = None,
    ) -> None:
        n, m, q = len(state), input_matrix.shape[-1], disturbance_matrix.shape[-1]
        shapes = drift.shape, input_matrix.shape, disturbance_matrix.shape
        if shapes != ((n,), (n, m), (n, q)):
            raise ValueError(
                f"{name}: f, g and E have the shapes {shapes}; with {n} states they"
                f" must be ({n},), ({n}, m) and ({n}, q)"
            )
        self.state = state
        names = tuple(state_names or (f"x{i}" for i in range(n)))
        about = DeclaredStates(names, wrapping(wrapped_states), position)
        limits = np.full(m, np.inf) if effort_limits is None else effort_limits
        self._describe(about, disturbance_matrix, name, limits)
        x = tuple(variable(f"x{i}") for i in range(n))
        nodes = dict(zip(state, x, strict=True))
        f, g = read(drift, nodes), read(input_matrix, nodes)
        E = read(disturbance_matrix, {})
        self.dynamics = Dynamics(x, tuple(f), rows_of(g), rows_of(E))
        self._f_and_g = compile_nodes(x, [*f, *g.flat], f"{name}, f and g")
        u = np.array([variable(f"u{j}") for j in range(m)], dtype=object)
        self.compiled_rate = compile_nodes([*x, *u], f + g @ u, f"{name}, f + g u")

    def _describe(
        self,
        about: DeclaredStates,
        disturbance_matrix: Array,
        name: str,
        effort_limits: Array,
    ) -> None:
        """Sets the attributes that every model has."""
        n, q = disturbance_matrix.shape
        if q and np.linalg.matrix_rank(disturbance_matrix) < q:
            raise ModelError(
                f"{name}: the columns of the disturbance matrix E are dependent, so"
                " the motion does not tell one disturbance from another"
            )
        self.num_states, self.num_disturbances = n, q
        self.num_inputs, self.effort_limits = len(effort_limits), effort_limits
        self.disturbance_matrix, self.name = disturbance_matrix, name
        self.state_names, self.position = about.names, about.position
        if self.position is None:
            self.position = named_position(about.names)
        self.wrapping_periods = self._periods(about.periods)
        wraps = np.isfinite(self.wrapping_periods).nonzero()[0].tolist()
        self._wraps = [(i, float(self.wrapping_periods[i])) for i in wraps]
        self.speed_matrix = np.asarray(np.linalg.pinv(disturbance_matrix), dtype=float)
        self.make_manoeuvres: MakeManoeuvres | None = None

    @classmethod
    @typed
    def from_system(
        cls,
        system: System,
        input_port: PortChoice = None,
        disturbance_port: PortChoice = None,
        context: Context | None = None,
        symbolic: bool = False,
    ) -> ControlAffineModel:
        """Derives the model of a Drake System or Diagram.

        A MultibodyPlant, also in a Diagram without further states, gives a
        `MultibodyModel`. For any other System f, g and E are derived symbolically, so
        it has to convert to symbolic.

        Args:
            system: The System; all its state must be continuous.
            input_port: The port of u: an InputPort, its name or its index; None for the
                one called "input" or, as a MultibodyPlant's actuators are, "actuation",
                or the only vector input port beside the disturbance's.
            disturbance_port: The port of d, likewise; None for the port called
                "disturbance" if there is one, else q = 0.
            context: Holds the parameters, and values for the other input ports; None
                for the defaults. Other ports without a value are left unconnected if
                the System tolerates it, and held at 0 if not.
            symbolic: Whether a MultibodyPlant is derived symbolically too, as
                certificates between ticks and relative degrees other than 1 and 2
                require. It takes long beyond six joints.

        Raises:
            ModelError: The System is not symbolic, has a state that is not continuous
                or none at all, depends on time, is not affine in u and d, E is not
                constant or lacks rank, the ports are not what is needed, or pydrake's
                expressions give other rates than the System itself.
        """
        # The only import upwards: the model of a MultibodyPlant extends this class.
        from vcbf_drake.model.multibody_model import MultibodyModel

        disturbance = find_disturbance_port(system, disturbance_port)
        port = find_input_port(system, input_port, disturbance)
        ports = Ports(port, disturbance, context)
        is_plant, about = plant_of(system) is not None, declared_states(system)
        if is_plant and not symbolic:
            return MultibodyModel(ports)
        state, f, g, E = symbolic_dynamics(ports)
        model = cls(
            state=state,
            drift=f,
            input_matrix=g,
            disturbance_matrix=E,
            state_names=about.names,
            name=name_of(system),
            effort_limits=effort_limits_of(system, port),
            wrapped_states=about.periods,
            position=about.position,
        )
        if is_plant or not model.num_disturbances:
            model.speed_matrix = np.eye(model.num_states)[[*about.velocities]]
        _require_same_rates(model, numeric_dynamics(ports).rate)
        model.make_manoeuvres = getattr(system, "make_manoeuvres", None)
        return model

    def manoeuvres(
        self, lower: Array, upper: Array, period: float, disturbance_bound: float
    ) -> Sequence[Manoeuvre]:
        """Returns the plant's backup manoeuvres, one at least.

        Args:
            lower: The least inputs, shape (m,).
            upper: The greatest inputs, shape (m,).
            period: The hold period [s].
            disturbance_bound: delta1 [m/s^2].

        Raises:
            ModelError: The plant has none, or none that is safe under these limits.
        """
        if self.make_manoeuvres is None:
            raise ModelError(
                f"{self.name} has no backup manoeuvre: give the plant a method"
                " make_manoeuvres"
            )
        found = self.make_manoeuvres(lower, upper, disturbance_bound, period)
        if not found:
            raise ModelError(
                f"no backup manoeuvre of {self.name} is safe with these input limits"
                f" and |d| <= {disturbance_bound:g} m/s^2"
            )
        return found

    def difference(self, x_1: Array, x_0: Array) -> Array:
        """Returns x_1 - x_0, shape (..., n), the short way round in wrapped states."""
        difference: Array = np.subtract(x_1, x_0)
        for state, period in self._wraps:
            turns = np.rint(difference[..., state] / period)
            difference[..., state] -= period * turns
        return difference

    def _periods(self, wrapped_states: Mapping[str, float]) -> Array:
        periods = np.full(self.num_states, np.inf)
        for state, period in wrapped_states.items():
            is_period = isinstance(period, Real) and float(period) > 0.0
            if state not in self.state_names or not is_period:
                raise ModelError(
                    f"{self.name}: wrapped_states has {state!r}, period {period!r}; it"
                    f" must be one of {', '.join(self.state_names)}, and above 0"
                )
            periods[self.state_names.index(state)] = period
        return periods

    def position_of(self, x: Expressions, size: int) -> Expressions:
        """Returns the position in a state, symbolic or not: its first coordinates.

        Args:
            x: The state, shape (n,).
            size: The number of coordinates.

        Raises:
            ModelError: The plant names no position, or one of fewer dimensions.
        """
        way_out = (
            "say where it is, to .barrier(): position="
            f"[{', '.join('ijk'[:size])}], the {size} states,"
            " or a function of x (point_position, for a point of a MultibodyPlant)"
        )
        if self.position is None:
            raise ModelError(
                f"{self.name} does not say which of its states"
                f" ({', '.join(self.state_names)}) are its position; {way_out}"
            )
        if callable(self.position):
            found = self.position(x)
        else:
            found = x[list(self.position)]
        if len(found) < size:
            raise ModelError(
                f"it is in {size} dimensions, the position of {self.name} in"
                f" {len(found)}: leave a coordinate out, or {way_out}"
            )
        return found[:size]

    def drift(self, x: Array) -> Array:
        """Evaluates f(x), shape (n,), in state units per second."""
        return self.drift_and_input_matrix(x)[0]

    def input_matrix(self, x: Array) -> Array:
        """Evaluates g(x), shape (n, m)."""
        return self.drift_and_input_matrix(x)[1]

    def drift_and_input_matrix(self, x: Array) -> tuple[Array, Array]:
        """Evaluates f(x), shape (n,), and g(x), shape (n, m), at once.

        Raises:
            ValueError: x has the wrong shape, or f or g no real value there.
            ArithmeticError: f or g is singular at x.
        """
        n, values = self.num_states, np.array(self._f_and_g(*self._checked(x).tolist()))
        return values[:n], values[n:].reshape(n, self.num_inputs)

    def _checked(self, x: Array) -> Array:
        x, n = np.asarray(x, dtype=float), self.num_states
        if x.shape != (n,):
            raise ValueError(f"{self.name}: x has shape {x.shape}; it must be ({n},)")
        return x

    def nominal_rate(self, x: Array, u: Array) -> Array:
        """Evaluates f(x) + g(x) u, shape (n,): dx/dt without disturbance.

        Raises:
            TypeError: x or u has the wrong shape.
            ValueError: f or g has no real value at x.
            ArithmeticError: f or g is singular at x.
        """
        return np.array(self.compiled_rate(*x.tolist(), *u.tolist()))


def _require_same_rates(
    model: ControlAffineModel, rate: Callable[[Array, Array, Array], Array]
) -> None:
    """Compares the model's dx/dt with the System's own, in plain numbers (E1)."""
    n, m, E = model.num_states, model.num_inputs, model.disturbance_matrix
    # Beyond its effort limits a plant clamps its inputs.
    limits = np.fmin(model.effort_limits, np.finfo(float).max)

    def parts(point: Array) -> tuple[Array, Array, Array]:
        x, u, d = np.split(point, [n, n + m])
        return unit_quaternions(x, model.state_names), np.clip(u, -limits, limits), d

    def derived(point: Array) -> Array:
        x, u, d = parts(point)
        f, g = model.drift_and_input_matrix(x)
        return np.concatenate([f + g @ u, model.nominal_rate(x, u)]) + np.tile(E @ d, 2)

    def own(point: Array) -> Array:
        return np.tile(rate(*parts(point)), 2)

    def describe(point: Array) -> str:
        x, u, d = (", ".join(f"{value:.6g}" for value in part) for part in parts(point))
        return f"x = [{x}], u = [{u}]" + (f", d = [{d}]" if d else "")

    points = sample_points(n + m + E.shape[1])
    names = [f"{model.name}: the derivative of {state}" for state in model.state_names]
    require_agreement(derived, own, points, describe, names)
