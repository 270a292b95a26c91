"""The paper's experiments: `python -m examples.paper`, or `make reproduce`.

Runs what the directory lacks and writes one report: verdicts, tables, figures, replays.
"""

from __future__ import annotations

import argparse
from collections import Counter
import os
from pathlib import Path
import sys
from typing import Any

from vcbf_drake.cli.progress import progress
from vcbf_drake.errors import ScenarioError

from . import (
    blimp_courses,
    car_courses,
    car_experiments,
    chattering_observer,
    corrections,
    knobs,
    many_obstacles,
    one_obstacle,
    table_1,
)
from .archive import reproduce
from .experiment import FULL, QUICK, Experiment
from .report import write_report

# In the order of the report.
EXPERIMENTS: dict[str, Experiment] = {
    each.key: each
    for each in (
        one_obstacle.EXPERIMENT,
        many_obstacles.EXPERIMENT,
        chattering_observer.EXPERIMENT,
        table_1.EXPERIMENT,
        blimp_courses.EXPERIMENT,
        car_experiments.AVOIDANCE_EXPERIMENT,
        car_experiments.GAINS_EXPERIMENT,
        car_courses.EXPERIMENT,
        corrections.EXPERIMENT,
        knobs.EXPERIMENT,
    )
}


def main(arguments: list[str] | None = None) -> int:
    """Runs the experiments and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.paper",
        description="Repeats the paper's experiments. An interrupted command goes on.",
    )
    parser.add_argument(
        "--quick", action="store_true", help="few trials: a check, in some minutes"
    )
    parser.add_argument(
        "--only", metavar="E,E", help=f"of {', '.join(EXPERIMENTS)}; all by default"
    )
    parser.add_argument("--out", type=Path, metavar="DIR")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args(arguments)
    names = options.only.split(",") if options.only else list(EXPERIMENTS)
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        parser.error(f"no experiment {unknown[0]!r}; allowed: {', '.join(EXPERIMENTS)}")
    name = "reproduction-quick" if options.quick else "reproduction"
    directory = options.out or Path("out") / name
    chosen = [each for each in EXPERIMENTS.values() if each.key in names]
    settings = QUICK if options.quick else FULL
    try:
        data = _run(directory, chosen, settings, options.workers)
    except ScenarioError as error:
        parser.error(str(error))
    path = write_report(directory, list(EXPERIMENTS.values()))
    for verdict in data["verdicts"]:
        print(f"{verdict['where']}: {verdict['claim']}")
        print(f"    {verdict['found']}: {verdict['number']}")
    found = Counter(verdict["found"] for verdict in data["verdicts"])
    print(", ".join(f"{count} {verdict}" for verdict, count in found.most_common()))
    print(f"written to {path}")
    return 0


def _run(directory: Path, chosen: list[Experiment], *options: Any) -> dict[str, Any]:
    cost = sum(each.plan(options[0]).cost for each in chosen)
    with progress() as begin:
        advance = begin(f"{cost} runs")
        return reproduce(directory, chosen, *options, lambda _, done: advance(done))


if __name__ == "__main__":
    sys.exit(main())
