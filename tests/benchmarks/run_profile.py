"""Where a run's CPU time goes: python tests/benchmarks/run_profile.py [SCENARIO]."""

from collections import defaultdict
from collections.abc import Callable
import sys
import time
from typing import Any

from vcbf_drake import Blimp, BlimpController, SafetyFilter, load_scenario
from vcbf_drake.barriers import BarrierSet
from vcbf_drake.disturbances import DisturbanceObserver
from vcbf_drake.safety import safety_filter
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver
from vcbf_drake.safety.infeasibility_monitor import InfeasibilityMonitor
from vcbf_drake.simulation import run, run_log
from vcbf_drake.simulation.collision_monitor import CollisionMonitor
from vcbf_drake.simulation.run_log import RunLog

PARTS = [
    (run, "_advance", "Drake: integrator, ports, log sinks"),
    (Blimp, "DoCalcTimeDerivatives", "plant"),
    (BlimpController, "_calc_reference", "controller"),
    (DisturbanceObserver, "_calc_posterior", "observer"),
    (DisturbanceObserver, "_update", "observer"),
    (DisturbanceObserver, "_calc_estimate", "observer"),
    (DisturbanceObserver, "_calc_estimate_rate", "observer"),
    (DisturbanceObserver, "_calc_error_bound", "observer"),
    (DisturbanceObserver, "_calc_error_bound_rate", "observer"),
    (CollisionMonitor, "least_barrier", "collision witness"),
    (InfeasibilityMonitor, "_check", "infeasibility monitor"),
    (run_log, "audit_margins", "audit"),
    (RunLog, "take", "log: unpacked, and every h between ticks"),
    (BarrierSet, "rows", "filter: rows"),
    (BarrierSet, "_gradients", "filter: gradient"),
    (SafetyFilter, "_calc_feasible_set", "filter: feasible set"),
    (InscribedEllipsoidSolver, "solve", "filter: ellipsoid"),
    (SafetyFilter, "_calc_volume", "filter: gradient"),
    (SafetyFilter, "_volume_row", "filter: volume row"),
    (safety_filter, "choose_input", "filter: QP"),
    (SafetyFilter, "_calc_decision", "filter: QP"),
    (SafetyFilter, "_calc_packed_feasible_set", "filter: packing for the log"),
]

spent: defaultdict[str, float] = defaultdict(float)
calls: defaultdict[str, int] = defaultdict(int)
inside: list[float] = []


def measured(function: Callable[..., Any], part: str) -> Callable[..., Any]:
    """Adds a function's CPU time, less that of the parts it calls, to its part's."""

    def wrapper(*args: Any, **options: Any) -> Any:
        inside.append(0.0)
        started = time.thread_time()
        try:
            return function(*args, **options)
        finally:
            elapsed = time.thread_time() - started
            spent[part] += elapsed - inside.pop()
            calls[part] += 1
            if inside:
                inside[-1] += elapsed

    return wrapper


def main() -> None:
    """Prints each part's microseconds a control tick and its share."""
    name = sys.argv[1] if len(sys.argv) > 1 else "blimp-multiple-obstacles"
    scenario = load_scenario(name, overrides="{period: 0.01}")
    for owner, attribute, part in PARTS:
        setattr(owner, attribute, measured(getattr(owner, attribute), part))
    run.step_cpu_time = lambda *_: {}  # It would evaluate ticks again.
    run.simulate(scenario)
    spent.clear()
    calls.clear()
    result = run.simulate(scenario)
    ticks, total = len(result.log["time"]), sum(spent.values())
    print("| part | calls a tick | us a tick | share |\n| --- | --- | --- | --- |")
    for part, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        share = f"{100.0 * seconds / total:.0f} %"
        row = f"{calls[part] / ticks:.1f} | {1e6 * seconds / ticks:.0f} | {share}"
        print(f"| {part} | {row} |")
    print(f"\n{1e6 * total / ticks:.0f} us a tick, the measuring included")


if __name__ == "__main__":
    main()
