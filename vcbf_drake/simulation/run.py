"""simulate: run a scenario's loop and say what happened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import time

import numpy as np
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator,
    SimulatorConfig,
    SimulatorStatus,
)
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.errors import Array, ModelError
from vcbf_drake.safety import (
    Assumption,
    SafetyFilter,
    assumptions,
    unpack_feasible_set,
)
from vcbf_drake.simulation.audit import (
    BETWEEN_TICKS,
    ROUNDING,
    audit_findings,
    audit_margins,
    reasons_against,
)
from vcbf_drake.simulation.certified_heights import (
    certified_least_barrier,
    is_certifiable,
)
from vcbf_drake.simulation.faults import fault_assumptions
from vcbf_drake.simulation.loop import (
    COLLISION_MONITOR,
    LOG_PREFIX,
    make_loop,
    measurement_noise,
)
from vcbf_drake.simulation.result import Result
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.step_time import step_cpu_time
from vcbf_drake.simulation.summary import Ending, summarise

Progress = Callable[[float], None]

# Isolates the instant of a collision to a microsecond; integration has fixed steps.
_WITNESS_ACCURACY = 1e-4
_SCALARS = ("error_bound", "error_bound_rate", "slack", "volume", "status")


def simulate(
    scenario: Scenario, progress: Progress | None = None, step_time: bool = True
) -> Result:
    """Runs the scenario's loop from its initial state to its end.

    Args:
        scenario: A validated scenario.
        progress: Called now and then with the fraction of the duration that is done.
        step_time: Whether to measure the filter's step afterwards, for the summary.
    """
    diagram = make_loop(scenario)
    simulator = make_simulator(diagram, scenario)
    found = loop_assumptions(scenario, diagram, simulator.get_context())
    started = time.process_time()
    ending = _advance(simulator, scenario, progress)
    context = simulator.get_context()
    log = _read_log(diagram, context)
    safety_filter: SafetyFilter = diagram.GetSubsystemByName("filter")
    barriers = diagram.GetSubsystemByName(COLLISION_MONITOR).barrier_set
    bounds = diagram.GetSubsystemByName("disturbance").bounds
    log["audit"] = audit_margins(log, safety_filter, barriers, bounds)
    cpu_time = time.process_time() - started
    path_time, path = _find(diagram, context, "path")
    heights = barriers.values_along(path, path_time)
    summary = summarise(scenario, safety_filter, log, path_time, path, heights, ending)
    summary["certified_min_barrier"] = _certified_least(
        scenario, diagram, found, log, ending
    )
    summary["assumptions"] = [vars(assumption) for assumption in found]
    summary["audit"] = audit_findings(log, path_time, heights, scenario.volume.gain)
    summary["reasons_against"] = reasons_against(
        found, summary["audit"], summary["outcome"] == "collision"
    )
    if _fell_short(scenario, summary["certified_min_barrier"]):
        summary["reasons_against"].append(f"not certified: {BETWEEN_TICKS}")
    summary["guaranteed"] = not summary["reasons_against"]
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
    """What h was nowhere below (E76); None where that cannot be certified."""
    source = diagram.GetSubsystemByName("disturbance")
    if not is_certifiable(scenario, found):
        return None
    # A hold that the run's end cut short counts: it is bounded for its whole period.
    holds = int(np.sum(log["time"] < ending.time))
    try:
        return certified_least_barrier(
            diagram.GetSubsystemByName("filter"),
            log,
            holds,
            scenario.period,
            source.bounds.delta1,
        )
    except ModelError:
        return None


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
    found = assumptions(
        safety_filter,
        safety_filter.GetMyContextFromRoot(context),
        diagram.GetSubsystemByName("filter_observer"),
        scenario.period,
        measurement_noise(scenario, safety_filter.model),
    )
    return (*found, *fault_assumptions(scenario.faults))


def _advance(
    simulator: Simulator, scenario: Scenario, progress: Progress | None
) -> Ending:
    status = simulator.Initialize()
    pieces = 1 if progress is None else 100
    for fraction in np.arange(1, pieces + 1) / pieces:
        if _ending(status).monitor:
            break
        status = simulator.AdvanceTo(scenario.duration * fraction)
        if progress is not None:
            progress(float(fraction))
    return _ending(status)


def _ending(status: SimulatorStatus) -> Ending:
    ended = status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
    return Ending(
        status.return_time(), str(status.system().get_name()) if ended else ""
    )


def _find(diagram: Diagram, context: Context, name: str) -> tuple[Array, Array]:
    sink = diagram.GetSubsystemByName(LOG_PREFIX + name)
    log = sink.FindLog(context)
    return log.sample_times().copy(), log.data().T.copy()


def _read_log(diagram: Diagram, context: Context) -> dict[str, Array]:
    names = [
        system.get_name().removeprefix(LOG_PREFIX)
        for system in diagram.GetSystems()
        if system.get_name().startswith(LOG_PREFIX)
    ]
    log: dict[str, Array] = {}
    for name in names:
        if name == "path":
            continue
        times, data = _find(diagram, context, name)
        log["time"] = times
        log[name] = data
    return finish_log(log, diagram.GetSubsystemByName("filter"))


def finish_log(log: dict[str, Array], safety_filter: SafetyFilter) -> dict[str, Array]:
    """Returns the log of a `Result` from the values of ports at the ticks.

    Args:
        log: Arrays (T, size) by the names of `logged_ports`, and others.
        safety_filter: The filter that ran.
    """
    log = {name: v[:, 0] if name in _SCALARS else v for name, v in log.items()}
    packed = unpack_feasible_set(
        log.pop("feasible_set"), safety_filter.num_rows, safety_filter.model.num_inputs
    )
    log["polytope_A"], log["polytope_b"] = packed.A, packed.b
    rows = packed.A[:, len(safety_filter.input_set.b) :]
    log["authority"] = np.linalg.norm(rows * safety_filter.input_set.scale, axis=2)
    log["ellipsoid_shape"], log["ellipsoid_center"] = packed.shape, packed.center
    log["status"] = log["status"].astype(int)
    return log
