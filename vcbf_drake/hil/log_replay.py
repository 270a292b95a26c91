"""replay_log: the result of a run on hardware, from its event log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import Context

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceObserver
from vcbf_drake.hil.bus import Bus, SimulatedClock
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.controller_side import controller_of
from vcbf_drake.hil.event_log import (
    Event,
    EventLogError,
    logged_scenario,
    of_one_vehicle,
    read_event_log,
)
from vcbf_drake.hil.formats import (
    CommandMode,
    Rejection,
    VehicleMode,
    command_format,
    state_format,
)
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.messages import vcbf_command, vcbf_state, vcbf_status
from vcbf_drake.safety import Assumption, SafetyFilter
from vcbf_drake.simulation.collision_monitor import COLLISION_MONITOR, TOUCH
from vcbf_drake.simulation.loop import logged_ports
from vcbf_drake.simulation.result import Result, finish_log, step_cpu_time
from vcbf_drake.simulation.run import loop_assumptions
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.summary import Ending, summarise

_Key = tuple[int, int]  # Session and sequence of a message.
_STATES, _COMMANDS, _STATUSES = "VCBF_STATE", "VCBF_COMMAND", "VCBF_STATUS"
_OBSTACLES = "VCBF_OBSTACLES"


class LoggedController:
    """Replays the logged messages of a vehicle to a controller, over ``memq://``.

    The clock is the log's. The messages of the log's controller tell which state it
    acted on, and when: this one does the same and restarts where that one did. If the
    log has no such message, it acts on every state. So the log of a controller makes
    the same commands again, bit for bit; that of a vehicle as far as all messages
    arrived. Where a controller was followed, one that never was is left out.

    Args:
        scenario: A validated scenario.
        events: The log's events, of one vehicle.

    Attributes:
        controllers: The controllers, one after the other.
        logged: The log's commands by the state that they answer: session, sequence.
        states: The accepted states.
        on_start: Called with every controller before it is driven.
    """

    def __init__(self, scenario: Scenario, events: Iterable[Event]) -> None:
        self.on_start: Callable[[ControllerProcess], None] = lambda controller: None
        self.controllers: list[ControllerProcess] = []
        self.logged: dict[_Key, vcbf_command] = {}
        self.states: list[Any] = []
        self._scenario = scenario
        n, m = len(scenario.initial_state), len(scenario.input_set.lower)
        self._decoders = {
            _STATES: state_format(n, m).decode,
            _COMMANDS: command_format(m).decode,
            _STATUSES: _decoded_status,
        }
        self._log = [(event, self._decoded(event)) for event in events]
        # By places of the log: who acted then, and when.
        self._acts = self._find_acts()
        # The commands that did not come out again yet, and how others differ.
        self._awaited, self._differences = dict(self.logged), list[float]()

    def run(self) -> None:
        """Drives the controller through the whole log."""
        acts = [act for each in self._acts.values() for act in each]
        first = min((session for session, _ in acts), default=None)
        self._start(self._log[0][0].utime if first is None else first)
        for place, (event, _) in enumerate(self._log):
            if first is not None and event.utime < first:
                continue  # There was no subscriber yet.
            if event.channel in (_STATES, _OBSTACLES):
                self._hear(event)
            for session, utime in self._acts.get(place, ()):
                if session > self._bus.session:
                    self._start(session)
                    if event.channel == _STATES:
                        self._hear(event)
                if session == self._bus.session:
                    self._act_at(utime)
            if first is None and event.channel == _STATES:
                self._act_at(event.utime)

    def report(self) -> dict[str, Any]:
        """Returns the `period` and the `commands` of a `LogReplay`'s report."""
        states = self._messages(vcbf_state)
        answered = [s for s in states if not self.logged or _key(s) in self.logged]
        gaps = np.diff([state.time for state in answered])
        gaps = gaps[gaps > 0.0]
        return {
            "period": float(np.median(gaps)) if len(gaps) else None,
            "commands": {
                "logged": len(self.logged),
                "same": self._differences.count(0.0),
                "largest_difference": max(self._differences, default=0.0),
            },
        }

    def _decoded(self, event: Event) -> Any:
        """Returns an event's message, None if it is not usable."""
        decode = self._decoders.get(event.channel)
        message = None if decode is None else decode(event.data)
        return None if isinstance(message, Rejection) else message

    def _messages(self, kind: type) -> list[Any]:
        return [message for _, message in self._log if isinstance(message, kind)]

    def _find_acts(self) -> dict[int, list[tuple[int, int]]]:
        """The sessions and times of controllers' acts, by the place that they follow.

        The first answer to a state follows that state, wherever in the log it is: a
        vehicle has its next one sent by then. All else, as commands that are held,
        has its own place. Of a command with its status the first counts.
        """
        acts: dict[int, list[tuple[int, int]]] = {}
        known: set[tuple[Any, ...]] = set()
        # The controllers, of several, whose commands the vehicle never took.
        sessions = {command.session for command in self._messages(vcbf_command)}
        followed = {state.command_session for state in self._messages(vcbf_state)}
        strangers = sessions - followed if sessions & followed else set()
        vehicles: dict[int, int] = {}  # The vehicle's session, by a state's sequence.
        unanswered = {
            _key(message): place
            for place, (_, message) in enumerate(self._log)
            if isinstance(message, vcbf_state)
        }
        for place, (_, message) in enumerate(self._log):
            if isinstance(message, vcbf_state):
                vehicles[message.sequence] = message.session
                continue
            if message is None or message.session in strangers:
                continue
            if message.mode == CommandMode.END:
                continue  # Somebody's decision, not the controller's.
            sequence = message.state_sequence
            state = vehicles.get(sequence, 0), sequence
            if isinstance(message, vcbf_command):
                state = _answered(message)
                self.logged.setdefault(state, message)
            act = message.session, message.utime
            if (act, state) not in known:
                known.add((act, state))
                acts.setdefault(unanswered.pop(state, place), []).append(act)
        return acts

    def _start(self, session: int) -> None:
        self._clock = SimulatedClock(session)
        self._bus = Bus(DrakeLcm("memq://"), self._clock)
        self._bus.taps.append(self._take_command)
        controller = controller_of(self._scenario, self._bus)
        receiver = controller.diagram.GetSubsystemByName("state_receiver")
        self._inbox: Inbox = receiver.inbox
        self.controllers.append(controller)
        self.on_start(controller)

    def _hear(self, event: Event) -> None:
        before, self._clock.now = self._inbox.newest, event.utime
        self._bus.lcm.Publish(event.channel, event.data)
        self._bus.poll()
        if self._inbox.newest is not before:
            self.states.append(self._inbox.newest)

    def _act_at(self, utime: int) -> None:
        self._clock.now = utime
        self.controllers[-1].step()

    def _take_command(self, utime: int, channel: str, data: bytes) -> None:
        if channel == _COMMANDS:
            command = vcbf_command.decode(data)
            logged = self._awaited.pop(_answered(command), None)
            if logged is not None:
                self._differences.append(_difference(logged, command))


def _decoded_status(data: bytes) -> vcbf_status | None:
    """Returns a status of any sizes; None for other messages."""
    try:
        return vcbf_status.decode(data)
    except (ValueError, struct.error):
        return None


def _key(message: Any) -> _Key:
    return message.session, message.sequence


def _answered(command: vcbf_command) -> _Key:
    return command.state_session, command.state_sequence


def _difference(logged: vcbf_command, made: vcbf_command) -> float:
    if logged.mode != made.mode or logged.num_inputs != made.num_inputs:
        return np.inf
    return float(np.max(np.abs(np.subtract(logged.input, made.input)), initial=0.0))


@dataclass(frozen=True)
class LogReplay:
    """A run on hardware, reconstructed from its log.

    Attributes:
        result: The run, as `simulate` returns one. Filter and observer are computed
            again from the logged states. `disturbance` is reconstructed from the states
            with hindsight, `input` is the filter's command, and the path consists of
            the measured states.
        damage: The damaged parts of the file, in one line; empty for none.
        report: The scenario; the log's `period`, the median time between its commands
            [s]; how the states arrived (`arrived`); what was asked of the
            vehicle, when and why (`changes`); and `commands`: to how many states the
            log has one, how many of these came out again bit for bit, and the largest
            difference [input units], infinite for another mode.
    """

    result: Result
    damage: str
    report: dict[str, Any]


def replay_log(
    path: str | Path, scenario: Scenario | None = None, name: str | None = None
) -> LogReplay:
    """Returns the run in a log; of several motions, the last.

    Args:
        path: A file of `start_log`, or any LCM log with the messages of this package.
        scenario: The scenario of the run; by default that in the log.
        name: The vehicle's, where the log is of several.

    Raises:
        EventLogError: There is no such file, no scenario or no state in it, or it is of
            several vehicles.
        ScenarioError: The scenario in it does not load.
    """
    events, damage = read_event_log(path)
    events = of_one_vehicle(path, events, name)
    scenario = scenario or logged_scenario(path, events)
    logged = LoggedController(scenario, events)
    recorder = _Recorder(scenario)
    logged.on_start = recorder.add_controller
    logged.run()
    reports = [controller.report() for controller in logged.controllers]
    ways = [report["arrived"] for report in reports]
    rejected = sum((Counter(way["rejected"]) for way in ways), Counter[str]())
    if not recorder.rows:
        found = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
        n, m = len(scenario.initial_state), len(scenario.input_set.lower)
        raise EventLogError(
            f"{path}: no state of {scenario.name} on {_STATES}, with {n} numbers and"
            f" {m} inputs ({found or 'nothing on that channel'})"
        )
    about = {
        "scenario": scenario.name,
        "arrived": {
            **{key: sum(w[key] for w in ways) for key in ("accepted", "lost", "late")},
            "rejected": dict(rejected),
        },
        "changes": [change for report in reports for change in report["changes"]],
        **logged.report(),
    }
    result = recorder.result(logged.states)
    told = ("reasons_against_feasible", "guaranteed_feasible")
    result.summary.update({key: reports[-1][key] for key in told if key in reports[-1]})
    return LogReplay(result, damage, about)


class _Recorder:
    """The values of a hardware loop's ports at every tick, the times among them.

    The last of several ticks at one time is kept, as while a vehicle waits. When time
    goes back because a vehicle has restarted, all earlier ticks are dropped.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.rows: list[dict[str, Any]] = []
        self._scenario = scenario
        self._assumptions: tuple[Assumption, ...] = ()

    def add_controller(self, controller: ControllerProcess) -> None:
        """Records a controller from now on, after the earlier ones."""
        self._diagram = controller.diagram
        named = self._diagram.GetSubsystemByName
        self._filter: SafetyFilter = named("filter")
        self._observer: DisturbanceObserver = named("filter_observer")
        receiver = named("state_receiver")
        self._ports = {
            "state": receiver.GetOutputPort("state"),
            "applied_input": receiver.GetOutputPort("applied_input"),
            **logged_ports(named("controller"), self._filter, self._observer),
        }
        controller.tick_taps.append(self._add_tick)

    def _add_tick(self, context: Context) -> None:
        # The hypotheses are those of the first tick.
        self._assumptions = self._assumptions or loop_assumptions(
            self._scenario, self._diagram, context
        )
        now = context.get_time()
        while self.rows and self.rows[-1]["time"] >= now:
            self.rows.pop()
        row = {
            name: port.Eval(port.get_system().GetMyContextFromRoot(context)).copy()
            for name, port in self._ports.items()
        }
        self.rows.append({"time": now, **row})

    def result(self, said: Sequence[Any]) -> Result:
        """Returns the run, as `simulate` does, as far as it is in the log.

        Args:
            said: The accepted states; the path consists of the last session's.
        """
        log = self._log()
        motion: dict[float, Any] = {}
        for state in said:
            # At its end its time stands still, and the clock does not.
            is_last_word = state.mode == VehicleMode.ENDED and state.time in motion
            if state.session == said[-1].session and not is_last_word:
                motion[state.time] = state
        times = np.array([*motion])
        states = np.array([state.state for state in motion.values()])
        heights = self._filter.barrier_set.values_along(states, times)
        least = np.fmin.reduce(heights, axis=1, initial=np.inf)
        path = {"time": times, "state": states, "least_height": least}
        ending = Ending(float(times[-1]), "")
        if np.any(crossed := least < -TOUCH):
            ending = Ending(float(times[crossed][0]), COLLISION_MONITOR)
        summary = summarise(self._scenario, self._filter, log, path, ending)
        summary["assumptions"] = [vars(assumption) for assumption in self._assumptions]
        summary["step_cpu_ms"] = step_cpu_time(self._filter, log)
        first, last = motion[times[0]], motion[times[-1]]
        elapsed = 1e-6 * (last.utime_measured - first.utime_measured)
        rate = (last.time - first.time) / elapsed if elapsed else np.nan
        summary["real_time_factor"] = rate
        return Result(self._scenario, summary, log)

    def _log(self) -> dict[str, Array]:
        """The arrays of a `Result`, one row a tick, with the disturbance in hindsight.

        A mean (E29) is what d is in the middle of its interval, but for its curvature.
        """
        log = {
            name: np.array([row[name] for row in self.rows]) for name in self.rows[0]
        }
        times, states, applied = log["time"], log["state"], log.pop("applied_input")
        means = [
            self._observer.mean_disturbance(
                states[k - 1], states[k], applied[k], times[k] - times[k - 1]
            ).disturbance
            for k in range(1, len(times))
        ]
        log["disturbance"] = np.zeros((len(times), self._filter.model.num_disturbances))
        if means:
            middles = (times[1:] + times[:-1]) / 2
            channels = [np.interp(times, middles, mean) for mean in np.transpose(means)]
            log["disturbance"] = np.transpose(channels)
        return finish_log(log, self._filter)
