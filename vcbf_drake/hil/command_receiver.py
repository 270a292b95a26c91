"""CommandReceiver: what a vehicle applies, with its watchdog."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import command_format
from vcbf_drake.hil.fallback import fallback_input
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.modes import CommandMode, VehicleMode
from vcbf_drake.hil.round_trip import RoundTrip
from vcbf_drake.hil.timeline import Timeline
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import InputSet
from vcbf_drake.simulation.scenario import Hardware

# Commands that a step may find waiting; the oldest of more are obsolete anyway.
_MOST_WAITING = 1000


class _Received(NamedTuple):
    """A command, and when it came [us]."""

    command: Any
    at: int


class CommandReceiver(LeafSystem):
    """Applies the newest command, or falls back when none came for too long.

    .. pydrake_system::

        name: CommandReceiver
        input_ports:
        - state
        output_ports:
        - input
        - mode

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the vehicle's state, for the brake |
    | ``input`` | m | what the actuators apply: always inside their limits |
    | ``mode`` | 1 | a `VehicleMode` |

    At the beginning of every simulator step the newest command that has come by then is
    taken, and the watchdog looks at its age; between steps the input is held. A process
    that wakes late handles commands that are younger than the step it has to make up
    for: that one step passes them over, for they were not there yet, and the next one
    takes them. So a command acts from the second step on at the latest that begins
    after it was handled, whatever comes after it.

    Args:
        bus: Where commands come from.
        model: The vehicle's f, g, E.
        input_set: What its actuators can do.
        settings: When to fall back, and how.
        timeline: Tells the time of the context.

    Attributes:
        inbox: What arrived.
        round_trip: From sending a state to the command that answers it.
    """

    def __init__(
        self,
        bus: Bus,
        model: ControlAffineModel,
        input_set: InputSet,
        settings: Hardware,
        timeline: Timeline,
    ) -> None:
        super().__init__()
        self._bus, self._settings, self._timeline = bus, settings, timeline
        self._model, self._input_set = model, input_set
        m = model.num_inputs
        self.round_trip = RoundTrip()
        self.inbox = Inbox(
            bus, command_format(m), settings.command_timeout, self._receive
        )
        self._applied: _Received | None = None
        self._waiting: deque[_Received] = deque(maxlen=_MOST_WAITING)
        self._passed_over = 0
        self._state = self.DeclareVectorInputPort("state", model.num_states)
        # The input, and the mode.
        self.DeclareDiscreteState(np.append(np.zeros(m), VehicleMode.WAITING))
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        needs = {self.xd_ticket()}
        self.DeclareVectorOutputPort("input", m, self._calc_input, needs)
        self.DeclareVectorOutputPort("mode", 1, self._calc_mode, needs)

    def mode(self, context: Context) -> VehicleMode:
        """Returns what the vehicle does."""
        return VehicleMode(int(_held(context)[-1]))

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        mode, u = self._choose(context)
        state.get_mutable_discrete_state().set_value(np.append(u, mode))
        return EventStatus.Succeeded()

    def _take_commands(self, now: int) -> None:
        """Takes what has come by `now` [us], and whatever a step passed over before."""
        waiting = self._waiting
        while waiting and (self._passed_over > 0 or waiting[0].at <= now):
            self._applied = waiting.popleft()
            self._passed_over -= 1
        self._passed_over = len(waiting)

    def _choose(self, context: Context) -> tuple[VehicleMode, Array]:
        now = self._timeline.utime(context.get_time())
        self._take_commands(now)
        if self._applied is None:
            return self.mode(context), _held(context)[:-1]
        command, received_at = self._applied
        age = 1e-6 * (now - received_at)
        applies = command.mode in (CommandMode.APPLY, CommandMode.HOLD)
        if applies and age <= self._settings.command_timeout:
            return VehicleMode.FOLLOWING, self._input_set.project(command.input)
        return VehicleMode.FALLBACK, fallback_input(
            self._settings.fallback,
            self._model,
            self._input_set,
            self._state.Eval(context),
            self._settings.brake_rate,
        )

    def _calc_input(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(_held(context)[:-1])

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        output[0] = _held(context)[-1]

    def _receive(self, command: Any, now: int) -> None:
        self._waiting.append(_Received(command, now))
        is_answer = command.state_session == self._bus.session
        if is_answer and command.mode == CommandMode.APPLY:
            self.round_trip.add(now - command.state_utime)


def _held(context: Context) -> Array:
    held: Array = context.get_discrete_state_vector().CopyToVector()
    return held
