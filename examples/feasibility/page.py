"""docs/results/feasibility.md, of the records that there are."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
import json
from pathlib import Path
from statistics import median

from vcbf_drake.studies import Record
from vcbf_drake.studies.statistics import share_interval

from .study import (
    BASE,
    CONTENDERS,
    DURATION,
    POPULATIONS,
    SOON,
    THE_PAPERS,
    Population,
    is_lost,
)

Pair = tuple[int, int]

_HEAD = """\
# Feasibility of every method

Produced by `python -m examples.feasibility`; with `--page docs/results/feasibility.md`
the page is written from the records that exist. [The guide](../guide/feasibility.md)
says which method to choose; the mathematics is in
[theory.md](../theory.md#71-a-wider-set).

**Populations without selection.** *Blimp*: random courses of
`examples/paper/blimp_courses.py`, with 4 to 9 spheres, reverse thrust of a tenth to a
half of forward thrust, and gusts. *Car*: random courses of `car_courses.py`, a gate of
two discs and up to two more discs, each course with the five approach gains 0.2 to 1.0.
*Cruise*: adaptive cruise control (relative degree 1, published constants), random
starts from which full braking keeps the headway, each with the barrier gains 1, 2 and
5. Course numbers begin at 20 000; all settings were chosen on courses below 1000.

**Runs.** First `dob-cbf-qp` runs on every pair of a course and a gain, until it arrives
or for 40 s; then every other method runs on all pairs that it loses and on a random
sample of the others. A run is *lost* if it has an infeasible or failed tick or a
collision before it arrives (with `infeasible: decay` an infeasible tick counts only if
no decay rate helps), and *kept* otherwise. The fourth column counts the lost pairs that
the paper's form keeps. Brackets are Wilson's 95 % intervals. The pairs of one course
are not independent, so for the car the true intervals are wider. Methods that have not
been run on a population are missing there.
"""


def page(directory: Path) -> str:
    """Returns the page.

    Args:
        directory: Where the records are.
    """
    paths = sorted(directory.glob("*.jsonl"))
    records = {
        key(record): record
        for path in paths
        for record in map(json.loads, whole_lines(path))
    }
    path = directory / "ticks.json"
    times = json.loads(path.read_text()) if path.exists() else {}
    files = {path.name for path in paths}
    sections = [
        section(population, records, times.get(population.name, {}), files)
        for population in POPULATIONS
    ]
    return "\n".join([_HEAD, *sections])


def whole_lines(path: Path) -> list[str]:
    """Returns a file's lines but a last one that is being written."""
    return path.read_text(encoding="utf-8").split("\n")[:-1]


def key(identity: Record) -> str:
    """Returns what tells a trial from every other."""
    names = ("scenario", "overrides", "variation", "index", "method")
    return json.dumps([identity[name] for name in names])


def with_shared_runs(
    base: dict[Pair, Record], own: dict[Pair, Record], finished: Sequence[range]
) -> dict[Pair, Record]:
    """Returns the records of who differs from another only where that one is lost.

    The other's kept runs are its own, too, but only where all of the lost ones have
    been run: the rest would be a selection of easy ones.

    Args:
        base: The other's records.
        own: What has been run where these are lost.
        finished: The blocks of courses that have been run.
    """
    missing = {c for (c, v), r in base.items() if is_lost(r) and (c, v) not in own}
    whole = {c for block in finished if missing.isdisjoint(block) for c in block}
    return {p: own.get(p, record) for p, record in base.items() if p[0] in whole}


def section(
    population: Population,
    records: dict[str, Record],
    times: dict[str, float],
    files: Collection[str],
) -> str:
    """Returns what is known of one population.

    Args:
        population: The population.
        records: All records, by `key`.
        times: CPU time of a tick [ms], by method.
        files: The names of the files that there are.
    """
    everything = range(population.first, population.first + population.count)
    pairs = population.pairs(everything)
    contenders = population.contenders()

    def of(name: str, among: Sequence[Pair]) -> dict[Pair, Record]:
        trials = {p: population.trial(contenders[name], *p) for p in among}
        keys = {pair: key(trial.identity) for pair, trial in trials.items()}
        return {p: records[k] for p, k in keys.items() if k in records}

    base = of(BASE, pairs)
    lost = [pair for pair, record in base.items() if is_lost(record)]
    sampled = [p for p in base if p not in set(lost) and population.is_sampled(*p)]
    found = {BASE: base}
    for number, (name, contender) in enumerate(contenders.items()):
        if name == BASE:
            continue
        found[name] = of(name, [*lost, *sampled])
        if contender.acts_on:
            finished = [
                block
                for part, block in enumerate(population.blocks)
                if population.record_file(part, number) in files
            ]
            found[name] = with_shared_runs(
                found[contender.acts_on], found[name], finished
            )
    harmless = len(base) - len(lost)
    lines = [
        f"## {population.name.capitalize()}",
        "",
        f"Of {len(pairs)} pairs ({population.count} courses) {len(base)} are run;"
        f" `{BASE}` loses {share(len(lost), len(base))} of them.",
        "",
        f"### The {len(lost)} pairs that `{BASE}` loses",
        "",
        *table(population, found, lost, times),
        "",
        f"### {len(sampled)} of the {harmless} pairs that it does not lose",
        "",
        *table(population, found, sampled, times),
        "",
    ]
    return "\n".join(lines)


def table(
    population: Population,
    found: dict[str, dict[Pair, Record]],
    pairs: Sequence[Pair],
    times: dict[str, float],
) -> Iterator[str]:
    """Yields the lines of a table, one method a line."""
    paper = found[THE_PAPERS]
    heads = ["method", "runs", "kept", "lost, kept by the paper's form"]
    if population.arrives:
        heads += [f"arrive in {DURATION:g} s", f"in {SOON:g} s", "median arrival"]
    heads += ["collisions", "least h", "CPU of a tick"]
    yield f"| {' | '.join(heads)} |"
    yield "| --- |" + " ---: |" * (len(heads) - 1)
    for name, of in found.items():
        own = {pair: of[pair] for pair in pairs if pair in of}
        count = len(own)
        if not count:
            continue
        lost = {pair for pair, record in own.items() if is_lost(record)}
        cells = [words(name), str(count)]
        cells.append(share(count - len(lost), count))
        cells.append(str(sum(p in paper and not is_lost(paper[p]) for p in lost)))
        if population.arrives:
            kept = [r for pair, r in own.items() if pair not in lost]
            arrivals = [r["reached_at"] for r in kept if r["reached_at"] is not None]
            soon = sum(t <= SOON for t in arrivals)
            cells += [share(len(arrivals), count), share(soon, count)]
            cells.append(f"{median(arrivals):.1f} s" if arrivals else "-")
        heights = [r["min_barrier"] for r in own.values() if r["error"] is None]
        touched = sum(r["collided_at"] is not None for r in own.values())
        cells += [str(touched), f"{min(heights):.3f}" if heights else "-"]
        cells.append(f"{times[name]:.2f} ms" if name in times else "-")
        yield f"| {' | '.join(cells)} |"


def words(name: str) -> str:
    """Returns a contender's name, with its method where that says more."""
    method = f"`{CONTENDERS[name].method}`"
    return method if name == CONTENDERS[name].method else f"{method}, {name}"


def share(count: int, total: int) -> str:
    """Returns a share with Wilson's interval, in words."""
    interval = share_interval(count, total)
    if interval is None:
        return "-"
    low, high = (f"{100.0 * end:.1f}" for end in interval)
    return f"{100.0 * count / total:.1f} % ({low} to {high})"
