"""CommandSender: the commands to the vehicle, and the status of the filter."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.formats import CommandMode, command_format
from vcbf_drake.hil.messages import vcbf_command, vcbf_state, vcbf_status
from vcbf_drake.hil.prediction import FINDINGS
from vcbf_drake.hil.receivers import StateReceiver, StateStamp, Verdict, Watchdog
from vcbf_drake.safety import FilterStatus, SafetyFilter, unpack_feasible_set
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
        - finding
        - reference
        - slack
        - volume
        - barriers
        - status
        - feasible_set
        - estimate
        - stamp

    `input` is the held input and `finding` that of the audit; everything else is
    sampled at the ticks. It sends periodically and at forced events: a status from the
    start on, commands from the first tick on. While the vehicle follows another
    controller, only one command per second is sent: the commands of both would displace
    each other in the vehicle's inbox. Watchdogs decide whether the input may be
    applied. An infeasible tick with the policy ``stop`` also requests the vehicle's
    fallback, and so does, with `Hardware.audit` ``fallback``, a finding of the audit.

    `VehicleLink.answer` makes and connects it.

    Attributes:
        ending: Whether the controller is about to end.
        takes_over: Whether it requests its vehicle from another controller.
        period: The control period [s].
        last_status: The last status sent; before the first tick it answers no state.
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
        self.last_status = vcbf_status()
        self.last_status.state_sequence = -1
        self.deadlines_missed = 0
        self._bus, self._filter, self._receiver = bus, safety_filter, receiver
        self._delta1, self._audit = delta1, settings.audit
        self._longest_silence = _SHARE * settings.command_timeout
        self._showed_itself_at = -math.inf
        self._watchdogs = tuple(watchdogs)
        m, q = safety_filter.model.num_inputs, safety_filter.model.num_disturbances
        self._commands = command_format(m).channel
        self._input = self.DeclareVectorInputPort("input", m)
        self._finding = self.DeclareVectorInputPort("finding", 1)
        filtered = ("slack", "volume", "barriers", "status", "feasible_set")
        sizes = {
            "reference": m,
            **{name: safety_filter.GetOutputPort(name).size() for name in filtered},
            "estimate": DisturbanceEstimate.packed_size(q),
            "stamp": len(StateStamp._fields),
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

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        for port, index in self._sampled.values():
            discrete.set_value(index, port.Eval(context))

    def _held(self, context: Context) -> dict[str, Array]:
        """The sampled quantities at the last tick; nan before the first."""
        return {
            name: context.get_discrete_state(index).CopyToVector()
            for name, (_, index) in self._sampled.items()
        }

    def _send(self, context: Context) -> None:
        # The log of a command tells when its verdict was reached.
        with self._bus.one_instant():
            self._send_now(context)

    def _send_now(self, context: Context) -> None:
        held, u = self._held(context), self._input.Eval(context)
        stamp = StateStamp(*held["stamp"].tolist())
        conflicts, finding = self._conflicts(held), int(self._finding.Eval(context)[0])
        findings = [FINDINGS[finding]] if finding >= 0 else []
        trouble = ""
        if held["status"][0] == FilterStatus.INFEASIBLE:
            # The proof of a narrow conflict may name no rows.
            trouble = f"no input satisfies {', '.join(conflicts) or 'all rows'}"
        if held["status"][0] == FilterStatus.FAILED:
            trouble = "the filter's tick FAILED"
        verdict = self._verdict(findings, trouble)
        is_ticking = not math.isnan(stamp.sequence)
        if is_ticking and self._speaks(stamp):
            command = command_message(u, verdict.mode, stamp)
            command.state_age = self._held_for(stamp)
            command.takes_over = self.takes_over
            self._bus.send(self._commands, command)
        status = self._status(held, u if is_ticking else np.zeros_like(u), stamp)
        status.mode = int(verdict.mode)
        status.num_conflicts, status.conflicts = len(conflicts), conflicts
        status.num_findings, status.findings = len(findings), findings
        # The verdict's reason, then other senders, and what else is wrong.
        reasons = [verdict.reason, self._receiver.notice() if is_ticking else ""]
        if verdict.mode is CommandMode.APPLY:
            reasons.append(trouble)
        if verdict.mode is not CommandMode.END:
            refuted = (f"refuted: {finding}" for finding in findings)
            reasons += [each for each in refuted if each != verdict.reason]
        if verdict.mode is CommandMode.FALLBACK:
            reasons.append(self._receiver.inbox.complaint(self._bus.clock.utime()))
        status.reason = "; ".join(filter(None, reasons))
        self._bus.send("VCBF_STATUS", status)
        self.last_status = status

    def _verdict(self, findings: Sequence[str], trouble: str) -> Verdict:
        """The current request to the vehicle, and its reason."""
        if self.ending:
            return Verdict(CommandMode.END, "the controller ends")
        verdict = self._receiver.verdict()
        if verdict.mode is CommandMode.FALLBACK:
            return verdict
        for watchdog in self._watchdogs:
            theirs = watchdog()
            if theirs.mode is not CommandMode.APPLY:
                return theirs
        if findings and self._audit == "fallback":
            return Verdict(CommandMode.FALLBACK, f"refuted: {findings[0]}")
        stops = self._filter.settings.infeasible == "stop"
        if trouble and stops and verdict.mode is CommandMode.APPLY:
            return Verdict(CommandMode.FALLBACK, trouble)
        return verdict

    def _conflicts(self, held: dict[str, Array]) -> list[str]:
        """The rows that excluded each other at the last tick, by name."""
        if held["status"][0] != FilterStatus.INFEASIBLE:
            return []
        num_inputs = self._filter.model.num_inputs
        packed = unpack_feasible_set(held["feasible_set"], num_inputs)
        return list(self._filter.names_in_conflict(packed.A, packed.b))

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

    def _status(
        self, held: dict[str, Array], u: Array, stamp: StateStamp
    ) -> vcbf_status:
        message, inbox = vcbf_status(), self._receiver.inbox
        is_ticking = not math.isnan(stamp.sequence)
        message.method = self._filter.settings.method
        message.state_sequence = int(stamp.sequence) if is_ticking else -1
        message.time = stamp.time if is_ticking else 0.0
        message.state_age = _finite(self._receiver.state_age())
        message.followed = self._receiver.is_followed
        message.filter_status = int(np.nan_to_num(held["status"][0]))
        message.num_inputs, message.input = len(u), u.tolist()
        message.reference = held["reference"].tolist()
        message.slack, message.volume = (
            float(held["slack"][0]),
            float(held["volume"][0]),
        )
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
        if inbox.peer_clock is not None:
            message.clock_offset = 1e-6 * inbox.peer_clock.offset
            message.clock_uncertainty = _finite(1e-6 * inbox.peer_clock.uncertainty)
        return message


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan


def command_message(
    u: Sequence[float] | Array, mode: CommandMode, state: StateStamp | vcbf_state
) -> vcbf_command:
    """Returns the command to apply an input (m,), zeros where the mode applies none.

    It answers a state, given by its stamp or its message.
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
