"""Reading a log: the saved arrays of a run, plotted with NumPy and matplotlib alone.

`result.save(directory)` and `vcbf-drake run --out directory` write summary.json, the
scenario and log.npz: named arrays with one row per control tick. After the first step
the program does not use this package.

    python examples/read_a_log.py               # simulates first
    python examples/read_a_log.py DIRECTORY     # of a car's run that was saved before
"""

import argparse
import json
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np

from vcbf_drake import load_scenario, simulate


def simulated(duration: float) -> Path:
    """Runs the car past its obstacle and returns where the results are."""
    scenario = load_scenario("car-avoidance", {"duration": duration})
    directory = Path("out/examples/car-avoidance")
    simulate(scenario).save(directory)
    return directory


def draw_feasible_set(axes, log, k):
    """Draws the inputs that tick k could choose from, and the one it chose."""
    A, b = log["polytope_A"][k], log["polytope_b"][k]  # {u : A u <= b}
    low, high = -b[2:4], b[:2]  # A box's rows come first: upper limits, then lower.
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 200).T), axis=-1)
    worst = (grid @ A.T - b).max(axis=-1)
    axes.contourf(*np.moveaxis(grid, -1, 0), worst, [-99.0, 0.0], colors="#cfe2f0")
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    ellipse = log["ellipsoid_center"][k, :, None] + log["ellipsoid_shape"][k] @ circle
    axes.plot(*ellipse, color="#0072b2", label="largest ellipse")
    axes.plot(*log["reference"][k], "s", color="#d55e00", label="reference")
    axes.plot(*log["input"][k], "o", color="black", label="input")
    axes.set(xlabel="force [N]", ylabel="turn rate [rad/s]")
    axes.legend(loc="upper right", fontsize="small")


def main() -> None:
    """Plots a log and prints what is in it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path, nargs="?", help="a saved car's run")
    parser.add_argument("--short", action="store_true", help="3 s only, for a check")
    arguments = parser.parse_args()
    directory = arguments.directory or simulated(3.0 if arguments.short else 6.0)

    summary = json.loads((directory / "summary.json").read_text())
    log = np.load(directory / "log.npz")
    print(f"{summary['scenario']}, {summary['method']}: {summary['outcome']}")
    for name in log:
        print(f"  {name:<22}{log[name].shape}")

    time = log["time"]
    changed = log["status"] > 0  # 0: the reference passed through; see FilterStatus.
    tightest = int(log["volume"].argmin())
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    (above, polygon), (force, volume) = figure.subplots(2, 2)
    above.plot(time, log["barriers"], color="#0072b2")
    above.set(ylabel="barrier h [m²]", ylim=(0.0, None))
    force.plot(time, log["reference"][:, 0], color="#d55e00", label="reference")
    force.plot(time, log["input"][:, 0], color="black", label="input")
    force.fill_between(time, -3.3, 3.3, changed, color="#9aa5b4", alpha=0.3, lw=0.0)
    force.set(xlabel="time [s]", ylabel="force [N]", ylim=(-3.3, 3.3))
    force.legend(loc="lower right", fontsize="small")
    volume.plot(time, log["volume"], color="#009e73")
    volume.plot(time[tightest], log["volume"][tightest], "o", color="#009e73")
    volume.set(xlabel="time [s]", ylabel="volume $V_v$", ylim=(0.0, 1.05))
    draw_feasible_set(polygon, log, tightest)
    polygon.set_title(f"the least volume, at {time[tightest]:.2f} s", fontsize="medium")
    path = Path("out/examples/read_a_log.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    print(f"min h: {log['barriers'].min():.3f} m^2")
    print(f"least volume: {log['volume'].min():.3f}")
    print(f"infeasible ticks: {np.sum(log['status'] >= 3)}")


if __name__ == "__main__":
    main()
