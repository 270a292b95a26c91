"""CommandSender: sends the filter's input and its status, or says to fall back."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import command_format, status_format
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.messages import vcbf_command, vcbf_state, vcbf_status
from vcbf_drake.hil.modes import CommandMode
from vcbf_drake.hil.obstacle_watch import ObstacleWatch
from vcbf_drake.hil.outbox import Outbox
from vcbf_drake.hil.state_receiver import StateStamp
from vcbf_drake.hil.state_watchdog import StateWatchdog, Verdict
from vcbf_drake.safety import FilterStatus, SafetyFilter, unpack_feasible_set


class CommandSender(LeafSystem):
    """Publishes what the vehicle is to apply, and beside it what the filter did.

    .. pydrake_system::

        name: CommandSender
        input_ports:
        - input
        - reference
        - slack
        - volume
        - barriers
        - status
        - feasible_set
        - disturbance_estimate
        - error_bound
        - stamp

    `input` is the held input; everything else is sampled at the ticks. It sends
    periodically and at forced events, from the first tick on. A `StateWatchdog` says
    whether the input may be applied. An infeasible tick whose policy is ``stop`` asks
    for the vehicle's fallback, too, and so do obstacles that the filter does not know.

    Args:
        bus: Where to.
        safety_filter: The filter whose ports are connected.
        num_disturbances: q of the observer.
        period: The control period [s].
        states: The states that arrived, for the status.
        watchdog: Looks at their age.
        obstacles: Compares the vehicle's with those of the filter.
        method: The filter's name.

    Attributes:
        ending: Whether the controller is about to end.
        last_status: The status that was sent last, None before the first.
    """

    def __init__(
        self,
        bus: Bus,
        safety_filter: SafetyFilter,
        num_disturbances: int,
        period: float,
        states: Inbox,
        watchdog: StateWatchdog,
        obstacles: ObstacleWatch,
        method: str,
    ) -> None:
        super().__init__()
        self.ending = False
        self.last_status: vcbf_status | None = None
        self._filter, self._states, self._watchdog = safety_filter, states, watchdog
        self._obstacles, self._method = obstacles, method
        m, n_barriers = safety_filter.model.num_inputs, safety_filter.barrier_set.size
        self._commands = Outbox(bus, command_format(m).channel)
        self._statuses = Outbox(
            bus, status_format(m, n_barriers, num_disturbances).channel
        )
        self._input = self.DeclareVectorInputPort("input", m)
        sizes = {
            "reference": m,
            "slack": 1,
            "volume": 1,
            "barriers": n_barriers,
            "status": 1,
            "feasible_set": safety_filter.GetOutputPort("feasible_set").size(),
            "disturbance_estimate": num_disturbances,
            "error_bound": 1,
            "stamp": len(StateStamp._fields),
        }
        self._sampled = [
            self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        ]
        self._ends = dict(zip(sizes, np.cumsum(list(sizes.values())), strict=True))
        self._sizes = sizes
        self.DeclareDiscreteState(np.full(sum(sizes.values()), np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def states_are_old(self) -> bool:
        """Returns whether the newest state is too old to act on."""
        return self._watchdog.verdict().mode is not CommandMode.APPLY

    def verdict(self, context: Context) -> Verdict:
        """Returns what is asked of the vehicle now, and why."""
        if self.ending:
            return Verdict(CommandMode.END, "the controller ends")
        if self._obstacles.difference:
            return Verdict(CommandMode.FALLBACK, self._obstacles.difference)
        verdict = self._watchdog.verdict()
        if verdict.mode is CommandMode.APPLY and self._filter.infeasible == "stop":
            conflicts = self.conflicts(context)
            if conflicts:
                reason = f"no input satisfies {', '.join(conflicts)}"
                return Verdict(CommandMode.FALLBACK, reason)
        return verdict

    def conflicts(self, context: Context) -> tuple[str, ...]:
        """Returns the rows that excluded each other at the last tick, by name."""
        sample = self._sample_of(context)
        if sample["status"][0] != FilterStatus.INFEASIBLE:
            return ()
        packed = unpack_feasible_set(
            sample["feasible_set"], self._filter.num_rows, self._filter.model.num_inputs
        )
        return self._filter.conflicting_rows(packed.A, packed.b)

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value(np.concatenate([p.Eval(context) for p in self._sampled]))

    def _sample_of(self, context: Context) -> dict[str, Array]:
        values = context.get_discrete_state_vector().CopyToVector()
        return {
            name: values[end - self._sizes[name] : end]
            for name, end in self._ends.items()
        }

    def _send(self, context: Context) -> None:
        sample = self._sample_of(context)
        state = StateStamp(*sample["stamp"].tolist())
        if math.isnan(state.sequence):  # There was no tick yet.
            return
        verdict, u = self.verdict(context), self._input.Eval(context)
        self._commands.send(command_message(u, verdict.mode, state))
        status = self._status(sample, u, state)
        status.mode, status.reason = int(verdict.mode), verdict.reason
        status.conflicts = list(self.conflicts(context))
        status.num_conflicts = len(status.conflicts)
        self._statuses.send(status)
        self.last_status = status

    def _status(
        self, sample: dict[str, Array], u: Array, state: StateStamp
    ) -> vcbf_status:
        message = vcbf_status()
        message.method = self._method
        message.state_sequence, message.time = int(state.sequence), state.time
        message.state_age = self._watchdog.state_age()
        message.filter_status = int(sample["status"][0])
        message.num_inputs, message.input = len(u), u.tolist()
        message.reference = sample["reference"].tolist()
        message.slack = float(sample["slack"][0])
        message.volume = float(sample["volume"][0])
        message.barriers = sample["barriers"].tolist()
        message.num_barriers = len(message.barriers)
        message.disturbance_estimate = sample["disturbance_estimate"].tolist()
        message.num_disturbances = len(message.disturbance_estimate)
        message.error_bound = float(sample["error_bound"][0])
        message.states_accepted = self._states.accepted
        message.states_lost = self._states.lost
        message.states_late = self._states.late
        message.states_rejected = self._states.rejected
        return message


def command_message(
    u: Sequence[float] | Array, mode: CommandMode, state: StateStamp | vcbf_state
) -> vcbf_command:
    """Returns the command to apply an input, or zeros with a mode that applies none.

    Args:
        u: The input, shape (m,).
        mode: What the vehicle is to do.
        state: The state that it answers: its stamp, or its message.
    """
    message = vcbf_command()
    message.state_session = int(state.session)
    message.state_sequence = int(state.sequence)
    message.state_utime = int(state.utime)
    message.mode = int(mode)
    applies = mode in (CommandMode.APPLY, CommandMode.HOLD)
    message.num_inputs = len(u)
    message.input = [float(each) if applies else 0.0 for each in u]
    return message
