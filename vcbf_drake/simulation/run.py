"""simulate: the simulation of a scenario's loop, and its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
import math
from pathlib import Path
import time

import numpy as np
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator,
    SimulatorConfig,
    SimulatorStatus,
)
from pydrake.systems.framework import Context, Diagram, EventStatus, System

from vcbf_drake.checks import Array, require
from vcbf_drake.errors import naming_user_code
from vcbf_drake.model.interface import state_port_of
from vcbf_drake.safety import (
    Assumption,
    SafetyFilter,
    assumptions,
)
from vcbf_drake.simulation.collision_monitor import COLLISION_MONITOR, TOUCH
from vcbf_drake.simulation.faults import fault_assumptions
from vcbf_drake.simulation.fleet import (
    Fleet,
    least_separation,
    loops_of,
    make_fleet_loop,
    others_assumption,
)
from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.simulation.loop import measurement_noise
from vcbf_drake.simulation.result import Result, RunLog, step_cpu_time
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.summary import Ending, judge
from vcbf_drake.typed import typed

Progress = Callable[[float], None]
Watch = Callable[[Diagram, Context], None]

# Isolates the instant of a collision to a microsecond; integration has fixed steps.
_WITNESS_ACCURACY = 1e-4
# How often what was logged is finished, audited and put away: after this time [s], and
# this many ticks, at the latest. Memory does not grow with a run but for its log.
_LONGEST_PIECE, _MOST_TICKS = 10.0, 250
_FRAMES = 25.0  # The least rate at which `watch` is called [Hz].


@typed
def simulate(
    scenario: Scenario | str | Path,
    progress: Progress | None = None,
    step_time: bool = True,
    log_directory: str | Path | None = None,
    watch: Watch | None = None,
    controller: System | None = None,
) -> Result:
    """Runs the scenario's loop from its initial state to its end.

    Args:
        scenario: The scenario, or what `load_scenario` takes.
        progress: Called now and then with the fraction of the duration that is done.
        step_time: Whether to measure the filter's step afterwards, for the summary.
        log_directory: The directory of the log that grows with the run, one .npy file
            per array, readable at any time by `read_log_files`; the result's arrays are
            mapped from there, and memory stays flat. In memory if None.
        watch: Called with the loop and its context at the start, some 25 times a second
            of the motion, and at the end; it may take its time.
        controller: In the place of the vehicle's own, with its ports.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario)
    (result,) = simulate_fleet(
        Fleet.of(scenario), progress, step_time, log_directory, watch, controller
    )
    return result


@typed
def simulate_fleet(
    fleet: Fleet,
    progress: Progress | None = None,
    step_time: bool = True,
    log_directory: str | Path | None = None,
    watch: Watch | None = None,
    controller: System | None = None,
) -> list[Result]:
    """Runs the loops of a fleet together; returns the result of each vehicle.

    Where there are several, each one's summary has the least distance from the others
    too, as ``least_separation`` [m].

    Args:
        fleet: The vehicles.
        progress: See `simulate`.
        step_time: See `simulate`.
        log_directory: See `simulate`; of several vehicles each has a directory there.
        watch: See `simulate`.
        controller: In the place of an only vehicle's own, with its ports.
    """
    diagram = make_fleet_loop(fleet, controller)
    simulator = make_simulator(diagram, fleet)
    context, loops = simulator.get_mutable_context(), loops_of(diagram, fleet)
    several = len(loops) > 1
    vehicles = [*zip(fleet.vehicles, loops, strict=True)]
    found = [loop_assumptions(*each, context, several) for each in vehicles]
    records = []
    for scenario, loop in vehicles:
        place = None if log_directory is None else Path(log_directory)
        if place is not None and several:
            place /= scenario.name
        records.append(RunLog(loop, place))
    started = time.process_time()
    with naming_user_code(context.get_time):
        status = _advance(simulator, fleet, records, progress, watch)
    logs = [(each.ticks.arrays(), each.path.arrays()) for each in records]
    rate = status.return_time() / max(time.process_time() - started, 1e-9)
    places = [
        each.vehicle.positions(path["state"])
        for each, (_, path) in zip(fleet.vehicles, logs, strict=True)
    ]
    results = []
    for i, (scenario, loop) in enumerate(vehicles):
        log, path = logs[i]
        ending = _ending(status, scenario, several, path)
        summary = judge(scenario, loop, log, path, found[i], ending)
        if several:
            summary["least_separation"] = least_separation(places, i)
        if step_time:
            safety_filter = loop.GetSubsystemByName("filter")
            summary["step_cpu_ms"] = step_cpu_time(safety_filter, log)
        summary["real_time_factor"] = rate
        results.append(Result(scenario, summary, log))
    return results


def check_assumptions(scenario: Scenario | Fleet) -> tuple[Assumption, ...]:
    """Returns the theorems' hypotheses with numbers, before anything moves.

    The hypotheses of several vehicles follow each other, with the vehicles' names.

    Raises:
        InvalidValueError: A controller's reference is not finite at the start.
        UserCodeError: A controller fails there.
    """
    fleet = scenario if isinstance(scenario, Fleet) else Fleet.of(scenario)
    diagram = make_fleet_loop(fleet)
    context = make_simulator(diagram, fleet).get_context()
    found, several = list[Assumption](), len(fleet.vehicles) > 1
    for each, loop in zip(fleet.vehicles, loops_of(diagram, fleet), strict=True):
        with naming_user_code(context.get_time):
            law = loop.GetSubsystemByName("controller")
            at_start = law.GetMyContextFromRoot(context)
            u = law.GetOutputPort("reference").Eval(at_start)
        require(bool(np.isfinite(u).all()), "reference at the start", u, "finite")
        for own in loop_assumptions(each, loop, context, several):
            name = f"{each.name}: {own.name}" if several else own.name
            found.append(replace(own, name=name))
    return tuple(found)


def make_simulator(diagram: Diagram, scenario: Scenario | Fleet) -> Simulator:
    """Returns a simulator of a diagram with the scenario's plants at their start."""
    fleet = scenario if isinstance(scenario, Fleet) else Fleet.of(scenario)
    first, simulator = fleet.vehicles[0], Simulator(diagram)
    ApplySimulatorConfig(
        SimulatorConfig(
            integration_scheme=first.integrator.scheme,
            max_step_size=first.integrator.max_step or min(first.period, 0.01),
            use_error_control=False,
        ),
        simulator,
    )
    context = simulator.get_mutable_context()
    context.SetAccuracy(_WITNESS_ACCURACY)
    for each, loop in zip(fleet.vehicles, loops_of(diagram, fleet), strict=True):
        plant = loop.GetSubsystemByName("plant")
        plant.GetMyMutableContextFromRoot(context).SetContinuousState(
            np.array(each.initial_state)
        )
    return simulator


def loop_assumptions(
    scenario: Scenario, diagram: Diagram, context: Context, has_others: bool = False
) -> tuple[Assumption, ...]:
    """Returns the hypotheses with the numbers of a loop at the root's context."""
    safety_filter: SafetyFilter = diagram.GetSubsystemByName("filter")
    with naming_user_code(context.get_time):
        found = assumptions(
            safety_filter,
            safety_filter.GetMyContextFromRoot(context),
            diagram.GetSubsystemByName("filter_observer"),
            measurement_noise(scenario, safety_filter.model),
        )
    others = [others_assumption(scenario)] * has_others
    faults = fault_assumptions(scenario.faults, scenario.noise.std)
    return (*found, *others, *faults)


def _advance(
    simulator: Simulator,
    fleet: Fleet,
    records: Sequence[RunLog],
    progress: Progress | None,
    watch: Watch | None,
) -> SimulatorStatus:
    first, context = fleet.vehicles[0], simulator.get_mutable_context()
    if first.ends_at_target:
        simulator.set_monitor(lambda root: _ends_at_target(fleet, simulator, root))
    status = simulator.Initialize()
    least = _FRAMES * fleet.duration if watch else 100 if progress else 1
    for stop in _stops(first, math.ceil(least)):
        if _has_ended(status):
            break
        if watch is not None:
            watch(simulator.get_system(), context)
        status = simulator.AdvanceTo(stop)
        for record in records:
            record.take(context)
        if progress is not None:
            progress(stop / fleet.duration)
    for record in records:
        record.take(context)  # Where it ended before it began.
    if watch is not None:
        watch(simulator.get_system(), context)
    return status


def _ends_at_target(
    fleet: Fleet, simulator: Simulator, context: Context
) -> EventStatus:
    loops = loops_of(simulator.get_system(), fleet)
    for each, loop in zip(fleet.vehicles, loops, strict=True):
        plant = loop.GetSubsystemByName("plant")
        state = state_port_of(plant).Eval(plant.GetMyContextFromRoot(context))
        (place,) = each.vehicle.positions(state[None])
        if math.dist(place, each.target) > each.arrival_distance:
            return EventStatus.DidNothing()
    return EventStatus.ReachedTermination(simulator.get_system(), "arrived")


def _stops(scenario: Scenario, least: int) -> list[float]:
    """The times to stop at, all control ticks so that no step is cut, and the end."""
    duration, period = scenario.duration, scenario.period
    longest = min(_LONGEST_PIECE, _MOST_TICKS * period)
    pieces = max(math.ceil(duration / longest), least)
    ticks = {int(k * duration / (pieces * period)) for k in range(1, pieces)}
    return [*(tick * period for tick in sorted(ticks - {0})), duration]


def _has_ended(status: SimulatorStatus) -> bool:
    reason = SimulatorStatus.ReturnReason.kReachedTerminationCondition
    return bool(status.reason() == reason)


def _ending(
    status: SimulatorStatus,
    scenario: Scenario,
    several: bool,
    path: Mapping[str, Array],
) -> Ending:
    """The ending of a run for one vehicle: another's monitor may have ended it."""
    monitor = ""
    if _has_ended(status):
        *_, owner, monitor = status.system().GetSystemPathname().split("::")
        if several and owner != scenario.name:
            collides = path["least_height"][-1] < -TOUCH
            monitor = COLLISION_MONITOR if collides else ""
    return Ending(status.return_time(), monitor)
