"""simulate: run a scenario's loop and say what happened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

from vcbf_drake.between_ticks.certified_heights import (
    certified_least_barrier,
    is_certifiable,
)
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.errors import ModelError, naming_user_code
from vcbf_drake.model.interface import state_port_of
from vcbf_drake.safety import (
    Assumption,
    SafetyFilter,
    assumptions,
)
from vcbf_drake.simulation.audit import (
    BETWEEN_TICKS,
    FEASIBILITY_HYPOTHESES,
    KNOWLEDGE,
    ROUNDING,
    audit_findings,
    reasons_against,
    reasons_against_feasibility,
)
from vcbf_drake.simulation.faults import fault_assumptions
from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.simulation.log import RunLog
from vcbf_drake.simulation.loop import make_loop, measurement_noise
from vcbf_drake.simulation.result import Result
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.summary import Ending, summarise
from vcbf_drake.typed import typed

Progress = Callable[[float], None]
Watch = Callable[[Diagram, Context], None]

# Ticks whose CPU time is measured.
_SAMPLES = 200
# Isolates the instant of a collision to a microsecond; integration has fixed steps.
_WITNESS_ACCURACY = 1e-4
# How often what was logged is finished, audited and put away: after this time [s], and
# this many ticks, at the latest. Memory does not grow with a run but for its log.
_LONGEST_PIECE, _MOST_TICKS = 10.0, 250
_FRAMES = 25.0  # How often who watches is called, at least [Hz].


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
        log_directory: Where the log grows while the run goes, one .npy file an array,
            readable at any time by `read_log_files`; the result's arrays are mapped
            from there, and memory stays flat. In memory if None.
        watch: Called with the loop and its context at the start, some 25 times a second
            of the motion, and at the end; it may take its time.
        controller: In the place of the vehicle's own, with its ports.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario)
    diagram = make_loop(scenario, controller)
    simulator = make_simulator(diagram, scenario)
    found = loop_assumptions(scenario, diagram, simulator.get_context())
    record = RunLog(diagram, log_directory)
    started = time.process_time()
    with naming_user_code(simulator.get_context().get_time):
        ending = _advance(simulator, scenario, record, progress, watch)
    log, path = record.ticks.arrays(), record.path.arrays()
    cpu_time = time.process_time() - started
    safety_filter: SafetyFilter = diagram.GetSubsystemByName("filter")
    times, heights = path["time"], path["least_height"]
    summary = summarise(
        scenario, safety_filter, log, times, path["state"], heights, ending
    )
    observer = diagram.GetSubsystemByName("filter_observer")
    is_estimated = safety_filter.method.disturbance == "estimated"
    summary["assumptions"] = [vars(assumption) for assumption in found]
    summary["audit"] = audit_findings(
        log, times, heights, scenario.volume.gain, observer if is_estimated else None
    )
    is_known = all(
        summary["audit"].get(name, {}).get("held") is not False for name in KNOWLEDGE
    )
    summary["certified_min_barrier"] = (
        _certified_least(scenario, diagram, found, log, ending) if is_known else None
    )
    summary["reasons_against"] = reasons_against(
        found, summary["audit"], summary["outcome"] == "collision"
    )
    if _fell_short(scenario, summary["certified_min_barrier"]):
        summary["reasons_against"].append(f"not certified: {BETWEEN_TICKS}")
    summary["guaranteed"] = not summary["reasons_against"]
    if safety_filter.gate is not None:
        faults = {
            each.name for each in fault_assumptions(scenario.faults, scenario.noise.std)
        }
        summary["reasons_against_feasible"] = reasons_against_feasibility(
            [each for each in found if each.name in {*FEASIBILITY_HYPOTHESES, *faults}],
            summary["audit"],
            summary["outcome"] == "collision",
        )
        summary["guaranteed_feasible"] = not summary["reasons_against_feasible"]
    if step_time:
        summary["step_cpu_ms"] = step_cpu_time(safety_filter, log)
    summary["real_time_factor"] = ending.time / max(cpu_time, 1e-9)
    return Result(scenario, summary, log)


def _certified_least(
    scenario: Scenario,
    diagram: Diagram,
    found: Sequence[Assumption],
    log: dict[str, Array],
    ending: Ending,
) -> float | None:
    """What h was nowhere below (E87); None where that cannot be certified."""
    source = diagram.GetSubsystemByName("disturbance")
    if not is_certifiable(scenario, found):
        return None
    # A hold that the run's end cut short counts: it is bounded for its whole period.
    holds = int(np.sum(log["time"] < ending.time))
    try:
        least = certified_least_barrier(
            diagram.GetSubsystemByName("filter"),
            log,
            holds,
            scenario.period,
            source.bounds.delta1,
        )
    except ModelError:
        return None
    return least if np.isfinite(least) else None


def _fell_short(scenario: Scenario, certified: float | None) -> bool:
    """Whether the margin that was asked for gave way, and it mattered."""
    asked = scenario.between_ticks == "certified"
    return asked and certified is not None and certified < -ROUNDING


def check_assumptions(scenario: Scenario) -> tuple[Assumption, ...]:
    """Returns the theorems' hypotheses with numbers, before anything moves."""
    diagram = make_loop(scenario)
    simulator = make_simulator(diagram, scenario)
    return loop_assumptions(scenario, diagram, simulator.get_context())


def make_simulator(diagram: Diagram, scenario: Scenario) -> Simulator:
    """Returns a simulator of a diagram with the scenario's plant at its start."""
    simulator = Simulator(diagram)
    ApplySimulatorConfig(
        SimulatorConfig(
            integration_scheme=scenario.integrator.scheme,
            max_step_size=scenario.integrator.max_step or min(scenario.period, 0.01),
            use_error_control=False,
        ),
        simulator,
    )
    context = simulator.get_mutable_context()
    context.SetAccuracy(_WITNESS_ACCURACY)
    plant = diagram.GetSubsystemByName("plant")
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(
        np.array(scenario.initial_state)
    )
    return simulator


def loop_assumptions(
    scenario: Scenario, diagram: Diagram, context: Context
) -> tuple[Assumption, ...]:
    """Returns the hypotheses with the numbers of a loop, at what its context holds."""
    safety_filter: SafetyFilter = diagram.GetSubsystemByName("filter")
    with naming_user_code(context.get_time):
        found = assumptions(
            safety_filter,
            safety_filter.GetMyContextFromRoot(context),
            diagram.GetSubsystemByName("filter_observer"),
            measurement_noise(scenario, safety_filter.model),
        )
    return (*found, *fault_assumptions(scenario.faults, scenario.noise.std))


def _advance(
    simulator: Simulator,
    scenario: Scenario,
    record: RunLog,
    progress: Progress | None,
    watch: Watch | None,
) -> Ending:
    if scenario.ends_at_target:
        simulator.set_monitor(lambda root: _ends_at_target(scenario, simulator, root))
    status = simulator.Initialize()
    least = _FRAMES * scenario.duration if watch else 100 if progress else 1
    for stop in _stops(scenario, math.ceil(least)):
        if _ending(status).monitor:
            break
        if watch is not None:
            watch(simulator.get_system(), simulator.get_mutable_context())
        status = simulator.AdvanceTo(stop)
        record.take(simulator.get_mutable_context())
        if progress is not None:
            progress(stop / scenario.duration)
    record.take(simulator.get_mutable_context())  # Where it ended before it began.
    if watch is not None:
        watch(simulator.get_system(), simulator.get_mutable_context())
    return _ending(status)


def _ends_at_target(
    scenario: Scenario, simulator: Simulator, context: Context
) -> EventStatus:
    plant = simulator.get_system().GetSubsystemByName("plant")
    state = state_port_of(plant).Eval(plant.GetMyContextFromRoot(context))
    (place,) = scenario.vehicle.positions(state[None])
    if math.dist(place, scenario.target) > scenario.arrival_distance:
        return EventStatus.DidNothing()
    return EventStatus.ReachedTermination(plant, "arrived")


def _stops(scenario: Scenario, least: int) -> list[float]:
    """Where to stop on the way, at control ticks so that no step is cut; the end.

    Args:
        scenario: The scenario.
        least: How many pieces to make at least.
    """
    duration, period = scenario.duration, scenario.period
    longest = min(_LONGEST_PIECE, _MOST_TICKS * period)
    pieces = max(math.ceil(duration / longest), least)
    ticks = {int(k * duration / (pieces * period)) for k in range(1, pieces)}
    return [*(tick * period for tick in sorted(ticks - {0})), duration]


def _ending(status: SimulatorStatus) -> Ending:
    ended = status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
    return Ending(
        status.return_time(), str(status.system().get_name()) if ended else ""
    )


def step_cpu_time(
    safety_filter: SafetyFilter, log: dict[str, Array]
) -> dict[str, float]:
    """Returns median and 99th percentile of one filter tick's CPU time [ms].

    The filter is pure, so its ticks are simply evaluated again, from the log, with
    nothing else around them: rows, ellipsoid, gradient and QP.

    Args:
        safety_filter: The filter that ran.
        log: What was logged.
    """
    context = safety_filter.CreateDefaultContext()
    ticks = np.unique(
        np.linspace(0, len(log["time"]) - 1, _SAMPLES).round().astype(int)
    )
    held = np.zeros(safety_filter.model.num_inputs)
    spent = []
    for tick in ticks:
        values = {
            "state": log["state"][tick],
            "reference": log["reference"][tick],
            "held_input": held,
        }
        if "obstacles" in log:
            values["obstacles"] = log["obstacles"][tick]
        if safety_filter.HasInputPort("estimate"):
            values["estimate"] = DisturbanceEstimate(
                log["disturbance_estimate"][tick],
                log["estimate_rate"][tick],
                log["error_bound"][tick],
                log["error_bound_rate"][tick],
                log["refused_intervals"][tick],
                log["quadrature_error"][tick],
            ).pack()
        context.SetTime(float(log["time"][tick]))
        for name, value in values.items():
            safety_filter.GetInputPort(name).FixValue(context, value)
        started = time.thread_time()
        safety_filter.decision(context)
        spent.append(1e3 * (time.thread_time() - started))
    return {
        "median": float(np.median(spent)),
        "p99": float(np.percentile(spent, 99.0)),
    }
