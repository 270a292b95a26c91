"""Watchdogs of the controller: old states, other obstacles, refuted hypotheses."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceEstimate
from vcbf_drake.hil.bus import Bus, Clock
from vcbf_drake.hil.decoding import CommandMode, Reason, obstacles_format
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.hil.prediction import runge_kutta_step
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import InputSet
from vcbf_drake.simulation.scenario import Hardware, Scenario


class Verdict(NamedTuple):
    """What to ask of the vehicle, and why; the reason is empty with APPLY."""

    mode: CommandMode
    reason: str


class StateWatchdog:
    """Looks at the age of the newest state.

    A state older than `Hardware.max_state_age` is not acted on: the last command is
    held for `Hardware.hold_time`, then the vehicle has to use its own fallback, until a
    state comes again.

    Args:
        states: The states that came.
        clock: Tells the time.
        settings: How old is too old.
    """

    def __init__(self, states: Inbox, clock: Clock, settings: Hardware) -> None:
        self._states, self._clock, self._settings = states, clock, settings

    def state_age(self) -> float:
        """Returns the age of the newest state [s], infinite before the first."""
        if self._states.newest is None:
            return math.inf
        measured = self._states.utime(self._states.newest.utime_measured)
        return 1e-6 * (self._clock.utime() - measured)

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        age, limit = self.state_age(), self._settings.max_state_age
        if age <= limit:
            return Verdict(CommandMode.APPLY, "")
        if age <= limit + self._settings.hold_time:
            reason = f"the state is {age:.2f} s old; the input is held"
            return Verdict(CommandMode.HOLD, reason)
        if math.isinf(age):
            return Verdict(CommandMode.FALLBACK, "no state yet")
        return Verdict(CommandMode.FALLBACK, f"no new state for {age:.2f} s")


# Obstacles -------------------------------------------------------------------------

_TOLERANCE = 0.01  # [m]
_MAX_AGE = 1.0  # [s]


class ObstacleWatch:
    """Compares the obstacles that a vehicle publishes with those of the scenario.

    A vehicle that publishes none is not checked. Another number of them is a
    difference too, until as many as are known come again.

    Args:
        bus: Where they come from.
        scenario: What the controller knows.

    Attributes:
        inbox: What arrived.
    """

    def __init__(self, bus: Bus, scenario: Scenario) -> None:
        self._difference = ""
        self._obstacles = scenario.spheres
        self._shape = len(scenario.spheres), len(scenario.target)
        self.inbox = Inbox(
            bus,
            obstacles_format(*self._shape),
            _MAX_AGE,
            self._compare,
            max_clock_offset=scenario.hardware.max_clock_offset,
        )
        self._sizes_rejected = 0

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        if self.inbox.rejections[Reason.SIZE] > self._sizes_rejected:
            words = f"the vehicle does not know of {self._shape[0]} obstacles"
            return Verdict(CommandMode.FALLBACK, words)
        if self._difference:
            return Verdict(CommandMode.FALLBACK, self._difference)
        return Verdict(CommandMode.APPLY, "")

    def _compare(self, message: Any, now: int) -> None:
        self._difference = ""
        self._sizes_rejected = self.inbox.rejections[Reason.SIZE]
        centers = np.reshape(message.position, self._shape)
        for number, (obstacle, center, radius) in enumerate(
            zip(self._obstacles, centers, message.radius, strict=True), start=1
        ):
            velocity = np.array(obstacle.velocity or np.zeros_like(center))
            known = np.array(obstacle.center) + message.time * velocity
            away = float(np.linalg.norm(center - known))
            larger = radius - (obstacle.radius + obstacle.margin)
            if away + abs(larger) > _TOLERANCE:
                self._difference = (
                    f"the vehicle's obstacle {number} is {away:.3f} m away from the"
                    f" scenario's and {larger:+.3f} m larger"
                )
                return


# Refuted hypotheses ----------------------------------------------------------------

# So many ticks in a row must refute a hypothesis; one is an angle that wraps, a reset.
_PERSISTENT = 3
# So many equal states in a row are a frozen one.
_FROZEN = 5
# How long nothing is refuted before all is well again [s].
_QUIET = 1.0
# An alarm of this number stays.
_MOST_ALARMS = 3
# Of the least that theory allows; and of what moves anyway: no model is exact.
_SPARE, _OF_MOTION = 1.5, 0.05
_NOISES = 6.0

FINDINGS = (
    "the estimate exceeds the declared disturbance by more than its error bound",
    "the state moves otherwise than model, input and disturbance allow",
    "the state stands still although the input moves it",
)


class _Memory(NamedTuple):
    """What an audit remembers; all numbers."""

    session: float = math.nan
    time: float = math.nan
    refuted_estimate: float = 0.0
    refuted_motion: float = 0.0
    frozen: float = 0.0
    refuted_at: float = -math.inf
    alarms: float = 0.0
    finding: float = -1.0


class LiveAudit(LeafSystem):
    """Compares what is measured with the filter's hypotheses at every tick.

    .. pydrake_system::

        name: LiveAudit
        input_ports:
        - state
        - applied_input
        - stamp
        - estimate
        output_ports:
        - finding

    Refuted are the model, the bounds or the measurement, whichever it may be, by

    * abs(dhat) > delta1 + its error bound: no disturbance that is declared can be so
      estimated;
    * a state that is farther from the one predicted (Runge and Kutta's fourth order,
      the mean input that was applied, no disturbance) than a disturbance of delta1, the
      inputs' range within the interval and the measurement noise can take it;
    * a state that stays the same, bit for bit, while its stamps are fresh and the input
      or the model moves it.

    What one tick alone refutes counts as a reset of the state's estimator; three in a
    row (five equal states) are a finding. It is withdrawn when nothing was refuted for
    a second; the third finding of a motion stays.

    `finding` is the index of what is refuted in `FINDINGS`, -1 for nothing.

    Args:
        model: The plant's f, g, E.
        input_set: What its actuators can do.
        bounds: What is declared of the disturbance.
        period: The control period [s].
        longest_interval: After a longer one it begins anew [s].
        noise: The standard deviations of the measured state, (n,); none if empty.
    """

    def __init__(
        self,
        model: ControlAffineModel,
        input_set: InputSet,
        bounds: DisturbanceBounds,
        period: float,
        longest_interval: float,
        noise: Array | None = None,
    ) -> None:
        super().__init__()
        self._model, self._delta1 = model, bounds.delta1
        self._longest = longest_interval + 1e-6 * period
        self._range = np.asarray(input_set.scale, dtype=float)
        n, m, q = model.num_states, model.num_inputs, model.num_disturbances
        noises = np.zeros(n) if noise is None or not len(noise) else np.asarray(noise)
        self._noise = 2.0 * _NOISES * noises
        sizes = {
            "state": n,
            "applied_input": m,
            "stamp": 4,
            "estimate": DisturbanceEstimate.packed_size(q),
        }
        self._ports = [
            self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        ]
        self.DeclareDiscreteState(np.array(_Memory()))
        # The last state and the last input.
        self.DeclareDiscreteState(np.full(n + m, np.nan))
        self._judged = self.DeclareCacheEntry(
            "judged",
            ValueProducer(
                lambda: Value[object](),
                lambda context, judged: judged.set_value(self._judge(context)),
            ),
            {self.all_input_ports_ticket(), self.xd_ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareVectorOutputPort("finding", 1, self._calc_finding)

    def _calc_finding(self, context: Context, output: BasicVector) -> None:
        output[0] = self._judged.Eval(context).finding

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        state, applied, *_ = (port.Eval(context) for port in self._ports)
        discrete.set_value(0, np.array(self._judged.Eval(context)))
        discrete.set_value(1, np.concatenate([state, applied]))

    def _judge(self, context: Context) -> _Memory:
        """The memory after this tick."""
        x, u, stamp, packed = (port.Eval(context) for port in self._ports)
        memory = _Memory(*context.get_discrete_state(0).CopyToVector().tolist())
        last = context.get_discrete_state(1).CopyToVector()
        x_0, u_0 = last[: len(x)], last[len(x) :]
        session, now = stamp[0], stamp[3]
        if session != memory.session or now < memory.time:
            return _Memory(session, now)
        elapsed = now - memory.time
        if elapsed == 0.0:
            return memory
        memory = memory._replace(time=now)
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
        return _concluded(memory, is_large or is_off)

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
        # What a push of an interval's length does to the rates, for half of it.
        turned = sum(
            np.abs(model.nominal_rate(x_0 + elapsed * push, u) - rate)
            for push in pushes.T
        )
        q = model.num_disturbances
        allowed = elapsed * (np.abs(pushes[:, :q]).sum(axis=1) + turned / 2)
        allowed = _SPARE * allowed + _OF_MOTION * np.abs(predicted - x_0)
        allowed = allowed + self._noise * (1.0 + elapsed) + 1e-9
        return bool(np.any(np.abs(model.difference(x_1, predicted)) > allowed))


def _concluded(memory: _Memory, is_refuted: bool) -> _Memory:
    """The memory with what its counts say."""
    counts = memory.refuted_estimate, memory.refuted_motion, memory.frozen
    limits = _PERSISTENT, _PERSISTENT, _FROZEN
    # A state that stands still is also off: the more exact word counts.
    found = [i for i in (2, 0, 1) if counts[i] >= limits[i]]
    refuted_at = memory.time if is_refuted or found else memory.refuted_at
    if found:
        return memory._replace(
            refuted_at=refuted_at,
            alarms=memory.alarms + (memory.finding < 0.0),
            finding=float(found[0]),
        )
    is_quiet = memory.time - refuted_at > _QUIET and memory.alarms < _MOST_ALARMS
    finding = -1.0 if is_quiet else memory.finding
    return memory._replace(refuted_at=refuted_at, finding=finding)
