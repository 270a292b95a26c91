"""CommandSender: the commands to the vehicle, and the status of the filter."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.inbox import CommandMode, command_format, status_format
from vcbf_drake.hil.messages import vcbf_command, vcbf_state, vcbf_status
from vcbf_drake.hil.prediction import FINDINGS
from vcbf_drake.hil.receivers import StateReceiver, StateStamp, Verdict, Watchdog
from vcbf_drake.safety import (
    METHODS,
    FilterStatus,
    SafetyFilter,
    unpack_feasible_set,
)
from vcbf_drake.simulation.sections import Hardware

# The share of its timeout for which a vehicle may hear nothing from the controller that
# it follows, before another one speaks up; and how often that one shows itself [us].
_SHARE, _BETWEEN_SIGNS = 0.5, 1_000_000


class CommandSender(LeafSystem):
    """Publishes the commands to the vehicle, and the status of the filter.

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
        - estimate
        - stamp
        - finding

    `input` is the held input; everything else is sampled at the ticks. It sends
    periodically and at forced events: a status from the start on, commands from the
    first tick on. While the vehicle follows another controller, only one command per
    second is sent: the commands of both would displace each other in the vehicle's
    inbox. Watchdogs decide whether the input may be applied. An infeasible tick with
    the policy ``stop`` also requests the vehicle's fallback, and so does, with
    `Hardware.audit` ``fallback``, a finding of the audit.

    Args:
        bus: The bus.
        safety_filter: The filter whose ports are connected.
        delta1: The declared bound of the disturbance (E16, bounds of the disturbance).
        period: The control period [s].
        receiver: The receiver of states, which knows their age.
        settings: The response to a finding of the audit.
        watchdogs: Further watchdogs, which precede that of the state's age.

    Attributes:
        ending: Whether the controller is about to end.
        takes_over: Whether it requests its vehicle from another controller.
        period: The control period [s].
        last_status: The last status sent, None before the first.
        deadlines_missed: Control periods that had no tick of their own, for the status;
            the driver of the diagram counts them.
    """

    def __init__(
        self,
        bus: Bus,
        safety_filter: SafetyFilter,
        delta1: float,
        period: float,
        receiver: StateReceiver,
        settings: Hardware,
        watchdogs: Sequence[Watchdog] = (),
    ) -> None:
        super().__init__()
        self.ending = self.takes_over = False
        self.period = period
        self.last_status: vcbf_status | None = None
        self.deadlines_missed = 0
        self._bus, self._filter, self._receiver = bus, safety_filter, receiver
        self._delta1, self._audit = delta1, settings.audit
        self._longest_silence = _SHARE * settings.command_timeout
        self._showed_itself_at = -math.inf
        self._watchdogs = tuple(watchdogs)
        self._method = next(
            name for name, each in METHODS.items() if each is safety_filter.method
        )
        m, n_barriers = safety_filter.model.num_inputs, safety_filter.barrier_set.size
        q = safety_filter.model.num_disturbances
        self._commands = command_format(m).channel
        self._statuses = status_format(m, n_barriers, q).channel
        self._input = self.DeclareVectorInputPort("input", m)
        sizes = {
            "reference": m,
            "slack": 1,
            "volume": 1,
            "barriers": n_barriers,
            "status": 1,
            "feasible_set": safety_filter.GetOutputPort("feasible_set").size(),
            "estimate": DisturbanceEstimate.packed_size(q),
            "stamp": len(StateStamp._fields),
            "finding": 1,
        }
        # The sampled quantities: each one's port, and its held state.
        self._sampled = {
            name: (
                self.DeclareVectorInputPort(name, size),
                self.DeclareDiscreteState(np.full(size, np.nan)),
            )
            for name, size in sizes.items()
        }
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def verdict(self, context: Context) -> Verdict:
        """Returns the current request to the vehicle, and its reason."""
        if self.ending:
            return Verdict(CommandMode.END, "the controller ends")
        verdict = self._receiver.verdict()
        if verdict.mode is CommandMode.FALLBACK:
            return verdict
        for watchdog in self._watchdogs:
            theirs = watchdog()
            if theirs.mode is not CommandMode.APPLY:
                return theirs
        findings = self.findings(context)
        if findings and self._audit == "fallback":
            return Verdict(CommandMode.FALLBACK, f"refuted: {findings[0]}")
        stops = self._filter.settings.infeasible == "stop"
        if verdict.mode is CommandMode.APPLY and stops:
            status = self._held(context, "status")[0]
            reason = trouble_of_filter(status, self.conflicts(context))
            if reason:
                return Verdict(CommandMode.FALLBACK, reason)
        return verdict

    def findings(self, context: Context) -> tuple[str, ...]:
        """Returns the hypotheses refuted by measurements at the last tick, in words."""
        finding = self._held(context, "finding")[0]
        return (FINDINGS[int(finding)],) if finding >= 0.0 else ()

    def conflicts(self, context: Context) -> tuple[str, ...]:
        """Returns the rows that excluded each other at the last tick, by name."""
        if self._held(context, "status")[0] != FilterStatus.INFEASIBLE:
            return ()
        packed = unpack_feasible_set(
            self._held(context, "feasible_set"),
            self._filter.num_rows,
            self._filter.model.num_inputs,
        )
        return self._filter.row_names.in_conflict(packed.A, packed.b)

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        for port, index in self._sampled.values():
            discrete.set_value(index, port.Eval(context))

    def _held(self, context: Context, name: str) -> Array:
        """The value of an input port at the last tick; nan before the first."""
        _, index = self._sampled[name]
        held: Array = context.get_discrete_state(index).CopyToVector()
        return held

    def _send(self, context: Context) -> None:
        # The log of a command tells when its verdict was reached.
        with self._bus.one_instant():
            self._send_now(context)

    def _send_now(self, context: Context) -> None:
        stamp = StateStamp(*self._held(context, "stamp").tolist())
        verdict, u = self.verdict(context), self._input.Eval(context)
        is_ticking = not math.isnan(stamp.sequence)
        if is_ticking and self._speaks(stamp):
            command = command_message(u, verdict.mode, stamp)
            command.state_age = self._held_for(stamp)
            command.takes_over = self.takes_over
            self._bus.send(self._commands, command)
        status = self._status(context, u if is_ticking else np.zeros_like(u), stamp)
        status.mode = int(verdict.mode)
        status.conflicts = list(self.conflicts(context))
        status.num_conflicts = len(status.conflicts)
        status.reason = self._reason(verdict, is_ticking, status)
        status.findings = list(self.findings(context))
        status.num_findings = len(status.findings)
        self._bus.send(self._statuses, status)
        self.last_status = status

    def _speaks(self, stamp: StateStamp) -> bool:
        """Whether a command is sent; the states alone decide."""
        followed = self._receiver.inbox.newest.command_session
        overrules = self.takes_over and self._bus.session > followed
        if overrules or not self._receiver.follows_another(self._longest_silence):
            self._showed_itself_at = -math.inf
        elif stamp.utime - self._showed_itself_at < _BETWEEN_SIGNS:
            return False
        else:
            self._showed_itself_at = stamp.utime
        return True

    def _held_for(self, stamp: StateStamp) -> int:
        """The time since the answered state arrived [us]."""
        newest, inbox = self._receiver.inbox.newest, self._receiver.inbox
        came = inbox.utime(int(stamp.utime))
        if newest is not None and newest.sequence == stamp.sequence:
            came = inbox.received_at
        return max(0, self._bus.clock.utime() - came)

    def _reason(self, verdict: Verdict, is_ticking: bool, status: vcbf_status) -> str:
        """The reason, other senders, and faults of the states received."""
        notices = [verdict.reason, self._receiver.notice() if is_ticking else ""]
        if verdict.mode is CommandMode.APPLY:
            notices.append(trouble_of_filter(status.filter_status, status.conflicts))
        if verdict.mode is CommandMode.FALLBACK:
            now = self._bus.clock.utime()
            notices.append(self._receiver.inbox.complaint(now))
        return "; ".join(each for each in notices if each)

    def _status(self, context: Context, u: Array, stamp: StateStamp) -> vcbf_status:
        message, receiver = vcbf_status(), self._receiver
        inbox, clock = receiver.inbox, receiver.inbox.peer_clock
        held = {name: self._held(context, name) for name in self._sampled}
        message.method = self._method
        is_ticking = not math.isnan(stamp.sequence)
        message.state_sequence = int(stamp.sequence) if is_ticking else -1
        message.time = stamp.time if is_ticking else 0.0
        age = receiver.state_age()
        message.state_age = age if math.isfinite(age) else math.nan
        message.followed = receiver.is_followed
        message.filter_status = int(np.nan_to_num(held["status"][0]))
        message.num_inputs, message.input = len(u), u.tolist()
        message.reference = held["reference"].tolist()
        message.slack = float(held["slack"][0])
        message.volume = float(held["volume"][0])
        message.barriers = held["barriers"].tolist()
        message.num_barriers = len(message.barriers)
        estimate = DisturbanceEstimate.unpack(held["estimate"])
        message.disturbance_estimate = estimate.disturbance.tolist()
        message.num_disturbances = len(message.disturbance_estimate)
        message.error_bound = float(estimate.error_bound)
        message.disturbance_bound = self._delta1
        message.refused_intervals = int(np.nan_to_num(estimate.refused_intervals))
        message.states_accepted, message.states_lost = inbox.accepted, inbox.lost
        message.states_late, message.states_rejected = inbox.late, inbox.rejected
        message.deadlines_missed = self.deadlines_missed
        message.clock_offset = message.clock_uncertainty = math.nan
        if clock is not None:
            message.clock_offset = 1e-6 * clock.offset
            if math.isfinite(clock.uncertainty):
                message.clock_uncertainty = 1e-6 * clock.uncertainty
        return message


def trouble_of_filter(status: float, conflicts: Sequence[str]) -> str:
    """Returns the reason why the filter's input violates a row; empty for none.

    Args:
        status: A `FilterStatus`; nan before the first tick.
        conflicts: The names of the rows that exclude each other.
    """
    if status == FilterStatus.FAILED:
        return "the filter's tick FAILED"
    return f"no input satisfies {', '.join(conflicts)}" if conflicts else ""


def command_message(
    u: Sequence[float] | Array, mode: CommandMode, state: StateStamp | vcbf_state
) -> vcbf_command:
    """Returns the command to apply an input, or zeros with a mode that applies none.

    Args:
        u: The input, shape (m,).
        mode: The requested mode of the vehicle.
        state: The answered state: its stamp, or its message.
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
