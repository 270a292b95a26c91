"""Prediction of the state over delays, and its audit by the measurements."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
)

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceEstimate
from vcbf_drake.hil.receivers import StateStamp
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import InputSet
from vcbf_drake.simulation.sections import Hardware

# Ticks in a row that must refute a hypothesis; a single one may be a wrapping angle or
# a reset.
_PERSISTENT = 3
# The index of its finding.
_FROZEN_TIME = 3
# Equal states in a row that count as frozen.
_FROZEN = 5
# The time without a refutation after which a finding is withdrawn [s].
_QUIET = 1.0
# The number of the finding that stays.
_MOST_ALARMS = 3
# Of the least that theory allows; and of what moves anyway: no model is exact.
_SPARE, _OF_MOTION = 1.5, 0.05
_NOISES = 6.0

FINDINGS = (
    "the estimate exceeds the declared disturbance by more than its error bound",
    "the state moves otherwise than model, input and disturbance allow",
    "the state stands still although the input moves it",
    "the motion's time stands still although the vehicle is under way",
)


def runge_kutta_step(
    model: ControlAffineModel, x: Array, u: Array, d: Array, h: float
) -> Array:
    """Returns the state (n,) after a step of Runge and Kutta's fourth order.

    Input and disturbance are held for its length h [s].
    """
    push = model.disturbance_matrix @ d

    def rate(at: Array) -> Array:
        return np.asarray(model.nominal_rate(at, u) + push)

    k_1 = rate(x)
    k_2 = rate(x + h / 2 * k_1)
    k_3 = rate(x + h / 2 * k_2)
    k_4 = rate(x + h * k_3)
    return np.asarray(x + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4))


class StatePredictor(LeafSystem):
    """Predicts the state over the delays of the link, both ways.

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``delays`` | 2 | the age of that state, and the delay of a command [s] |
    | ``held_input`` | m | the last command sent |
    | ``disturbance_estimate`` | q | held over the prediction |
    | ``predicted_state`` | n | the state when a command sent now arrives |

    The inputs applied meanwhile are known: the commands on their way, each from its
    time of sending plus a command's delay. The model is integrated over each of them by
    a step of Runge and Kutta's fourth order.

    Args:
        model: The vehicle's f, g, E.
        period: The control period [s].
        longest: The longest delay that is predicted over, each way [s].
    """

    def __init__(
        self, model: ControlAffineModel, period: float, longest: float
    ) -> None:
        super().__init__()
        self._model, self._longest = model, longest
        n, m, q = model.num_states, model.num_inputs, model.num_disturbances
        self._state = self.DeclareVectorInputPort("state", n)
        self._delays = self.DeclareVectorInputPort("delays", 2)
        self._held = self.DeclareVectorInputPort("held_input", m)
        self._estimate = self.DeclareVectorInputPort("disturbance_estimate", q)
        # When the last command was sent, then earlier ones: time and input, each.
        remembered = math.ceil(2.0 * longest / period) + 1
        self.DeclareDiscreteState([0.0])
        self.DeclareDiscreteState(np.full(remembered * (1 + m), np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)
        self.DeclareVectorOutputPort("predicted_state", n, self._calc)

    def _remember(self, context: Context, discrete: DiscreteValues) -> None:
        """Adds the last command to the earlier ones; the next one is sent now."""
        kept = np.full(context.get_discrete_state(1).size(), np.nan)
        commands = self._sent(context).ravel()[-len(kept) :]
        kept[-len(commands) :] = commands
        discrete.set_value(1, kept)
        discrete.set_value(0, [context.get_time() + self._delays.Eval(context)[0]])

    def _sent(self, context: Context) -> Array:
        """The commands that were sent, the oldest first: time and input, (K, 1 + m)."""
        m = self._model.num_inputs
        sent_at = context.get_discrete_state(0).CopyToVector()
        earlier = context.get_discrete_state(1).CopyToVector().reshape(-1, 1 + m)
        last = np.append(sent_at, self._held.Eval(context))
        # Without unused entries, and without commands from before time went back.
        return np.vstack([earlier[earlier[:, 0] < sent_at], last])

    def _calc(self, context: Context, output: BasicVector) -> None:
        x, d = self._state.Eval(context), self._estimate.Eval(context)
        for duration, u in self._applied(context):
            x = runge_kutta_step(self._model, x, u, d, duration)
        output.SetFromVector(x)

    def _applied(self, context: Context) -> Iterator[tuple[float, Array]]:
        """Yields the inputs until a command sent now arrives, with their durations."""
        delays = np.clip(self._delays.Eval(context), 0.0, self._longest)
        begin, sent = context.get_time(), self._sent(context)
        end = begin + delays.sum()
        # A command is applied from when it arrives to when the next one does. The first
        # remembered command stands for all earlier ones.
        arrivals = [begin, *np.clip(sent[1:, 0] + delays[1], begin, end), end]
        for duration, u in zip(np.diff(arrivals), sent[:, 1:], strict=True):
            if duration > 0.0:
                yield duration, u


class _Memory(NamedTuple):
    """The memory of an audit; all entries are numbers."""

    session: float = math.nan
    time: float = math.nan
    refuted_estimate: float = 0.0
    refuted_motion: float = 0.0
    frozen: float = 0.0
    refuted_at: float = -math.inf
    alarms: float = 0.0
    finding: float = -1.0
    # Since when the motion's time stands, or the last state of one that waits, by the
    # vehicle's clock [us].
    stands_since: float = math.nan


class LiveAudit(LeafSystem):
    """Compares the measurements with the filter's hypotheses at every tick.

    Its input ports are ``state``, ``applied_input``, ``stamp`` and ``estimate``.
    Refuted are the model, the bounds or the measurement, whichever it may be, by

    * abs(dhat) > delta1 + its error bound: no disturbance that is declared can be so
      estimated;
    * a state that is farther from the one predicted (Runge and Kutta's fourth order,
      the mean input that was applied, no disturbance) than a disturbance of delta1, the
      inputs' range within the interval and the measurement noise can take it;
    * a state that stays the same, bit for bit, while its stamps are fresh and the input
      or the model moves it;
    * a motion's time that stands still, longer than a state may be old, although the
      vehicle says that it is under way, or moves as without an input it would not:
      without that time nothing else can be compared.

    A refutation at a single tick counts as a reset of the state's estimator; three in a
    row (five equal states) are a finding. It is withdrawn after a second without a
    refutation; the third finding of a motion stays.

    `finding`, a state, is the index in `FINDINGS` of the hypothesis that was refuted at
    the last tick, -1 for none.

    Args:
        model: The plant's f, g, E.
        input_set: The input set of the actuators.
        bounds: The declared bounds of the disturbance.
        period: The control period [s].
        settings: Their `longest_interval`, after which it begins anew, and their
            `max_state_age`.
        noise: The standard deviations of the measured state, (n,); none if empty.
    """

    def __init__(
        self,
        model: ControlAffineModel,
        input_set: InputSet,
        bounds: DisturbanceBounds,
        period: float,
        settings: Hardware,
        noise: Array | None = None,
    ) -> None:
        super().__init__()
        self._model, self._delta1 = model, bounds.delta1
        # As the observer does: an interval of one period is always bridged.
        self._longest = max(period, settings.longest_interval) + 1e-6 * period
        self._longest_stand = settings.max_state_age
        self._range = np.asarray(input_set.scale, dtype=float)
        n, m, q = model.num_states, model.num_inputs, model.num_disturbances
        noises = np.zeros(n) if noise is None or not len(noise) else np.asarray(noise)
        self._noise = 2.0 * _NOISES * noises
        sizes = {
            "state": n,
            "applied_input": m,
            "stamp": len(StateStamp._fields),
            "estimate": DisturbanceEstimate.packed_size(q),
        }
        self._ports = [
            self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        ]
        self.DeclareStateOutputPort("finding", self.DeclareDiscreteState([-1.0]))
        self.DeclareDiscreteState(np.array(_Memory()))
        # The last state and the last input.
        self.DeclareDiscreteState(np.full(n + m, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        memory = self._judge(context)
        x, u, *_ = (port.Eval(context) for port in self._ports)
        discrete.set_value(0, [memory.finding])
        discrete.set_value(1, np.array(memory))
        discrete.set_value(2, np.concatenate([x, u]))

    def _judge(self, context: Context) -> _Memory:
        """The memory after this tick."""
        x, u, stamped, packed = (port.Eval(context) for port in self._ports)
        stamp = StateStamp(*stamped.tolist())
        memory = _Memory(*context.get_discrete_state(1).CopyToVector().tolist())
        last = context.get_discrete_state(2).CopyToVector()
        x_0, u_0 = last[: len(x)], last[len(x) :]
        now = stamp.time
        if stamp.session != memory.session or now < memory.time:
            return _Memory(stamp.session, now, stands_since=stamp.utime)
        elapsed = now - memory.time
        if elapsed == 0.0:
            return self._with_standing_time(memory, stamp, x_0, x)
        memory = memory._replace(time=now, stands_since=stamp.utime)
        if not elapsed <= self._longest:
            return memory._replace(refuted_estimate=0.0, refuted_motion=0.0, frozen=0.0)
        estimate = DisturbanceEstimate.unpack(packed)
        size = float(np.linalg.norm(estimate.disturbance))
        is_large = size > self._delta1 + float(estimate.error_bound) + 1e-9
        is_off = self._is_elsewhere(x_0, x, u, elapsed)
        is_same = bool(np.all(x == x_0))
        is_moved = is_off or bool(np.any(np.abs(u - u_0) > 1e-3 * self._range))
        memory = memory._replace(
            refuted_estimate=memory.refuted_estimate + 1 if is_large else 0.0,
            refuted_motion=memory.refuted_motion + 1 if is_off else 0.0,
            frozen=memory.frozen + is_moved if is_same else 0.0,
        )
        if is_large or is_off:
            memory = memory._replace(refuted_at=now)
        # A frozen state is also elsewhere: the more exact finding counts.
        if memory.frozen >= _FROZEN:
            return _alarmed(memory, 2)
        if memory.refuted_estimate >= _PERSISTENT:
            return _alarmed(memory, 0)
        if memory.refuted_motion >= _PERSISTENT:
            return _alarmed(memory, 1)
        is_quiet = now - memory.refuted_at > _QUIET and memory.alarms < _MOST_ALARMS
        return memory._replace(finding=-1.0) if is_quiet else memory

    def _with_standing_time(
        self, memory: _Memory, stamp: StateStamp, x_0: Array, x: Array
    ) -> _Memory:
        """The memory after a tick at the same time of the motion as the one before."""
        elapsed = 1e-6 * (stamp.utime - memory.stands_since)
        if stamp.moves:
            is_long = elapsed > self._longest_stand
            return _alarmed(memory, _FROZEN_TIME) if is_long else memory
        # It says that it waits: then it stands, or drifts without an input.
        change = np.abs(self._model.difference(x, x_0))
        zero = np.zeros(self._model.num_inputs)
        is_driven = (
            elapsed <= self._longest
            and bool(np.any(change > self._noise + 1e-9))
            and self._is_elsewhere(x_0, x, zero, elapsed)
        )
        count = memory.refuted_motion + 1 if is_driven else 0.0
        memory = memory._replace(stands_since=stamp.utime, refuted_motion=count)
        return _alarmed(memory, _FROZEN_TIME) if count >= _PERSISTENT else memory

    def _is_elsewhere(self, x_0: Array, x_1: Array, u: Array, elapsed: float) -> bool:
        """Whether a state is farther from the predicted one than can be."""
        model = self._model
        predicted = runge_kutta_step(
            model, x_0, u, np.zeros(model.num_disturbances), elapsed
        )
        _, g = model.drift_and_input_matrix(x_0)
        pushes = np.column_stack(
            [model.disturbance_matrix * self._delta1, g * self._range]
        )
        rate = model.nominal_rate(x_0, u)
        # The effect of a push of an interval's length on the rates, for half of it.
        turned = sum(
            np.abs(model.nominal_rate(x_0 + elapsed * push, u) - rate)
            for push in pushes.T
        )
        q = model.num_disturbances
        allowed = elapsed * (np.abs(pushes[:, :q]).sum(axis=1) + turned / 2)
        allowed = _SPARE * allowed + _OF_MOTION * np.abs(predicted - x_0)
        allowed = allowed + self._noise * (1.0 + elapsed) + 1e-9
        return bool(np.any(np.abs(model.difference(x_1, predicted)) > allowed))


def _alarmed(memory: _Memory, finding: int) -> _Memory:
    """The memory with a finding."""
    return memory._replace(
        refuted_at=memory.time,
        alarms=memory.alarms + (memory.finding < 0.0),
        finding=float(finding),
    )
