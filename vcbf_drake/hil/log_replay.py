"""replay_log: the result of a run on hardware, from its event log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.decoding import state_format
from vcbf_drake.hil.event_log import (
    Event,
    EventLogError,
    EventLogWriter,
    read_event_log,
)
from vcbf_drake.hil.logged_controller import LoggedController
from vcbf_drake.hil.modes import VehicleMode
from vcbf_drake.hil.tick_recorder import TickRecorder
from vcbf_drake.safety import Assumption, SafetyFilter
from vcbf_drake.simulation.loop import COLLISION_MONITOR
from vcbf_drake.simulation.result import Result
from vcbf_drake.simulation.run import loop_assumptions
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.scenario_file import dump_scenario, parse_scenario
from vcbf_drake.simulation.step_time import step_cpu_time
from vcbf_drake.simulation.summary import Ending, summarise

# In a log only: nobody sends on it. Its one event is the scenario as YAML text.
SCENARIO_CHANNEL = "VCBF_SCENARIO"


def start_log(bus: Bus, scenario: Scenario, path: str | Path) -> EventLogWriter:
    """Logs a scenario, and from now on whatever a bus sends and receives.

    Args:
        bus: The bus of a vehicle's or a controller's process, before that is made.
        scenario: What is run.
        path: The file, which is replaced.

    Raises:
        EventLogError: The file cannot be written.
    """
    log = EventLogWriter(path)
    log(bus.clock.utime(), SCENARIO_CHANNEL, dump_scenario(scenario).encode())
    bus.taps.append(log)
    return log


@dataclass(frozen=True)
class LogReplay:
    """A run on hardware, as its log tells it.

    Attributes:
        result: The run, as `simulate` returns one. Filter and observer are computed
            again from the logged states. `disturbance` is what the states tell with
            hindsight, `input` what left the filter, and the path the measured states.
        damage: What in the file was no events, in one line; empty for nothing.
        report: The scenario; how the states arrived (`arrived`); what was asked of the
            vehicle, when and why (`changes`); and `commands`: to how many states the
            log has one, how many of these came out again bit for bit, and the largest
            difference [input units], infinite for another mode.
    """

    result: Result
    damage: str
    report: dict[str, Any]


def replay_log(path: str | Path, scenario: Scenario | None = None) -> LogReplay:
    """Returns the run that a log tells of; of several motions, the last.

    Args:
        path: A file of `start_log`, or any LCM log with the messages of this package.
        scenario: What was run; by default what the log says.

    Raises:
        EventLogError: There is no such file, no scenario or no state in it.
        ScenarioError: The scenario in it does not load.
    """
    events, damage = read_event_log(path)
    scenario = scenario or logged_scenario(path, events)
    logged = LoggedController(scenario, events)
    account = _Account(scenario)
    logged.on_start, logged.on_state = account.add_controller, account.add_state
    logged.run()
    reports = [controller.report() for controller in logged.controllers]
    arrived = _total([report["arrived"] for report in reports])
    if account.recorder.is_empty:
        raise EventLogError(_no_states(path, scenario, arrived["rejected"]))
    differences = logged.differences()
    about = {
        "scenario": scenario.name,
        "arrived": arrived,
        "changes": [change for report in reports for change in report["changes"]],
        "commands": {
            "logged": len(logged.logged),
            "same": differences.count(0.0),
            "largest_difference": max(differences, default=0.0),
        },
    }
    return LogReplay(account.result(), damage, about)


def logged_scenario(path: str | Path, events: Sequence[Event]) -> Scenario:
    """Returns the scenario that a log carries.

    Raises:
        EventLogError: It carries none.
        ScenarioError: It does not load.
    """
    for event in events:
        if event.channel == SCENARIO_CHANNEL:
            text = event.data.decode(errors="replace")
            return parse_scenario(text, f"{path}, channel {SCENARIO_CHANNEL}")
    raise EventLogError(f"{path}: carries no scenario; it must be given")


class _Account:
    """What is needed of a run for its result."""

    def __init__(self, scenario: Scenario) -> None:
        self.recorder = TickRecorder()
        self._scenario = scenario
        self._assumptions: tuple[Assumption, ...] = ()
        self._path: list[Any] = []

    def add_controller(self, controller: ControllerProcess) -> None:
        self._diagram = controller.diagram
        if self.recorder.is_empty:
            controller.tick_taps.append(self._assume)
        self.recorder.watch(controller)

    def _assume(self, context: Context) -> None:
        """Takes the hypotheses down, at the first tick."""
        self._assumptions = self._assumptions or loop_assumptions(
            self._scenario, self._diagram, context
        )

    def add_state(self, state: Any) -> None:
        if self._path and state.session != self._path[-1].session:
            self._path.clear()
        if self._has_stopped(state):
            return  # Its time stands still now, and the clock does not.
        while self._path and self._path[-1].time >= state.time:
            self._path.pop()
        self._path.append(state)

    def _has_stopped(self, state: Any) -> bool:
        is_last = state.mode == VehicleMode.ENDED and bool(self._path)
        return is_last and bool(state.time == self._path[-1].time)

    def result(self) -> Result:
        safety_filter: SafetyFilter = self._diagram.GetSubsystemByName("filter")
        log = self.recorder.log()
        times = np.array([state.time for state in self._path])
        path = np.array([state.state for state in self._path])
        heights = safety_filter.barrier_set.values_along(path, times)
        ending = _ending(times, heights)
        summary = summarise(
            self._scenario, safety_filter, log, times, path, heights, ending
        )
        summary["assumptions"] = [vars(assumption) for assumption in self._assumptions]
        summary["step_cpu_ms"] = step_cpu_time(safety_filter, log)
        summary["real_time_factor"] = _rate(self._path[0], self._path[-1])
        return Result(self._scenario, summary, log)


def _ending(times: Array, heights: Array) -> Ending:
    """The first state where a barrier is not positive, or the last state."""
    hits = np.flatnonzero(np.any(heights <= 0.0, axis=1))
    if len(hits):
        return Ending(float(times[hits[0]]), COLLISION_MONITOR)
    return Ending(float(times[-1]), "")


def _rate(first: Any, last: Any) -> float:
    """The vehicle's time by the clock's, between two states."""
    elapsed = 1e-6 * (last.utime_measured - first.utime_measured)
    return float(last.time - first.time) / elapsed if elapsed else np.nan


def _total(arrived: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How the states arrived at one controller after the other."""
    rejected: Counter[str] = Counter()
    for each in arrived:
        rejected.update(each["rejected"])
    keys = ("accepted", "lost", "late")
    total: dict[str, Any] = {key: sum(each[key] for each in arrived) for key in keys}
    return total | {"rejected": dict(rejected)}


def _no_states(path: str | Path, scenario: Scenario, rejected: dict[str, int]) -> str:
    n, m = len(scenario.initial_state), len(scenario.input_set.lower)
    found = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    return (
        f"{path}: no state of {scenario.name} on {state_format(n, m).channel},"
        f" with {n} numbers and {m} inputs ({found or 'nothing on that channel'})"
    )
