"""A blimp among obstacles over a slow link, with and without prediction.

Both halves run in one process on a simulated clock, and every message is delayed, in
both directions, by the given time plus or minus 10 ms. With ``predict`` the filter acts
on the predicted state at which its command will arrive.

    python examples/slow_link.py
"""

import argparse

import numpy as np

from vcbf_drake import load_scenario
from vcbf_drake.hil import InProcess, LinkFaults

SCENARIO = "blimp-multiple-obstacles"
DELAYS = [0.03, 0.08]  # Each way, in seconds.
JITTER = 0.01  # In seconds.


def fly(delay: float, predict: bool, duration: float, seed: int) -> InProcess:
    """Flies once over the link."""
    hardware = {"predict": predict, "max_state_age": 0.2, "command_timeout": 0.2}
    scenario = load_scenario(SCENARIO, {"hardware": hardware})
    if not delay:
        run = InProcess(scenario)
    else:
        commands, states = (
            LinkFaults(delay=delay, jitter=JITTER, seed=s) for s in (seed, seed + 100)
        )
        run = InProcess(scenario, commands, states, grid=10)
    run.advance_to(duration)
    return run


def path(run: InProcess) -> np.ndarray:
    """Where the blimp was, at every integrator step."""
    log = run.plant.diagram.GetSubsystemByName("log_path").FindLog(run.plant.context)
    return log.data().T[:, :3]


def show(label: str, run: InProcess, ideal: np.ndarray) -> None:
    """Prints what a flight came to, and how far it was from the one without delay."""
    vehicle, controller = run.plant.report(), run.controller.report()
    away = max(np.linalg.norm(ideal - p, axis=1).min() for p in path(run))
    print(
        f"{label:26} {vehicle['outcome']:9} min h {vehicle['min_barrier']:.3f},"
        f" min V_v {controller['min_volume']:.3f},"
        f" infeasible ticks {controller['infeasible_ticks']},"
        f" {1e3 * away:.0f} mm from the path without delay"
    )


def main() -> None:
    """Flies without delay, then over each link without and with prediction."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="2 s only, for a check")
    parser.add_argument("--seed", type=int, default=1, help="of the delays")
    arguments = parser.parse_args()
    duration = 2.0 if arguments.short else 18.0
    base = fly(0.0, False, duration, 0)
    ideal = path(base)
    show("no delay", base, ideal)
    for delay in DELAYS[:1] if arguments.short else DELAYS:
        for predict in (False, True):
            label = f"{1e3 * delay:.0f} ms each way" + ", predicted" * predict
            show(label, fly(delay, predict, duration, arguments.seed), ideal)


if __name__ == "__main__":
    main()
