"""Which method keeps the QP feasible, on courses that nobody chose?

    python -m examples.feasibility --workers 2

Flies and drives random courses with `dob-cbf-qp`; those that it loses, and a sample of
those that it does not, with every other method. An interrupted study resumes; while it
runs, and after it, ``--page FILE`` writes the page of what there is and runs nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable
import json
from pathlib import Path
from statistics import median

from vcbf_drake import simulate
from vcbf_drake.files import atomic_write
from vcbf_drake.studies import Record, run_study
from vcbf_drake.studies.executors import new_pool

from .page import page
from .study import BASE, CONTENDERS, POPULATIONS, Population, is_lost

# A part has a share of every population that is not at its end, so that a study that
# was stopped is one of the first courses.
PARTS = max(population.parts for population in POPULATIONS)
_TIMED = 3  # courses, for the CPU time of a tick


def main() -> None:
    """Runs what has not been run, or writes the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/feasibility"))
    parser.add_argument("--workers", type=int, default=1, help="how many processes")
    parser.add_argument("--parts", type=int, default=PARTS, help=f"of {PARTS}, so many")
    parser.add_argument(
        "--only",
        choices=[name for name in CONTENDERS if name != BASE],
        nargs="+",
        metavar="NAME",
        help=f"who runs beside {BASE}; the others can follow later",
    )
    parser.add_argument("--page", type=Path, help="write this page, and run nothing")
    options = parser.parse_args()
    if options.page:
        atomic_write(options.page, page(options.out))
        return
    time_ticks(options.out / "ticks.json")
    for part in range(options.parts):
        for population in POPULATIONS:
            if part >= population.parts:
                continue
            run_part(population, part, options.out, options.workers, options.only)
            print(f"part {part + 1} of {PARTS}: {population.name}", flush=True)


def run_part(
    population: Population,
    part: int,
    out: Path,
    workers: int,
    only: Collection[str] | None = None,
) -> None:
    """Runs one part of a population: the base method, then the others.

    Args:
        population: The population.
        part: Which part.
        out: The directory of the records.
        workers: How many processes.
        only: Which others, by name; without it all.
    """
    pairs = population.pairs(population.blocks[part])
    contenders = population.contenders()
    first = [population.trial(contenders[BASE], *pair) for pair in pairs]
    # New processes for every part: pydrake does not free every diagram.
    with new_pool(workers) as pool:
        records = run_study(first, out / f"{population.name}-{part:02}.jsonl", pool)
        chosen = [
            pair
            for pair, record in zip(pairs, records, strict=True)
            if is_lost(record) or population.is_sampled(*pair)
        ]
        found = {BASE: dict(zip(pairs, records, strict=True))}
        for number, (name, contender) in enumerate(contenders.items()):
            if name == BASE or (only and name not in only):
                continue
            acts_on = contender.acts_on
            if acts_on and acts_on not in found:  # What it acts on follows later, too.
                continue
            own = [p for p in chosen if not acts_on or is_lost(found[acts_on][p])]
            trials = [population.trial(contender, *pair) for pair in own]
            path = out / population.record_file(part, number)
            found[name] = dict(zip(own, run_study(trials, path, pool), strict=True))


def time_ticks(path: Path) -> None:
    """Writes the median CPU time of a tick [ms], by population and method.

    Args:
        path: Where to; what it has already is not measured again.
    """
    found = json.loads(path.read_text()) if path.exists() else {}
    for population in POPULATIONS:
        times: Record = found.setdefault(population.name, {})
        courses: Iterable[int] = range(population.first, population.first + _TIMED)
        for name, contender in population.contenders().items():
            if name in times:
                continue
            trials = [population.trial(contender, course, 0) for course in courses]
            spent = [
                simulate(t.load()).summary["step_cpu_ms"]["median"] for t in trials
            ]
            times[name] = median(spent)
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic_write(path, json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
