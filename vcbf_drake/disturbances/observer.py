"""What disturbance observers share: ports, memory, and what an interval tells."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    CacheEntry,
    Context,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from vcbf_drake.checks import Array
from vcbf_drake.disturbances.bounds import (
    Basis,
    Condition,
    DisturbanceBounds,
    ErrorBound,
)
from vcbf_drake.disturbances.estimate import DisturbanceEstimate
from vcbf_drake.errors import ModelError

if TYPE_CHECKING:
    from vcbf_drake.model import ControlAffineModel


class DisturbanceObserver(LeafSystem):
    """Estimates d in ``xdot = f(x) + g(x) u + E d`` from sampled states.

    .. pydrake_system::

        name: DisturbanceObserver
        input_ports:
        - state
        - input
        - reset (optional)
        output_ports:
        - estimate
        - disturbance_estimate

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``input`` | m | the input held since the last tick |
    | ``reset`` | 1 | not 0 at a tick: all that was measured is forgotten there |
    | ``estimate`` | 2q + 2 | a `DisturbanceEstimate`, with its error bound |
    | ``disturbance_estimate`` | q | dhat alone, for controllers [m/s^2] |

    Only the disturbed channels are observed. At a tick the outputs use the state
    measured there and the input held up to there, so there is no lag of a tick. Between
    ticks they are as if the next tick were now. They are feedthrough of both inputs:
    `input` has to come from a hold. The first tick only takes the state.

    While the state or the input is not finite, the estimate keeps its value, and an
    interval that begins or ends there tells nothing. The error bound assumes that there
    are no such gaps; it counts time from the first measurement. After a longer interval
    than `longest_interval`, or when time goes back, the observer begins anew: its
    estimate is 0 and its error bound is what it was at first.

    Attributes:
        bounds: delta1, delta2 and delta3 (E8).
        basis: What the error bound rests on; only ``proven`` and ``worst case`` are
            certain.
        estimate_gain: How the unknown error drives the estimate [1/s] (E26):
            d(dhat)/dt = estimate_rate + estimate_gain (d - dhat).
        longest_interval: The longest time between measurements that is bridged [s];
            infinite unless given.
    """

    bounds: DisturbanceBounds
    basis: Basis
    estimate_gain: float

    def __init__(
        self,
        model: ControlAffineModel,
        period: float,
        bounds: DisturbanceBounds,
        *,
        memory_size: int,
        error_bound: ErrorBound,
        basis: Basis,
        estimate_gain: float,
        longest_interval: float | None = None,
    ) -> None:
        """Initialises what all observers share.

        Args:
            model: Gives f, g and E.
            period: Time between measurements [s].
            bounds: delta1, delta2 and delta3 of the disturbance (E8).
            memory_size: How many numbers the observer remembers, all 0 at the start.
            error_bound: The bound of its error.
            basis: See the attribute.
            estimate_gain: See the attribute.
            longest_interval: See the attribute.

        Raises:
            ModelError: Two disturbances act on the state in the same way.
        """
        super().__init__()
        self.bounds = bounds
        self.basis = basis
        self.estimate_gain = estimate_gain
        self.longest_interval = max(period, longest_interval or math.inf)
        self._model = model
        self._period = period
        # What is nearer together is one time [s].
        self._instant = 1e-6 * period
        self._error_bound = error_bound
        self._disturbed = _left_inverse(model)
        n, m, q = model.num_states, model.num_inputs, model.num_disturbances
        self._state = self.DeclareVectorInputPort("state", n)
        self._input = self.DeclareVectorInputPort("input", m)
        self._reset = self.DeclareVectorInputPort("reset", 1)
        self._memory_start = 2 + n
        # Times of the first and the last measurement [s], the last measurement, memory.
        # NaN stands for no measurement.
        self._nothing = np.concatenate((np.full(2 + n, np.nan), np.zeros(memory_size)))
        self.DeclareDiscreteState(self._nothing)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self._posterior = self._declare_posterior()
        estimated = {self._posterior.ticket()}
        clocked = {self.time_ticket(), self.xd_ticket()}
        self.DeclareVectorOutputPort(
            "estimate",
            DisturbanceEstimate.packed_size(q),
            self._calc_estimate,
            estimated | clocked,
        )
        self.DeclareVectorOutputPort(
            "disturbance_estimate", q, self._calc_disturbance_estimate, estimated
        )

    @property
    def period(self) -> float:
        """Time between measurements [s]."""
        return self._period

    @property
    def certified_interval(self) -> float:
        """The time between measurements that the error bound is for [s]."""
        is_given = math.isfinite(self.longest_interval)
        return self.longest_interval if is_given else self._period

    def error_bound(self, t: float) -> float:
        """Returns the error bound a time t [s] after the first measurement [m/s^2]."""
        return self._error_bound.value(t)

    def gain_conditions(self) -> tuple[Condition, ...]:
        """Returns the inequalities that the error bound rests on."""
        return ()

    def _advance(self, memory: Array, mean: Array, elapsed: float) -> Array:
        """Returns the memory after an interval whose mean disturbance was measured."""
        raise NotImplementedError

    def _estimate(self, memory: Array) -> Array:
        raise NotImplementedError

    def _estimate_rate(self, memory: Array) -> Array:
        raise NotImplementedError

    def _declare_posterior(self) -> CacheEntry:
        return self.DeclareCacheEntry(
            "posterior",
            ValueProducer(lambda: Value[object](), self._calc_posterior),
            {
                self._state.ticket(),
                self._input.ticket(),
                self.xd_ticket(),
                self.time_ticket(),
            },
        )

    def _calc_posterior(self, context: Context, posterior: Any) -> None:
        stored = context.get_discrete_state_vector().CopyToVector()
        memory = stored[self._memory_start :]
        elapsed = context.get_time() - float(stored[1])
        if self._is_gap(elapsed):
            memory = np.zeros_like(memory)
        elif elapsed > self._instant:
            x_0, x_1 = stored[2 : self._memory_start], self._state.Eval(context)
            if _is_finite(x_1):
                mean = self.mean_disturbance(
                    x_0, x_1, self._input.Eval(context), elapsed
                )
                if _is_finite(mean):
                    memory = self._advance(memory, mean, elapsed)
        memory.setflags(write=False)
        posterior.set_value(memory)

    def mean_disturbance(
        self, x_0: Array, x_1: Array, u: Array, elapsed: float
    ) -> Array:
        """Returns the mean of d between two measured states with u held (E46).

        The mean of f + g u is Simpson's, with the middle state on the cubic Hermite
        curve between the two.

        Args:
            x_0: The state at the beginning, shape (n,).
            x_1: The state at the end, shape (n,).
            u: The input, shape (m,).
            elapsed: The time between them [s].
        """
        rate = self._model.nominal_rate
        rate_0, rate_1 = rate(x_0, u), rate(x_1, u)
        x_middle = (x_0 + x_1) / 2 + elapsed / 8 * (rate_0 - rate_1)
        nominal = (rate_0 + 4 * rate(x_middle, u) + rate_1) / 6
        mean: Array = self._disturbed @ ((x_1 - x_0) / elapsed - nominal)
        return mean

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        """Stores the posterior, and the measurement it ends with."""
        if self._reset.HasValue(context) and self._reset.Eval(context)[0] != 0.0:
            discrete.set_value(self._nothing)
            return
        now, state = context.get_time(), self._state.Eval(context)
        last = now if _is_finite(state) else math.nan
        start = self._start(context)
        first = last if math.isnan(start) else start
        discrete.set_value(
            np.concatenate(((first, last), state, self._memory(context)))
        )

    def _memory(self, context: Context) -> Array:
        return cast(Array, self._posterior.Eval(context))

    def _calc_estimate(self, context: Context, output: BasicVector) -> None:
        memory, age = self._memory(context), self._age(context)
        estimate = DisturbanceEstimate(
            self._estimate(memory),
            self._estimate_rate(memory),
            np.array(self._error_bound.value(age)),
            np.array(self._error_bound.derivative(age)),
        )
        output.SetFromVector(estimate.pack())

    def _calc_disturbance_estimate(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._estimate(self._memory(context)))

    def _age(self, context: Context) -> float:
        """Returns the time since the first measurement, 0 before it [s]."""
        start = self._start(context)
        return 0.0 if math.isnan(start) else context.get_time() - start

    def _start(self, context: Context) -> float:
        """Returns the time of the first measurement [s]; nan before it and at a gap."""
        stored = context.get_discrete_state_vector()
        is_gap = self._is_gap(context.get_time() - stored[1])
        return math.nan if is_gap else float(stored[0])

    def _is_gap(self, elapsed: float) -> bool:
        least, most = -self._instant, self.longest_interval + self._instant
        return elapsed < least or elapsed > most


def nearest_in_ball(vector: Array, radius: float) -> Array:
    """Returns the point of a ball around 0 that is nearest to a vector."""
    size = float(np.linalg.norm(vector))
    return vector * (radius / size) if size > radius else vector


def _is_finite(vector: Array) -> bool:
    """Whether all numbers are finite: NaN and infinity survive a sum."""
    return math.isfinite(sum(vector.tolist()))


def _left_inverse(model: ControlAffineModel) -> Array:
    """Returns the pseudo-inverse of E, shape (q, n)."""
    E = np.asarray(model.disturbance_matrix, dtype=float)
    rank = np.linalg.matrix_rank(E) if E.size else 0
    if rank < E.shape[1]:
        raise ModelError(
            f"{model.name}: the disturbance matrix has rank {rank}; it must be"
            f" {E.shape[1]}, one for each disturbance"
        )
    return np.linalg.pinv(E)
