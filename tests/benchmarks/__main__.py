"""The benchmarks: `python -m tests.benchmarks`, or `make bench`.

Prints the tables of docs/results/performance.md. CPU time of one thread throughout;
nothing is asserted, for it depends on the machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import os
from pathlib import Path
import resource
import subprocess
import sys
import tempfile
import time

from tests.benchmarks.problem import instances
from tests.benchmarks.routes import CBF_QP, GRADIENT, TASKS, Cost, markdown, measure
from tests.benchmarks.ticks import (
    GROWTH,
    agents_time,
    growth_markdown,
    solvers_alone,
    tick_times,
)
from vcbf_drake import load_scenario, simulate

_ARM = Path(__file__).parents[2] / "examples" / "arm.yaml"


def main() -> None:
    """Prints the tables, each as soon as it is measured."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks",
        description="Prints CPU times as Markdown; about ten minutes.",
    )
    parser.add_argument("--quick", action="store_true", help="rough numbers, a minute")
    quick = parser.parse_args().quick
    chosen = instances(20 if quick else 200)
    print("# Where the time goes\n\nMade by `make bench`. CPU time of one thread.\n")
    print(f"## Comparison with other packages, on {len(chosen)} ticks\n")
    costs = {}
    for task in TASKS:
        costs[task.title] = list(measure(task, chosen))
        _print(markdown(task, costs[task.title]))
    print("## One tick and how it grows, first deciles in microseconds\n")
    for title in ("method",) if quick else GROWTH:
        _print(growth_markdown(title, 20 if quick else 200))
    print("## The numbers to keep\n")
    print("| number | limit | version 0.1 | measured |")
    print("| --- | ---: | ---: | ---: |")
    for numbers in _kept(costs, quick):
        print(f"| {' | '.join(numbers)} |", flush=True)


def _print(lines: Iterator[str]) -> None:
    print(*lines, "", sep="\n", flush=True)


def _kept(
    costs: dict[str, list[Cost | str]], quick: bool
) -> Iterator[tuple[str, str, str, str]]:
    """Yields the project's own limits: what, the limit, formerly, measured."""
    ticks = 20 if quick else 200
    for method, before in (("cbf-qp", "150 us"), ("dob-vcbf-qp", "716 us")):
        least = tick_times(method=method, ticks=ticks)["tick"][0]
        yield f"{method} tick, two rows cut", "", before, f"{least:.0f} us"
    plain = _ratio(costs[CBF_QP.title], "cbfpy")
    yield "plain CBF-QP tick / cbfpy's", "at most 1", "0.92", plain
    gradient = _ratio(costs[GRADIENT.title], "cvxpylayers, SCS")
    name = "ellipsoid and gradient / cvxpylayers'"
    yield name, "at most 0.0125", "0.0067", gradient
    tick, alone = tick_times(ticks=ticks)["tick"][0], solvers_alone(ticks)
    name = "DOB-VCBF tick / its two solver calls alone"
    yield name, "at most 1.5", "1.8", f"{tick / alone:.3g}"
    free = tick_times(num_cutting=0, ticks=ticks)["tick"][0]
    yield "tick without a cutting row", "100 us", "109 us", f"{free:.0f} us"
    many = tick_times(num_obstacles=200, ticks=ticks)["tick"][0]
    yield "tick among 200 obstacles, two cut", "2000 us", "1324 us", f"{many:.0f} us"
    for pairs, before in ((12, "8.8 ms"), (28, "15.7 ms")):
        least = agents_time(16, pairs, 5 if quick else 40) / 1e3
        yield (
            f"ellipsoid of 16 inputs, {pairs} pairs",
            "10 ms",
            before,
            f"{least:.1f} ms",
        )
    yield "dob-vcbf-qp tick of an arm with 7 joints", "5 ms", "", _arm_tick()
    speed = _speed(4.0 if quick else 20.0)
    name = "Test 2 at 100 Hz, log and audit, times real time"
    yield name, "at least 20", "15.6", speed
    yield "import vcbf_drake", "0.5 s", "", _cpu("-c", "import vcbf_drake")
    every = _cpu("-c", "from vcbf_drake import *")
    yield "the same with every public name, Drake's too", "", "", every
    yield "vcbf-drake --help", "0.4 s", "0.3 s", _cpu("-m", "vcbf_drake", "--help")
    if not quick:
        name = "memory of 60 s among 1000 discs"
        yield name, "1024 MiB", "more than 8192 MiB", _memory_among_discs()


def _ratio(costs: list[Cost | str], peer: str) -> str:
    medians = {cost.name: cost.median for cost in costs if isinstance(cost, Cost)}
    if peer not in medians:
        return f"{peer} is not installed"
    return f"{medians['vcbf_drake'] / medians[peer]:.3g}"


def _speed(duration: float) -> str:
    settings = {"period": 0.01, "duration": duration}
    scenario = load_scenario("blimp-multiple-obstacles", settings)
    simulate(scenario, step_time=False)  # Compiles.
    spent = []
    for _ in range(3):
        started = time.process_time()
        summary = simulate(scenario, step_time=False).summary
        spent.append(time.process_time() - started)
    return f"{summary['running_time'] / min(spent):.1f}"


def _arm_tick() -> str:
    settings = {"method": "dob-vcbf-qp", "duration": 2.0}
    summaries = [simulate(load_scenario(_ARM, settings)).summary for _ in range(3)]
    return f"{min(each['step_cpu_ms']['median'] for each in summaries):.1f} ms"


def _cpu(*arguments: str) -> str:
    """CPU time of a new Python, the least of three."""
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent.append(
            after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        )
    return f"{min(spent):.2f} s"


def _memory_among_discs(duration: float = 60.0) -> str:
    """The most memory that `vcbf-drake run` takes, with log, figures and replay."""
    places = [(4.0 + 3.0 * (i % 32), 3.0 * (i // 32)) for i in range(1000)]
    discs = ", ".join(f"{{center: [{x}, {y}], radius: 0.3}}" for x, y in places)
    crowd = f"{{duration: {duration}, target: [100.0, 93.0], obstacles: [{discs}]}}"
    command = [sys.executable, "-m", "vcbf_drake", "run", "car-avoidance"]
    with tempfile.TemporaryDirectory() as directory:
        command += ["--override", crowd, "--out", directory]
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        # Of this process alone: a peer's may have taken more.
        _, status, usage = os.wait4(running.pid, 0)
    peak = usage.ru_maxrss / 1024.0
    return f"{peak:.0f} MiB" + (" (it failed)" if status else "")


if __name__ == "__main__":
    main()
