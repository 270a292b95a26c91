"""The state of a vehicle on a bus as ports: as it was measured, and predicted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    State,
)

from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import (
    Reason,
    VehicleMode,
    state_format,
)
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.hil.timing import RoundTrip
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.simulation.scenario import Hardware

# How long a vehicle may take to follow a controller that it hears first [us].
_TO_SETTLE = 300_000


class StateStamp(NamedTuple):
    """Which state it is.

    Attributes:
        session: The sender's session [us].
        sequence: Its number there.
        utime: When it was sent [us].
        time: When it was measured, since the motion began [s].
        moves: 1 if the vehicle says that it is under way, for it follows, falls back,
            or has accepted a command; else 0.
    """

    session: float
    sequence: float
    utime: float
    time: float
    moves: float


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
    | ``stamp`` | 5 | what that state's message says, a `StateStamp`; nan before |
    | ``delays`` | 2 | the state's, and the last command's that it tells of [s] |

    Messages are taken over at the beginning of a simulator's step, or at a forced
    event; between events the outputs are constant.

    Args:
        bus: Where states come from.
        num_states: n.
        num_inputs: m.
        settings: How old a state may be when it arrives, and how long a vehicle must
            be silent before another one of its name is controlled in its place.

    Attributes:
        inbox: What arrived.
        round_trip: From sending a command to learning that it came.
    """

    def __init__(
        self,
        bus: Bus,
        num_states: int,
        num_inputs: int,
        settings: Hardware | None = None,
    ) -> None:
        super().__init__()
        self.round_trip = RoundTrip()
        self._bus = bus
        self._sizes = num_states, num_inputs
        self._last_command = -1
        self._heard, self._heard_since = 0, 0
        settings = settings or Hardware()
        self.inbox = Inbox(
            bus,
            state_format(num_states, num_inputs),
            settings.max_state_age,
            self._take_times,
            silence=settings.max_state_age + settings.hold_time,
            max_clock_offset=settings.max_clock_offset,
            echo=self._echo,
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

    @property
    def is_followed(self) -> bool:
        """Whether the vehicle's last state says that it takes our commands."""
        newest = self.inbox.newest
        return newest is not None and newest.command_session == self._bus.session

    def follows_another(self, within: float) -> bool:
        """Returns whether it applies another's command, which came so lately [s]."""
        newest = self.inbox.newest
        if newest is None or self.is_followed or newest.command_session <= 0:
            return False
        applies = newest.mode == VehicleMode.FOLLOWING
        return applies and bool(newest.command_age < 1e6 * within)

    def notice(self) -> str:
        """Returns why nobody follows, or who else speaks; empty if all is well."""
        newest, now = self.inbox.newest, self._bus.clock.utime()
        is_settled = now - self._heard_since > _TO_SETTLE
        is_lost = newest is not None and is_settled and not self.is_followed
        if is_lost and newest.command_session > 0:
            return f"the vehicle follows another controller, {newest.command_session}"
        if is_lost:
            return "the vehicle tells of no command that it has accepted"
        if self.inbox.last_rejection == Reason.SESSION.value:
            if now - self.inbox.last_rejected_at < 1_000_000:
                return "another vehicle of this name speaks and is not controlled"
        return ""

    def _echo(self, message: Any) -> tuple[int, int] | None:
        """When a command of ours was sent, and how long before the message it came."""
        if message.command_session != self._bus.session:
            return None
        return message.command_utime, message.command_age

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
        if message is None:
            output.SetFromVector(np.full(output.size(), math.nan))
            return
        is_under_way = message.mode in (VehicleMode.FOLLOWING, VehicleMode.FALLBACK)
        has_accepted = message.command_session == self._bus.session
        moves = (is_under_way or has_accepted) and message.mode != VehicleMode.ENDED
        stamp = StateStamp(
            message.session, message.sequence, message.utime, message.time, moves
        )
        output.SetFromVector(stamp)

    def _calc_delays(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        output.SetFromVector(np.zeros(2) if measured is None else measured.delays)

    def _measured_delays(self) -> Array:
        """The delays [s]; zeros while the vehicle does not follow our commands."""
        state = self.inbox.newest
        if state.mode != VehicleMode.FOLLOWING or not self.is_followed:
            return np.zeros(2)
        state_delay = self.inbox.received_at - self.inbox.utime(state.utime_measured)
        arrived_at = self.inbox.utime(state.utime - state.command_age)
        command_delay = arrived_at - state.command_utime
        return 1e-6 * np.array([state_delay, command_delay])

    def _take_times(self, message: Any, now: int) -> None:
        """Notes the round trip of a command that the vehicle mentions first now."""
        if message.session != self._heard:
            self._heard, self._heard_since = message.session, now
        is_ours = message.command_session == self._bus.session
        if is_ours and message.command_sequence > self._last_command:
            self._last_command = message.command_sequence
            self.round_trip.add(now - message.command_utime - message.command_age)


class StatePredictor(LeafSystem):
    """Predicts the state over the delays of the link, both ways.

    .. pydrake_system::

        name: StatePredictor
        input_ports:
        - state
        - delays
        - held_input
        - disturbance_estimate
        output_ports:
        - predicted_state

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``delays`` | 2 | the age of that state, and how long a command takes [s] |
    | ``held_input`` | m | the command that was sent last |
    | ``disturbance_estimate`` | q | held over the prediction |
    | ``predicted_state`` | n | the state when a command sent now arrives |

    What the vehicle applies meanwhile is known: the commands that are on their way,
    each from when it was sent plus a command's delay. The model is integrated over each
    of them by a step of Runge and Kutta's fourth order.

    Args:
        model: The vehicle's f, g, E.
        period: The control period [s].
        longest: No longer delay than this is predicted over, each way [s].
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
        self._remembered = math.ceil(2.0 * longest / period) + 1
        self.DeclareDiscreteState([0.0])
        self.DeclareDiscreteState(np.full(self._remembered * (1 + m), np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)
        self.DeclareVectorOutputPort("predicted_state", n, self._calc)

    def _remember(self, context: Context, discrete: DiscreteValues) -> None:
        """Puts the last command to the earlier ones; the next one is sent now."""
        commands = self._sent(context)
        kept = np.full((self._remembered, commands.shape[1]), np.nan)
        kept[-len(commands) :] = commands[-self._remembered :]
        discrete.set_value(1, kept.ravel())
        discrete.set_value(0, [context.get_time() + self._delays.Eval(context)[0]])

    def _sent(self, context: Context) -> Array:
        """The commands that were sent, the oldest first: time and input, (K, 1 + m)."""
        m = self._model.num_inputs
        sent_at = context.get_discrete_state(0).CopyToVector()
        earlier = context.get_discrete_state(1).CopyToVector().reshape(-1, 1 + m)
        last = np.append(sent_at, self._held.Eval(context))
        # Neither what was never sent, nor what was sent before time went back.
        return np.vstack([earlier[earlier[:, 0] < sent_at], last])

    def horizon(self, context: Context) -> float:
        """Returns how far ahead is predicted: both delays together [s]."""
        return float(np.sum(self._usable_delays(context)))

    def _usable_delays(self, context: Context) -> Array:
        delays: Array = np.clip(self._delays.Eval(context), 0.0, self._longest)
        return delays

    def _calc(self, context: Context, output: BasicVector) -> None:
        x, d = self._state.Eval(context), self._estimate.Eval(context)
        for duration, u in self._applied(context):
            x = runge_kutta_step(self._model, x, u, d, duration)
        output.SetFromVector(x)

    def _applied(self, context: Context) -> Iterator[tuple[float, Array]]:
        """Yields how long which input is applied until a command sent now arrives."""
        sent, (_, delay) = self._sent(context), self._usable_delays(context)
        begin = context.get_time()
        end = begin + self.horizon(context)
        # A command is applied from when it arrives to when the next one does. What was
        # before the first one that is remembered is taken for that one.
        arrivals = np.clip(sent[:, 0] + delay, begin, end)
        arrivals[0] = begin
        for arrival, following, u in zip(
            arrivals, [*arrivals[1:], end], sent[:, 1:], strict=True
        ):
            if following > arrival:
                yield following - arrival, u


def runge_kutta_step(
    model: ControlAffineModel, x: Array, u: Array, d: Array, h: float
) -> Array:
    """Returns the state after a step of Runge and Kutta's fourth order.

    Args:
        model: f, g, E.
        x: The state at its beginning, (n,).
        u: The input, held, (m,).
        d: The disturbance, held, (q,).
        h: How long it is [s].
    """
    push = model.disturbance_matrix @ d

    def rate(at: Array) -> Array:
        return np.asarray(model.nominal_rate(at, u) + push)

    k_1 = rate(x)
    k_2 = rate(x + h / 2 * k_1)
    k_3 = rate(x + h / 2 * k_2)
    k_4 = rate(x + h * k_3)
    return np.asarray(x + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4))
