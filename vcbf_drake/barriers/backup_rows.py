"""BackupRows: barrier rows along the flow of a backup law (backup barriers)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.barrier_set import BarrierSet
from vcbf_drake.barriers.chain import TIME
from vcbf_drake.barriers.rows import BarrierRows, barrier_formula
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.formulas import CompiledFunction, compile_nodes, read
from vcbf_drake.model.graph import gradients
from vcbf_drake.model.manoeuvre import Manoeuvre

# At how many instants of the way there is a row; below which rates of the states and of
# their sensitivities the way has ended.
_INSTANTS = 60
_AT_REST = 1e-3


class BackupRows:
    r"""A row for each barrier and each of K instants of a backup law's flow (E68).

    With phi_tau(x) the state to which the law leads from x in a time tau, and Phi its
    derivative by x, the row of barrier i and instant tau_j is

    .. math:: \nabla h_i^\top \Phi (f + g u + E d) + \partial_t h_i
              \ge -\alpha_i (h_i(\phi_{\tau_j}(x)) - \mu |\nabla h_i|)

    where alpha_i s is the largest decay rate of the barrier times s, or its own class-K
    function of s, and mu the margin. Of several laws, that with the largest clearance
    along its flow is used.

    Source: Gurriet et al. (2020), Chen et al. (2021); the margin and the choice of
    alpha are ours.

    Attributes:
        names: The names of the rows.
    """

    def __init__(
        self,
        model: ControlAffineModel,
        barriers: Sequence[Any],
        barrier_set: BarrierSet,
        manoeuvres: Sequence[Manoeuvre],
        margin: float,
    ) -> None:
        """Derives the laws' flows and the barriers' gradients.

        Args:
            model: The plant.
            barriers: The barriers.
            barrier_set: The same barriers as a set.
            manoeuvres: The manoeuvres whose smooth laws are used, at least one.
            margin: The clearance of the flow from every barrier, in units of x.

        Raises:
            ModelError: No manoeuvre has a smooth law, or the model or a barrier no
                formula to derive.
        """
        self._model, self._margin, self._barrier_set = model, margin, barrier_set
        smooth = [each for each in manoeuvres if each.horizon > 0.0]
        if not smooth:
            raise ModelError(f"method backup: {model.name} has no backup law")
        self._flows = [_Flow(model, each) for each in smooth]
        self._heights = [
            _height(model, each) if isinstance(each, Barrier) else None
            for each in barriers
        ]
        self._barriers = tuple(barriers)
        counts = [1 if each is None else _INSTANTS for each in self._heights]
        self._counts = counts
        self.names = tuple(
            name if count == 1 else f"{name}, {j} of {count} on the way"
            for name, count in zip(barrier_set.names, counts, strict=True)
            for j in range(1, count + 1)
        )

    def most_of_each(self, of_rows: Array) -> Array:
        """Returns the maximum over each barrier's rows, shape (..., N).

        Args:
            of_rows: A number of every row, shape (..., rows).
        """
        first = np.cumsum([0, *self._counts[:-1]])
        return np.maximum.reduceat(of_rows, first, axis=-1)

    # A flow that overflows gives rows that are not finite, and a status that says so.
    @np.errstate(over="ignore", invalid="ignore")
    def rows(self, x: Array, t: float, known: BarrierRows, seen: Any) -> BarrierRows:
        """Returns the rows at one state and time; nan where a flow or h is singular.

        Args:
            x: The state, shape (n,).
            t: The time [s].
            known: The barriers' own rows there; limits of the input are taken over.
            seen: The perceived obstacles, shape (obstacles_size,); None without.
        """
        # An empty slot has no h: its row is taken over too.
        parameters = [
            each.parameters if each.relative_degree else None
            for each in self._barrier_set.functions_at(t, seen)
        ]
        ways = [self._way(flow, x, t, parameters) for flow in self._flows]
        way = max(
            ways, key=lambda each: min((h.value.min() for h in each if h), default=0.0)
        )
        f, g = (
            np.full(len(x), np.nan),
            np.full((len(x), self._model.num_inputs), np.nan),
        )
        if np.isfinite(x).all():
            f, g = self._model.drift_and_input_matrix(x)
        E = self._model.disturbance_matrix
        numbers = []
        for i, (barrier, h) in enumerate(zip(self._barriers, way, strict=True)):
            if h is None:
                same = [np.nan], known.A[i], known.b[i : i + 1], known.w[i]
                numbers.append(np.tile(np.concatenate(same), (self._counts[i], 1)))
                continue
            spare = h.value - self._margin * h.steepness
            b = h.slope @ f + h.rate + _class_k(barrier, spare)
            numbers.append(np.column_stack([h.value, -h.slope @ g, b, h.slope @ E]))
        found, m = np.concatenate(numbers), self._model.num_inputs
        width = found.shape[1] - 1
        return BarrierRows(
            value=found[:, 0],
            chain=(),
            A=found[:, 1 : m + 1],
            b=found[:, m + 1],
            w=found[:, m + 2 :],
            num_states=self._model.num_states,
            gradients=lambda rows: np.full((len(rows), width, len(x) + 1), np.nan),
        )

    def _way(
        self,
        flow: _Flow,
        x: Array,
        t: float,
        parameters: Sequence[tuple[float, ...] | None],
    ) -> list[_Heights | None]:
        """Every barrier along the flow from a state."""
        states, sensitivities = flow.from_state(x)
        return [
            None
            if height is None or each is None
            else _along(height, states, sensitivities, t + flow.times, each)
            for height, each in zip(self._heights, parameters, strict=True)
        ]


def _class_k(barrier: Barrier, spare: Array) -> Array:
    """alpha(h - margin), shape (K,)."""
    if barrier.class_k is None:
        return float(barrier.decay_rates[0]) * spare
    return np.array([barrier.class_k(each) for each in spare.tolist()], dtype=float)


class _Heights(NamedTuple):
    """A barrier at K states that a flow leads to from x.

    Attributes:
        value: h there, shape (K,).
        slope: Its derivatives by x, shape (K, n).
        rate: Its partial derivatives by time, shape (K,).
        steepness: The norms of its gradients there, shape (K,).
    """

    value: Array
    slope: Array
    rate: Array
    steepness: Array


def _along(
    height: CompiledFunction,
    states: Array,
    sensitivities: Array,
    times: Array,
    parameters: tuple[float, ...],
) -> _Heights:
    """Returns a barrier at the states of a flow; all nan where it is singular."""
    n = states.shape[1]
    try:
        points = np.column_stack([states, times]).tolist()
        found = np.array([height(*point, *parameters) for point in points])
    except (ArithmeticError, ValueError):
        found = np.full((len(states), n + 2), np.nan)
    gradient = found[:, 1 : n + 1]
    slope = np.einsum("kn,knm->km", gradient, sensitivities)
    return _Heights(found[:, 0], slope, found[:, -1], np.linalg.norm(gradient, axis=1))


def _height(model: ControlAffineModel, barrier: Barrier) -> CompiledFunction:
    """Returns a function of x, t and p: h, its gradient by x and by t."""
    formula = barrier_formula(model, barrier)
    x = [*formula.dynamics.x, TIME]
    slopes = gradients([formula.h], x).ravel()
    arguments = [*x, *formula.parameters]
    return compile_nodes(arguments, [formula.h, *slopes], "height")


class _Flow:
    """The flow of a plant under a smooth backup law, without a disturbance.

    Attributes:
        times: The instants tau_j, shape (K,) [s].
    """

    def __init__(self, model: ControlAffineModel, manoeuvre: Manoeuvre) -> None:
        self._step = manoeuvre.horizon / _INSTANTS
        self.times = self._step * np.arange(1.0, _INSTANTS + 1.0)
        dynamics = model.dynamics
        law = manoeuvre.law(np.array([Expression(v) for v in model.state]))
        u = read(law, dict(zip(model.state, dynamics.x, strict=True)))
        rate = np.array(dynamics.f, dtype=object)
        rate = rate + np.array(dynamics.g, dtype=object) @ u
        slopes = gradients(rate, dynamics.x).ravel()
        self._rate = compile_nodes(dynamics.x, [*rate, *slopes], "backup_flow")

    def from_state(self, x: Array) -> tuple[Array, Array]:
        """Returns phi_tau(x), (K, n), and its derivatives, (K, n, n).

        By Runge and Kutta's steps of the flow and its variational equation.
        """
        n = len(x)
        states, sensitivities = np.empty((_INSTANTS, n)), np.empty((_INSTANTS, n, n))
        # State and sensitivity side by side.
        now = np.column_stack([x, np.eye(n)])
        for k in range(_INSTANTS):
            k1 = self._moved(now)
            if np.abs(k1).max() < _AT_REST:  # Sensitivities, too.
                states[k:], sensitivities[k:] = now[:, 0], now[:, 1:]
                break
            k2 = self._moved(now + 0.5 * self._step * k1)
            k3 = self._moved(now + 0.5 * self._step * k2)
            k4 = self._moved(now + self._step * k3)
            now = now + self._step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            states[k], sensitivities[k] = now[:, 0], now[:, 1:]
        return states, sensitivities

    def _moved(self, now: Array) -> Array:
        n = len(now)
        try:
            numbers = np.array(self._rate(*now[:, 0].tolist()))
        except (ArithmeticError, ValueError):
            return np.full(now.shape, np.nan)
        moved = np.empty_like(now)
        moved[:, 0] = numbers[:n]
        np.matmul(numbers[n:].reshape(n, n), now[:, 1:], out=moved[:, 1:])
        return moved
