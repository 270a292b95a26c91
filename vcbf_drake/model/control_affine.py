"""The control-affine model dx/dt = f(x) + g(x) u + E d of any Drake System."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from functools import cached_property
import math

import numpy as np
from pydrake.symbolic import Expression, Jacobian, MakeVectorVariable

from vcbf_drake.between_ticks.interval import Number
from vcbf_drake.between_ticks.interval_function import interval_function
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.agreement import require_agreement, sample_points
from vcbf_drake.model.compiled import (
    CompiledFunction,
    Expressions,
    compile_expressions,
)
from vcbf_drake.model.symbolic_dynamics import (
    Context,
    PortChoice,
    SymbolicDynamics,
    System,
    symbolic_dynamics,
)

# What pydrake.symbolic raises where an expression has no value: 1 / 0, sqrt(-1).
_NO_VALUE = (RuntimeError, ValueError)


class ControlAffineModel:
    """The functions f and g and the matrix E of dx/dt = f(x) + g(x) u + E d (E1).

    Args:
        state: The state's variables, shape (n,).
        drift: f(x), shape (n,), expressions over `state`.
        input_matrix: g(x), shape (n, m), expressions over `state`.
        disturbance_matrix: E, shape (n, q), constant, of full column rank.
        state_names: What the states are called; None for x0, x1, ...
        name: What the model is called in messages.
        effort_limits: Where the plant itself clamps its inputs; None for nowhere.
        wrapped_states: The names of angles that may jump by 2 pi; or of states that
            jump by other periods, with these.

    Attributes:
        num_states: n.
        num_inputs: m.
        num_disturbances: q; 0 for a model without a disturbance.
        state: The state's variables, shape (n,).
        drift_expressions: f(x), shape (n,).
        input_matrix_expressions: g(x), shape (n, m).
        disturbance_matrix: E, shape (n, q).
        state_names: What the states are called, n names.
        name: What the model is called in messages.
        effort_limits: How large |u_j| may be, shape (m,): beyond it the plant clamps
            its input (a MultibodyPlant does) and is not this model. Infinite for most.
        wrapping_periods: After how much a state is the same again, shape (n,); infinite
            for most.

    Raises:
        ModelError: E does not have full column rank.
        ValueError: The shapes do not fit.
    """

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
    ) -> None:
        n, m, q = len(state), input_matrix.shape[-1], disturbance_matrix.shape[-1]
        shapes = drift.shape, input_matrix.shape, disturbance_matrix.shape
        if shapes != ((n,), (n, m), (n, q)):
            raise ValueError(
                f"{name}: f, g and E have the shapes {shapes}; with {n} states they"
                f" must be ({n},), ({n}, m) and ({n}, q)"
            )
        if q and np.linalg.matrix_rank(disturbance_matrix) < q:
            raise ModelError(
                f"{name}: the columns of the disturbance matrix E are dependent, so"
                " the motion does not tell one disturbance from another"
            )
        self.num_states, self.num_inputs, self.num_disturbances = n, m, q
        self.state = state
        self.drift_expressions = drift
        self.input_matrix_expressions = input_matrix
        self.disturbance_matrix = disturbance_matrix
        self.state_names = tuple(state_names or (f"x{i}" for i in range(n)))
        self.name = name
        self.effort_limits = (
            np.full(m, np.inf) if effort_limits is None else effort_limits
        )
        self.wrapping_periods = self._periods(wrapped_states)
        self._f_and_g = compile_expressions(
            state, [*drift, *input_matrix.flat], name=f"{name}, f and g"
        )
        self._nominal_rate = _compiled_rate(state, drift, input_matrix, name)

    @classmethod
    def from_system(
        cls,
        system: System,
        input_port: PortChoice = None,
        disturbance_port: PortChoice = None,
        context: Context = None,
    ) -> ControlAffineModel:
        """Derives the model of a Drake System, or Diagram, that converts to symbolic.

        Args:
            system: The System; all its state must be continuous.
            input_port: The port of u: an InputPort, its name or its index; None for the
                only vector input port beside the disturbance's.
            disturbance_port: The port of d, likewise; None for the port called
                "disturbance" if there is one, else q = 0.
            context: Holds the parameters, and values for the other input ports; None
                for the defaults. Other ports without a value are left unconnected if
                the System tolerates it, and held at 0 if not.

        Raises:
            ModelError: The System is not symbolic, has a state that is not continuous
                or none at all, depends on time, is not affine in u and d, E is not
                constant or lacks rank, the ports are not what is needed, or pydrake's
                expressions give other rates than the System itself.
        """
        dynamics = symbolic_dynamics(system, input_port, disturbance_port, context)
        m = len(dynamics.input)
        parts = _solve(dynamics.mass_matrix, _affine_parts(dynamics))
        model = cls(
            state=dynamics.state,
            drift=parts[:, 0],
            input_matrix=parts[:, 1 : 1 + m],
            disturbance_matrix=_constant_matrix(parts[:, 1 + m :], dynamics),
            state_names=dynamics.state_names,
            name=dynamics.name,
            effort_limits=dynamics.effort_limits,
            wrapped_states=getattr(system, "wrapped_states", ()),
        )
        _require_same_rates(model, dynamics)
        return model

    @cached_property
    def content(self) -> Hashable:
        """The text of f and g, and E: equal for models that read the same."""
        f, g = self.drift_expressions, self.input_matrix_expressions
        E = self.disturbance_matrix
        return tuple(str(e) for e in (*f, *g.flat)), E.shape, E.tobytes()

    def difference(self, x_1: Array, x_0: Array) -> Array:
        """Returns x_1 - x_0, shape (..., n), the short way round in wrapped states."""
        difference: Array = np.subtract(x_1, x_0)
        wraps = np.isfinite(self.wrapping_periods)
        if wraps.any():
            periods = self.wrapping_periods[wraps]
            turns = np.round(difference[..., wraps] / periods)
            difference[..., wraps] -= periods * turns
        return difference

    def _periods(self, wrapped_states: Sequence[str] | Mapping[str, float]) -> Array:
        if not isinstance(wrapped_states, Mapping):
            wrapped_states = dict.fromkeys(wrapped_states, 2.0 * math.pi)
        periods = np.full(self.num_states, np.inf)
        for state, period in wrapped_states.items():
            if state not in self.state_names or not period > 0.0:
                raise ModelError(
                    f"{self.name}: wrapped_states has {state!r}, period {period!r}; it"
                    f" must be one of {', '.join(self.state_names)}, and above 0"
                )
            periods[self.state_names.index(state)] = period
        return periods

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
        x = np.asarray(x, dtype=float)
        n = self.num_states
        if x.shape != (n,):
            raise ValueError(f"{self.name}: x has shape {x.shape}; it must be ({n},)")
        values = np.array(self._f_and_g(*x.tolist()))
        return values[:n], values[n:].reshape(n, self.num_inputs)

    def nominal_rate(self, x: Array, u: Array) -> Array:
        """Evaluates f(x) + g(x) u, shape (n,): dx/dt without disturbance.

        Raises:
            TypeError: x or u has the wrong shape.
            ValueError: f or g has no real value at x.
            ArithmeticError: f or g is singular at x.
        """
        return np.array(self._nominal_rate(*x.tolist(), *u.tolist()))

    def nominal_rate_over(
        self, box: Sequence[Number], inputs: Sequence[Number]
    ) -> list[Number]:
        """Encloses f(x) + g(x) u, n entries, for all states and inputs of a box.

        Args:
            box: Where x is, n intervals or numbers.
            inputs: Where u is, m of them.

        Raises:
            ModelError: f or g has no enclosure on intervals.
            ArithmeticError: f or g is singular somewhere in the box.
            ValueError: f or g has no real value somewhere in the box.
        """
        return interval_function(self._nominal_rate)(*box, *inputs)


# Arithmetic of expressions leaves floating-point flags that NumPy takes for its own.
@np.errstate(invalid="ignore")
def _compiled_rate(
    state: Expressions, drift: Expressions, input_matrix: Expressions, name: str
) -> CompiledFunction:
    u = MakeVectorVariable(input_matrix.shape[1], "u")
    rate = drift + input_matrix @ u
    return compile_expressions([*state, *u], rate, f"{name}, f + g u")


def _require_same_rates(model: ControlAffineModel, dynamics: SymbolicDynamics) -> None:
    """Compares the model's dx/dt with the System's own, in plain numbers (E1)."""
    n, m, E = model.num_states, model.num_inputs, model.disturbance_matrix
    # Beyond its effort limits a plant clamps its inputs.
    limits = np.fmin(model.effort_limits, np.finfo(float).max)

    def parts(point: Array) -> tuple[Array, Array, Array]:
        x, u, d = np.split(point, [n, n + m])
        return _unit_quaternions(x, model.state_names), np.clip(u, -limits, limits), d

    def derived(point: Array) -> Array:
        x, u, d = parts(point)
        f, g = model.drift_and_input_matrix(x)
        return np.concatenate([f + g @ u, model.nominal_rate(x, u)]) + np.tile(E @ d, 2)

    def own(point: Array) -> Array:
        return np.tile(dynamics.rate(*parts(point)), 2)

    def describe(point: Array) -> str:
        x, u, d = (", ".join(f"{value:.6g}" for value in part) for part in parts(point))
        return f"x = [{x}], u = [{u}]" + (f", d = [{d}]" if d else "")

    points = sample_points(n + m + E.shape[1])
    names = [f"{model.name}: the derivative of {state}" for state in model.state_names]
    require_agreement(derived, own, points, describe, names)


def _unit_quaternions(x: Array, names: Sequence[str]) -> Array:
    """The state with its quaternions, as a MultibodyPlant names them, made unit."""
    x = x.copy()
    for i, name in enumerate(names):
        if name.endswith("_qw"):
            x[i : i + 4] /= np.linalg.norm(x[i : i + 4])
    return x


def _affine_parts(dynamics: SymbolicDynamics) -> Expressions:
    """The parts [F0, F1], shape (n, 1 + m + q), of F = F0(x) + F1(x) [u; d]."""
    w = np.concatenate([dynamics.input, dynamics.disturbance])
    rows = [_affine_row(force, dynamics.state, w) for force in dynamics.force]
    for state, row in zip(dynamics.state_names, rows, strict=True):
        if row is None:
            raise ModelError(
                f"{dynamics.name}: the derivative of {state} is not affine in the"
                " input and the disturbance; choose a port behind what is not, and"
                " give limits to the InputSet (a MultibodyPlant in a Diagram drops its"
                " own by RemoveAllJointActuatorEffortLimits)"
            )
    return np.array(rows)


def _affine_row(
    force: Expression, x: Expressions, w: Expressions
) -> Expressions | None:
    """The parts [F0, F1] of a force F0(x) + F1(x) w; None if it is not affine in w."""
    zero = {variable: 0.0 for variable in w}
    try:
        gradient = Jacobian([force], w)[0]
        row = np.array([e.Substitute(zero) for e in (force, *gradient)])
    except _NO_VALUE:
        return None
    # A gradient may hold w only for want of simplification: numbers tell.
    used = {v.get_id() for e in gradient for v in e.GetVariables()}
    structural = used.isdisjoint(v.get_id() for v in w)
    return row if structural or _agree(force, row, x, w) else None


def _agree(force: Expression, row: Expressions, x: Expressions, w: Expressions) -> bool:
    """Whether F(x, w) = row . [1; w] at random points, near and far."""
    random = np.random.default_rng(0)
    errors = []
    for scale in np.geomspace(1e-3, 1e3, 25):
        x_value = random.normal(size=len(x))
        w_value = scale * random.normal(size=len(w))
        point = dict(zip([*x, *w], [*x_value, *w_value], strict=True))
        try:
            terms = np.array([e.Evaluate(point) for e in row]) * [1.0, *w_value]
            error = force.Evaluate(point) - terms.sum()
        except _NO_VALUE:
            continue
        errors.append(abs(error) / (np.abs(terms).max() or 1.0))
    return bool(errors) and max(errors) < 1e-9


@np.errstate(invalid="ignore")
def _solve(M: Expressions, R: Expressions) -> Expressions:
    """Solves M X = R for X, shape (n, k), by Gaussian elimination.

    Without pivoting: M is the identity, or a positive definite matrix of inertia.
    """
    M, X = M.copy(), np.array(R)
    for k in range(len(M)):
        for i in range(k + 1, len(M)):
            if not M[i, k].EqualTo(0.0):
                factor = M[i, k] / M[k, k]
                M[i, k + 1 :] = M[i, k + 1 :] - factor * M[k, k + 1 :]
                X[i] = X[i] - factor * X[k]
    for i in reversed(range(len(M))):
        X[i] = (X[i] - M[i, i + 1 :] @ X[i + 1 :]) / M[i, i]
    return X


def _constant_matrix(E: Expressions, dynamics: SymbolicDynamics) -> Array:
    """The numbers of E, shape (n, q)."""
    matrix = np.empty(E.shape)
    for (i, j), entry in np.ndenumerate(E):
        value = _constant(entry, dynamics.state)
        if value is None:
            raise ModelError(
                f"{dynamics.name}: the disturbance matrix E is not constant:"
                f" disturbance {j} acts on the derivative of"
                f" {dynamics.state_names[i]} differently from state to state"
            )
        matrix[i, j] = value
    return matrix


def _constant(entry: Expression, x: Expressions) -> float | None:
    """The value of an expression that is the same at random points, else None."""
    points = np.random.default_rng(0).normal(size=(8, len(x)))
    try:
        values = [entry.Evaluate(dict(zip(x, point, strict=True))) for point in points]
    except _NO_VALUE:
        return None
    same = np.ptp(values) <= 1e-9 * np.max(np.abs(values))
    return float(values[0]) if same else None
