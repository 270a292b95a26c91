"""LoggedController: a controller that an event log drives, the same every time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import struct
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm

from vcbf_drake.hil.bus import Bus, SimulatedClock
from vcbf_drake.hil.controller_process import ControllerProcess, controller_of
from vcbf_drake.hil.decoding import (
    CommandMode,
    Rejection,
    command_format,
    state_format,
)
from vcbf_drake.hil.event_log import (
    Event,
)
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.hil.messages import vcbf_command, vcbf_state, vcbf_status
from vcbf_drake.simulation.scenario import Scenario

# Session and sequence of a message.
_Key = tuple[int, int]
_OBSTACLES = "VCBF_OBSTACLES"


class LoggedController:
    """Feeds what a vehicle said, as logged, to a controller, over ``memq://``.

    The clock is the log's. The controller acts on the states that the log has commands
    for, when those were sent, and on every state if the log has no commands at all. A
    controller that started again in the log starts again here. So the log of a
    controller makes the same commands again, bit for bit; the log of a vehicle does so
    as far as all messages arrived.

    Args:
        scenario: A validated scenario.
        events: The log's events, of one vehicle.

    Attributes:
        controllers: The controllers, one after the other.
        logged: The log's commands by the state they answer first: session, sequence.
        sent: The commands that were made, likewise.
        on_start: Called with every controller before it is driven.
        on_state: Called with every state that is accepted.
    """

    def __init__(self, scenario: Scenario, events: Iterable[Event]) -> None:
        self.on_start: Callable[[ControllerProcess], None] = lambda controller: None
        self.on_state: Callable[[Any], None] = lambda state: None
        self.controllers: list[ControllerProcess] = []
        self.sent: dict[_Key, vcbf_command] = {}
        self._scenario, self._events = scenario, list(events)
        n, m = len(scenario.initial_state), len(scenario.input_set.lower)
        self._states = state_format(n, m).channel
        self._commands, self._statuses = command_format(m), "VCBF_STATUS"
        self.logged: dict[_Key, vcbf_command] = {}
        self._repeated: dict[_Key, vcbf_command] = {}
        for command in self._logged_commands():
            if command.mode == CommandMode.END:
                continue  # Somebody's decision, not the controller's.
            state = command.state_session, command.state_sequence
            if self.logged.setdefault(state, command) is not command:
                self._repeated[_key(command)] = command

    def run(self) -> None:
        """Drives the controller through the whole log."""
        first = min((c.session for c in self.logged.values()), default=None)
        self._start(self._events[0].utime if first is None else first)
        for event in self._events:
            if first is not None and event.utime < first:
                continue  # Nobody listened yet.
            if event.channel == self._states:
                self._take_state(event)
            elif event.channel == _OBSTACLES:
                self._hear(event)
            elif event.channel == self._commands.channel:
                self._repeat(event)
            elif event.channel == self._statuses:
                self._wait(event)

    def differences(self) -> list[float]:
        """Returns how far the commands made are from those logged, state by state.

        In the inputs' units; infinite where mode or size differ.
        """
        return [
            _difference(command, self.sent[state])
            for state, command in self.logged.items()
            if state in self.sent
        ]

    def period(self) -> float | None:
        """Returns the median time between the commands, by the vehicle's time [s]."""
        answered = set(self.logged)
        times = []
        for event in self._events:
            if event.channel == self._states:
                try:
                    state = vcbf_state.decode(event.data)
                except (ValueError, struct.error):
                    continue
                if not answered or _key(state) in answered:
                    times.append(state.time)
        gaps = np.diff(times)
        gaps = gaps[gaps > 0.0]
        return float(np.median(gaps)) if len(gaps) else None

    def _logged_commands(self) -> Iterator[vcbf_command]:
        for event in self._events:
            if event.channel == self._commands.channel:
                message = self._commands.decode(event.data)
                if not isinstance(message, Rejection):
                    yield message

    def _start(self, session: int) -> None:
        self._clock = SimulatedClock(session)
        self._bus = Bus(DrakeLcm("memq://"), self._clock)
        self._bus.taps.append(self._take_command)
        controller = controller_of(self._scenario, self._bus)
        receiver = controller.diagram.GetSubsystemByName("state_receiver")
        self._inbox: Inbox = receiver.inbox
        self.controllers.append(controller)
        self.on_start(controller)

    def _take_state(self, event: Event) -> None:
        before = self._inbox.newest
        self._hear(event)
        newest = self._inbox.newest
        if newest is before:
            return
        self.on_state(newest)
        answer = self.logged.get(_key(newest))
        if answer is not None and answer.session > self._bus.session:
            self._start(answer.session)
            self._hear(event)
        if answer is not None:
            self._clock.now = answer.utime
        if answer is not None or not self.logged:
            self.controllers[-1].step()

    def _hear(self, event: Event) -> None:
        self._clock.now = event.utime
        self._bus.lcm.Publish(event.channel, event.data)
        self._bus.poll()

    def _repeat(self, event: Event) -> None:
        """Has a command sent again that was sent without a new state."""
        message = self._commands.decode(event.data)
        if not isinstance(message, Rejection) and _key(message) in self._repeated:
            self._clock.now = message.utime
            self.controllers[-1].step()

    def _wait(self, event: Event) -> None:
        """Has a status sent again that was sent before the first state."""
        try:
            status = vcbf_status.decode(event.data)
        except (ValueError, struct.error):
            return
        if status.state_sequence < 0 and status.session == self._bus.session:
            self._clock.now = status.utime
            self.controllers[-1].step()

    def _take_command(self, utime: int, channel: str, data: bytes) -> None:
        if channel == self._commands.channel:
            command = vcbf_command.decode(data)
            state = command.state_session, command.state_sequence
            self.sent.setdefault(state, command)


def _key(message: Any) -> _Key:
    return message.session, message.sequence


def _difference(logged: vcbf_command, made: vcbf_command) -> float:
    if logged.mode != made.mode or logged.num_inputs != made.num_inputs:
        return np.inf
    return float(np.max(np.abs(np.subtract(logged.input, made.input)), initial=0.0))
