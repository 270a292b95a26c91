"""Disturbance observers: their ports, memory and mean disturbance of an interval."""

from __future__ import annotations

from functools import lru_cache
import math
from typing import Any, NamedTuple, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from vcbf_drake.checks import Array, check_parameter
from vcbf_drake.disturbances.bounds import (
    Basis,
    Condition,
    DisturbanceBounds,
    DisturbanceEstimate,
    ErrorBound,
)
from vcbf_drake.model import ControlAffineModel

# The amount by which an interval's mean may exceed delta1 before it is refused.
_EXCEEDED = 1.05
# Two measurements differ by less than this, in deviations of each, but for one of 10^8.
_JUMP_SIGMAS = 10.0
# The relative accuracy of a state after rounding and integration.
_ROUNDING = 1e-9
# The share by which the curvature of f + g u changes within an interval, apart from the
# effect of the plant's own rate (E42, the mean's quadrature).
_CHANGE = 0.05
# Weights of a function's values at both ends and in the middle: mean and bend.
_SIMPSON = np.array((1.0, 4.0, 1.0)) / 6.0
_SECOND_DIFFERENCE = np.array((1.0, -2.0, 1.0))
# Step of the numeric derivative, relative.
_DIFFERENCE = 1e-6


class IntervalMean(NamedTuple):
    """The mean disturbance of an interval, shape (q,), and its quadrature error (E42).

    f + g u is known at a few points only, so the error has a bound [m/s^2].
    """

    disturbance: Array
    quadrature: float


class _Posterior(NamedTuple):
    """The state of an observer after the last measurement.

    Attributes:
        memory: The memory of the observer's kind.
        since: The time at which the bound began to decay [s]; nan before the first
            measurement.
        excess: The size of the estimate at that time [m/s^2].
        quadrature: The largest error of a mean so far [m/s^2].
        refused: The number of intervals refused so far.
    """

    memory: Array
    since: float
    excess: float
    quadrature: float
    refused: float


class DisturbanceObserver(LeafSystem):
    """Estimates d in ``xdot = f(x) + g(x) u + E d`` from sampled states.

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``input`` | m | the input held since the last tick |
    | ``reset`` | 1 | not 0 at a tick: all measurements are forgotten there |
    | ``estimate`` | 2q + 4 | a `DisturbanceEstimate`, with its error bound |
    | ``disturbance_estimate`` | q | dhat alone, for controllers [m/s^2] |

    Only the disturbed channels are observed. At a tick the outputs use the state
    measured there and the input held up to there, so there is no lag of a tick. Between
    ticks they are as if the next tick were now. They are feedthrough of both inputs:
    `input` has to come from a hold. The first tick only takes the state.

    An interval is refused if it begins or ends with a state that is not finite, or if
    its mean disturbance exceeds what bounds, noise and quadrature allow, because the
    measured state jumped. The estimate then keeps its value, and the error bound
    restarts from the bound for an estimate of that size (E43). After a longer interval
    than `longest_interval`, or when time goes back, the observer restarts with the
    estimate 0 and its first error bound. A wrapping angle is no jump if the model names
    it (`ControlAffineModel.wrapping_periods`).

    Attributes:
        bounds: delta1, delta2 and delta3 (E16, bounds of the disturbance).
        basis: The basis of the error bound; only ``proven`` and ``worst case`` are
            certain.
        period: Time between measurements [s].
        estimate_gain: The gain from the unknown error to the estimate's rate [1/s]
            (E60): d(dhat)/dt = estimate_rate + estimate_gain (d - dhat).
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
        noise: float = 0.0,
        longest_interval: float | None = None,
    ) -> None:
        """Initialises the parts that all observers share.

        An observer remembers `memory_size` numbers, all 0 at the start; for the other
        arguments see the attributes and `RiseObserver`.
        """
        super().__init__()
        self.bounds = bounds
        self.basis = basis
        self.estimate_gain = estimate_gain
        if longest_interval is not None:
            check_parameter("longest_interval", longest_interval)
        self.longest_interval = max(period, longest_interval or math.inf)
        self._model = model
        self.period = period
        # Times that are nearer together count as one [s].
        self._instant = 1e-6 * period
        self._error_bound = error_bound
        self._noise = noise
        self._disturbed = np.linalg.pinv(model.disturbance_matrix)
        self._directions = model.disturbance_matrix.T.copy()
        # The sizes of the disturbed channels per unit of the states.
        self._units = np.abs(self._disturbed)
        self._largest_unit = float(self._units.max(initial=0.0))
        # Both arguments hardly ever change from tick to tick.
        self._bound_of = lru_cache(maxsize=16)(self._bound_after)
        n, m, q = model.num_states, model.num_inputs, model.num_disturbances
        self._state = self.DeclareVectorInputPort("state", n)
        self._input = self.DeclareVectorInputPort("input", m)
        self._reset = self.DeclareVectorInputPort("reset", 1)
        self._memory_start = 2 + n
        # When the bound's clock began, and the last measurement [s]; that; memory.
        # NaN stands for no measurement. Then what else a `_Posterior` holds.
        self._nothing = np.concatenate(
            (np.full(2 + n, np.nan), np.zeros(memory_size + 3))
        )
        self.DeclareDiscreteState(self._nothing)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        needs = {self._state.ticket(), self._input.ticket()}
        self._posterior = self.DeclareCacheEntry(
            "posterior",
            ValueProducer(lambda: Value[object](), self._calc_posterior),
            needs | {self.xd_ticket(), self.time_ticket()},
        )
        estimated = {self._posterior.ticket()}
        self.DeclareVectorOutputPort(
            "estimate",
            DisturbanceEstimate.packed_size(q),
            self._calc_estimate,
            estimated | {self.time_ticket()},
        )
        self.DeclareVectorOutputPort(
            "disturbance_estimate", q, self._calc_disturbance_estimate, estimated
        )

    @property
    def certified_interval(self) -> float:
        """The time between measurements that the error bound is for [s]."""
        is_given = math.isfinite(self.longest_interval)
        return self.longest_interval if is_given else self.period

    def error_bound(self, t: float) -> float:
        """Returns the error bound a time t [s] after the first measurement [m/s^2]."""
        return self._error_bound.value(t)

    def gain_conditions(self, quadrature: float = 0.0) -> tuple[Condition, ...]:
        """Returns the inequalities that the bound rests on, at a quadrature error."""
        return ()

    def _advance(self, memory: Array, mean: Array, elapsed: float) -> Array:
        """Returns the memory after an interval whose mean disturbance was measured."""
        raise NotImplementedError

    def _started_at(self, estimate: Array) -> Array:
        """Returns the memory of an observer that starts with an estimate."""
        return estimate

    def _bound_after(self, excess: float, quadrature: float) -> ErrorBound:
        """Returns the bound since a start (E43) with an estimate of a size (E42)."""
        bound = self._error_bound
        return ErrorBound(
            bound.amplitude + excess, bound.rate, bound.floor + quadrature
        )

    def _estimate(self, memory: Array) -> Array:
        """Returns dhat."""
        return memory

    def _estimate_rate(self, memory: Array) -> Array:
        """Returns the known part of d(dhat)/dt."""
        return np.zeros_like(memory)

    def _calc_posterior(self, context: Context, posterior: Any) -> None:
        stored = context.get_discrete_state_vector().CopyToVector()
        since, last = stored[:2].tolist()
        memory, past = stored[self._memory_start : -3], stored[-3:].tolist()
        known = _Posterior(memory, since, *past)
        elapsed = context.get_time() - last
        if self._is_gap(elapsed):
            nothing = np.zeros_like(memory)
            known = known._replace(memory=nothing, since=math.nan, excess=0.0)
        elif elapsed > self._instant or (math.isnan(last) and not math.isnan(since)):
            x_0, x_1 = stored[2 : self._memory_start], self._state.Eval(context)
            mean = self._plausible_mean(x_0, x_1, self._input.Eval(context), elapsed)
            if mean is None:
                known = self._re_armed(known, context.get_time())
            else:
                known = known._replace(
                    memory=self._advance(memory, mean.disturbance, elapsed),
                    quadrature=max(known.quadrature, mean.quadrature),
                )
        known.memory.setflags(write=False)
        posterior.set_value(known)

    def _plausible_mean(
        self, x_0: Array, x_1: Array, u: Array, elapsed: float
    ) -> IntervalMean | None:
        """Returns an interval's mean disturbance; None for a refused interval."""
        if not (_is_finite(x_0) and _is_finite(x_1)):
            return None
        mean, delta1 = self.mean_disturbance(x_0, x_1, u, elapsed), self.bounds.delta1
        rounding = _ROUNDING * (self._largest_unit + self._size(x_1))
        blur = _JUMP_SIGMAS * self._noise + rounding
        most = _EXCEEDED * delta1 + mean.quadrature + blur / elapsed
        # False where it is not finite, too.
        is_plausible = math.hypot(*mean.disturbance.tolist()) <= most
        tells_something = mean.quadrature <= delta1 or delta1 == 0.0
        return mean if is_plausible and tells_something else None

    def _re_armed(self, known: _Posterior, now: float) -> _Posterior:
        """Keeps the estimate and restarts its error bound (E43)."""
        estimate = self._estimate(known.memory)
        return known._replace(
            memory=self._started_at(estimate),
            since=now,
            excess=float(np.linalg.norm(estimate)),
            refused=known.refused + 1.0,
        )

    def mean_disturbance(
        self, x_0: Array, x_1: Array, u: Array, elapsed: float
    ) -> IntervalMean:
        """Returns the mean of d between two measured states with u held (E29).

        The mean of f + g u is Simpson's, with the middle state on the cubic Hermite
        curve between the two.
        """
        rate, moved = self._model.nominal_rate, self._model.difference(x_1, x_0)
        rate_0, rate_1 = rate(x_0, u), rate(x_1, u)
        x_middle = x_0 + moved / 2 + elapsed / 8 * (rate_0 - rate_1)
        rates = np.array((rate_0, rate(x_middle, u), rate_1)) @ self._disturbed.T
        mean = self._disturbed @ moved / elapsed - _SIMPSON @ rates
        bend = (_SECOND_DIFFERENCE @ rates).tolist()
        slope = elapsed * self._slope(x_1, u, rate_1)
        drift = elapsed * (self.bounds.delta2 + elapsed * self.bounds.delta3 / 12) / 12
        change = min(1.0, _CHANGE + slope)
        rule = change * (1 + slope) / 10 * math.hypot(*bend)
        return IntervalMean(mean, slope * drift + rule)

    def _size(self, x: Array) -> float:
        """Returns the size of the disturbed channels: a clock beside them is large."""
        return max((self._units @ np.abs(x)).tolist(), default=0.0)

    def _slope(self, x: Array, u: Array, rate: Array) -> float:
        """Returns how strongly the disturbed rates depend on the disturbed states."""
        step = _DIFFERENCE * (1.0 + self._size(x))
        rates = [
            self._model.nominal_rate(moved, u) for moved in x + step * self._directions
        ]
        changes = np.array(rates).reshape(self._directions.shape) - rate
        size = np.abs(changes @ self._disturbed.T)
        # The spectral norm is at most the geometric mean of these two.
        rows, sums = size.sum(axis=1).tolist(), size.sum(axis=0).tolist()
        return math.sqrt(max(rows, default=0.0) * max(sums, default=0.0)) / step

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        """Stores the posterior, and the measurement it ends with."""
        if self._reset.HasValue(context) and self._reset.Eval(context)[0] != 0.0:
            discrete.set_value(self._nothing)
            return
        now, state = context.get_time(), self._state.Eval(context)
        last = now if _is_finite(state) else math.nan
        known = self._known(context)
        since = last if math.isnan(known.since) else known.since
        past = (known.excess, known.quadrature, known.refused)
        discrete.set_value(np.concatenate(((since, last), state, known.memory, past)))

    def _known(self, context: Context) -> _Posterior:
        return cast(_Posterior, self._posterior.Eval(context))

    def _calc_estimate(self, context: Context, output: BasicVector) -> None:
        known = self._known(context)
        age = 0.0 if math.isnan(known.since) else context.get_time() - known.since
        bound = self._bound_of(known.excess, known.quadrature)
        estimate = DisturbanceEstimate(
            self._estimate(known.memory),
            self._estimate_rate(known.memory),
            np.array(bound.value(age)),
            np.array(bound.derivative(age)),
            np.array(known.refused),
            np.array(known.quadrature),
        )
        output.SetFromVector(estimate.pack())

    def _calc_disturbance_estimate(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._estimate(self._known(context).memory))

    def _is_gap(self, elapsed: float) -> bool:
        least, most = -self._instant, self.longest_interval + self._instant
        return elapsed < least or elapsed > most


def _is_finite(vector: Array) -> bool:
    """Whether all numbers are finite: NaN and infinity survive a sum."""
    return math.isfinite(sum(vector.tolist()))
