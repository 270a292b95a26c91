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
from vcbf_drake.disturbances import DisturbanceObserver
from vcbf_drake.errors import ScenarioError
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.decoding import (
    VehicleMode,
    state_format,
)
from vcbf_drake.hil.event_log import (
    Event,
    EventLogError,
    EventLogWriter,
    read_event_log,
)
from vcbf_drake.hil.logged_controller import LoggedController
from vcbf_drake.safety import Assumption, SafetyFilter
from vcbf_drake.simulation.collision_monitor import TOUCH
from vcbf_drake.simulation.loading import dump_scenario, parse_scenario
from vcbf_drake.simulation.log import finish_log
from vcbf_drake.simulation.loop import COLLISION_MONITOR, logged_ports
from vcbf_drake.simulation.result import Result
from vcbf_drake.simulation.run import loop_assumptions, step_cpu_time
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.summary import Ending, summarise


class TickRecorder:
    """Records what a hardware loop's ports say at every tick.

    Of several ticks at one time, as while a vehicle waits, the last one is kept; when
    time goes back, because a vehicle has started again, everything before is dropped.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[float, dict[str, Array]]] = []

    def watch(self, controller: ControllerProcess) -> None:
        """Records a controller from now on, after those that were watched before."""
        named = controller.diagram.GetSubsystemByName
        self._filter: SafetyFilter = named("filter")
        self._observer: DisturbanceObserver = named("filter_observer")
        receiver = named("state_receiver")
        self._ports = {
            "state": receiver.GetOutputPort("state"),
            "applied_input": receiver.GetOutputPort("applied_input"),
            **logged_ports(named("controller"), self._filter, self._observer),
        }
        controller.tick_taps.append(self._record)

    @property
    def is_empty(self) -> bool:
        """Whether there was no tick yet."""
        return not self._rows

    def _record(self, context: Context) -> None:
        now = context.get_time()
        while self._rows and self._rows[-1][0] >= now:
            self._rows.pop()
        row = {
            name: port.Eval(port.get_system().GetMyContextFromRoot(context)).copy()
            for name, port in self._ports.items()
        }
        self._rows.append((now, row))

    def log(self) -> dict[str, Array]:
        """Returns the arrays of a `Result`, one row a tick.

        Nobody tells what the disturbance was: `disturbance` is what the states tell
        with hindsight, from the intervals before and after a tick.
        """
        log = {
            name: np.array([row[name] for _, row in self._rows]) for name in self._ports
        }
        log["time"] = np.array([time for time, _ in self._rows])
        applied = log.pop("applied_input")
        log["disturbance"] = self._disturbances(log["time"], log["state"], applied)
        return finish_log(log, self._filter)

    def _disturbances(self, times: Array, states: Array, applied: Array) -> Array:
        """The disturbance at the ticks, (T, q): between the means of d over intervals.

        A mean (E46) is what d is in the middle of its interval, but for its curvature.
        """
        means = [
            self._observer.mean_disturbance(
                states[k - 1], states[k], applied[k], times[k] - times[k - 1]
            ).disturbance
            for k in range(1, len(times))
        ]
        if not means:
            return np.zeros((len(times), self._filter.model.num_disturbances))
        middles = (times[1:] + times[:-1]) / 2
        channels = np.transpose(means)
        return np.transpose([np.interp(times, middles, mean) for mean in channels])


# In a log only: nobody sends on it. Its one event is the scenario as YAML text.
SCENARIO_CHANNEL = "VCBF_SCENARIO"


def start_log(
    bus: Bus, scenario: Scenario, path: str | Path, *, force: bool = False
) -> EventLogWriter:
    """Logs a scenario, and from now on whatever a bus sends and receives.

    Args:
        bus: The bus of a vehicle's or a controller's process, before that is made.
        scenario: What is run.
        path: The file; see `EventLogWriter`.
        force: Whether to replace one that is there.

    Raises:
        EventLogError: The file cannot be written.
    """
    log = EventLogWriter(path, force=force)
    channel, text = bus.channel(SCENARIO_CHANNEL), dump_scenario(scenario)
    log(bus.clock.utime(), channel, text.encode())
    bus.taps.append(log)
    return log


def carries_scenario(scenario: Scenario) -> bool:
    """Returns whether its log can be replayed alone: not where a user's class is."""
    return type(scenario.vehicle).__module__.startswith("vcbf_drake.")


@dataclass(frozen=True)
class LogReplay:
    """A run on hardware, as its log tells it.

    Attributes:
        result: The run, as `simulate` returns one. Filter and observer are computed
            again from the logged states. `disturbance` is what the states tell with
            hindsight, `input` what left the filter, and the path the measured states.
        damage: What in the file was no events, in one line; empty for nothing.
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
    """Returns the run that a log tells of; of several motions, the last.

    Args:
        path: A file of `start_log`, or any LCM log with the messages of this package.
        scenario: What was run; by default what the log says.
        name: The vehicle's, where the log is of several.

    Raises:
        EventLogError: There is no such file, no scenario or no state in it, or it is of
            several vehicles.
        ScenarioError: The scenario in it does not load.
    """
    events, damage = read_event_log(path)
    events = _of_one_vehicle(path, events, name)
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
        "period": logged.period(),
        "arrived": arrived,
        "changes": [change for report in reports for change in report["changes"]],
        "commands": {
            "logged": len(logged.logged),
            "same": differences.count(0.0),
            "largest_difference": max(differences, default=0.0),
        },
    }
    return LogReplay(account.result(), damage, about)


def _of_one_vehicle(
    path: str | Path, events: Sequence[Event], name: str | None
) -> list[Event]:
    """The events of one vehicle, on channels without its name."""
    parts = [event.channel.partition("/") for event in events]
    names = sorted({end for base, _, end in parts if base == "VCBF_STATE"})
    if name is None and len(names) > 1:
        found = ", ".join(each or "one without a name" for each in names)
        raise EventLogError(
            f"{path}: is of several vehicles: {found}; --name says which"
        )
    wanted = name if name is not None else (names or [""])[0]
    if name is not None and name not in names:
        found = ", ".join(each or "one without a name" for each in names) or "none"
        raise EventLogError(f"{path}: has no vehicle {name}; it has {found}")
    return [
        event._replace(channel=base)
        for event, (base, _, end) in zip(events, parts, strict=True)
        if end == wanted or base == SCENARIO_CHANNEL
    ]


def logged_scenario(path: str | Path, events: Sequence[Event]) -> Scenario:
    """Returns the scenario that a log carries.

    Raises:
        EventLogError: It carries none.
        ScenarioError: It does not load.
    """
    for event in events:
        if event.channel == SCENARIO_CHANNEL:
            text = event.data.decode(errors="replace")
            try:
                return parse_scenario(text, f"{path}, channel {SCENARIO_CHANNEL}")
            except ScenarioError as error:
                hint = "a log of a vehicle of your own needs its SCENARIO"
                raise ScenarioError(f"{error}; {hint}") from None
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
    """The first state where a barrier is crossed, or the last state."""
    hits = np.flatnonzero(np.any(heights < -TOUCH, axis=1))
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
