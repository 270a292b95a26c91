"""StateReceiver: the state of a vehicle that is on the bus."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import state_format
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.modes import VehicleMode
from vcbf_drake.hil.round_trip import RoundTrip


class StateStamp(NamedTuple):
    """Which state it is.

    Attributes:
        session: The sender's session [us].
        sequence: Its number there.
        utime: When it was sent [us].
        time: When it was measured, since the motion began [s].
    """

    session: float
    sequence: float
    utime: float
    time: float


@dataclass(frozen=True)
class _Measured:
    """The last state that was taken over, and what goes with it.

    Attributes:
        message: The state's message.
        applied_input: The mean input that was applied before it.
        delays: Its delay, and that of the last command that the vehicle tells of [s].
    """

    message: Any
    applied_input: Array
    delays: Array


class StateReceiver(LeafSystem):
    """Takes the place of a plant: its outputs are what the vehicle said last.

    .. pydrake_system::

        name: StateReceiver
        output_ports:
        - state
        - applied_input
        - stamp
        - delays

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the newest measured state; zeros before the first |
    | ``applied_input`` | m | the mean of what was applied since the state before |
    | ``stamp`` | 4 | what that state's message says, a `StateStamp`; nan before |
    | ``delays`` | 2 | the state's, and the last command's that it tells of [s] |

    Messages are taken over at the beginning of a simulator's step, or at a forced
    event; between events the outputs are constant.

    Args:
        bus: Where states come from.
        num_states: n.
        num_inputs: m.
        max_age: How old a state may be when it arrives [s].

    Attributes:
        inbox: What arrived.
        round_trip: From sending a command to learning that it came.
    """

    def __init__(
        self, bus: Bus, num_states: int, num_inputs: int, max_age: float
    ) -> None:
        super().__init__()
        self.round_trip = RoundTrip()
        self._bus = bus
        self._sizes = num_states, num_inputs
        self._last_command = -1
        self.inbox = Inbox(
            bus, state_format(num_states, num_inputs), max_age, self._take_times
        )
        # A tuple of the message or of none: newer pydrake's values are never None.
        index = self.DeclareAbstractState(AbstractValue.Make(()))
        self._measured_index = index
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        self.DeclareForcedUnrestrictedUpdateEvent(self._take_over)
        needs = {self.abstract_state_ticket(index)}
        self.DeclareVectorOutputPort("state", num_states, self._calc_state, needs)
        self.DeclareVectorOutputPort("delays", 2, self._calc_delays, needs)
        self.DeclareVectorOutputPort(
            "applied_input", num_inputs, self._calc_applied_input, needs
        )
        size = len(StateStamp._fields)
        self.DeclareVectorOutputPort("stamp", size, self._calc_stamp, needs)

    def message(self, context: Context) -> Any:
        """Returns the message that the outputs show, None before the first."""
        measured = self._measured(context)
        return None if measured is None else measured.message

    def has_news(self, context: Context) -> bool:
        """Returns whether a newer message has come than the outputs show."""
        shown, newest = self.message(context), self.inbox.newest
        # A context holds copies: they are told apart by their numbers.
        return newest is not None and (
            shown is None
            or (newest.session, newest.sequence) != (shown.session, shown.sequence)
        )

    def time(self, context: Context) -> float:
        """Returns the vehicle's time of the state, 0 before the first [s]."""
        measured = self._measured(context)
        return 0.0 if measured is None else float(measured.message.time)

    def _measured(self, context: Context) -> _Measured | None:
        held: tuple[_Measured, ...] = context.get_abstract_state(
            self._measured_index
        ).get_value()
        return held[0] if held else None

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        if not self.has_news(context):
            return EventStatus.DidNothing()
        last, newest = self._measured(context), self.inbox.newest
        applied = np.zeros(self._sizes[1])
        if last is not None and newest.time > last.message.time:
            change = np.subtract(newest.input_integral, last.message.input_integral)
            applied = change / (newest.time - last.message.time)
        state.get_mutable_abstract_state(self._measured_index).set_value(
            (_Measured(newest, applied, self._measured_delays()),)
        )
        return EventStatus.Succeeded()

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        zeros = np.zeros(self._sizes[0])
        output.SetFromVector(zeros if measured is None else measured.message.state)

    def _calc_applied_input(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        zeros = np.zeros(self._sizes[1])
        output.SetFromVector(zeros if measured is None else measured.applied_input)

    def _calc_stamp(self, context: Context, output: BasicVector) -> None:
        message = self.message(context)
        output.SetFromVector(
            [
                math.nan if message is None else getattr(message, name)
                for name in StateStamp._fields
            ]
        )

    def _calc_delays(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        output.SetFromVector(np.zeros(2) if measured is None else measured.delays)

    def _measured_delays(self) -> Array:
        """The delays [s]; zeros while the vehicle does not follow our commands."""
        state = self.inbox.newest
        is_ours = state.command_utime >= self._bus.session
        if state.mode != VehicleMode.FOLLOWING or not is_ours:
            return np.zeros(2)
        state_delay = self.inbox.received_at - state.utime_measured
        command_delay = state.utime - state.command_age - state.command_utime
        return 1e-6 * np.array([state_delay, command_delay])

    def _take_times(self, message: Any, now: int) -> None:
        """Notes the round trip of a command that the vehicle mentions first now."""
        is_ours = message.command_utime >= self._bus.session
        if is_ours and message.command_sequence > self._last_command:
            self._last_command = message.command_sequence
            self.round_trip.add(now - message.command_utime - message.command_age)
