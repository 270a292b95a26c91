"""The property campaign: the filter's promises on random hostile ticks.

Every example is drawn from the study's seed and its own number, so that any one of them
can be made again by itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from examples.paper.archive import code_fingerprint
from tests.properties.decision_check import UNSOLVED, Tick, broken_promises
from tests.properties.hostile_states import PLANTS, random_decision
from tests.properties.hostile_ticks import KINDS, random_input_set, random_tick
from vcbf_drake.barriers import BarrierRows
from vcbf_drake.errors import ScenarioError
from vcbf_drake.safety import DisturbanceKnowledge, FilterDecision, InputSet
from vcbf_drake.safety.decision import choose_input
from vcbf_drake.safety.qp import RowCosts, feasible_set
from vcbf_drake.studies.executors import new_pool

# The kinds of rows, and the states of each plant, take turns.
ALL_KINDS = (*KINDS, *(f"{plant} states" for plant in PLANTS))
BLOCK = 2000
RAISED = "no exception"
_INPUT_SETS = 500
_MOST_SHOWN = 20

Record = dict[str, Any]


class Example(NamedTuple):
    """One example, and what is broken of what the filter promises there."""

    kind: str
    tick: Tick
    decision: FilterDecision
    broken: tuple[str, ...]


def make_example(seed: int, number: int) -> Example:
    """Returns an example of the campaign.

    Args:
        seed: The campaign's.
        number: Which example.
    """
    rng = np.random.default_rng([seed, number])
    kind = ALL_KINDS[number % len(ALL_KINDS)]
    if kind in KINDS:
        input_set = _input_set(seed, int(rng.integers(_INPUT_SETS)))
        tick = random_tick(rng, input_set, kind)
        decision = decide(tick)
    else:
        tick, decision = random_decision(rng, kind.removesuffix(" states"))
    return Example(kind, tick, decision, broken_promises(tick, decision))


@lru_cache(maxsize=_INPUT_SETS)
def _input_set(seed: int, number: int) -> InputSet:
    return random_input_set(np.random.default_rng([seed, number, 1]))


def decide(tick: Tick) -> FilterDecision:
    """Returns what the filter answers to a tick.

    Args:
        tick: What it is given.
    """
    n, m = tick.A.shape
    rows = BarrierRows(
        value=np.ones(n),
        chain=(),
        A=tick.A,
        b=tick.b,
        w=np.zeros((n, 1)),
        num_states=1,
        gradients=lambda rows: np.zeros((len(rows), m + 2, 2)),
    )
    known = DisturbanceKnowledge.constant(1, 0.0)
    costs = replace(RowCosts.equal(n), weights=tick.weights)
    row = tick.volume_row
    if row is not None and tick.exact_slack:
        row = row._replace(slack_penalty=math.inf)
    with np.errstate(over="ignore", invalid="ignore"):
        feasible = feasible_set(tick.input_set, rows, known, costs)
        return choose_input(
            feasible,
            row,
            tick.reference,
            tick.held_input,
            tick.policy,
        )


@dataclass(frozen=True)
class PropertyCounts:
    """What became of some examples.

    Attributes:
        statuses: How many answers had a status, by (kind, status).
        broken: How many broke a promise, by (kind, promise).
        failures: Some of the examples that did: number, kind and promises.
    """

    statuses: Counter[tuple[str, str]]
    broken: Counter[tuple[str, str]]
    failures: list[Record]

    @property
    def examples(self) -> int:
        """How many there were."""
        return self.statuses.total()

    @property
    def unsolved(self) -> int:
        """How many had finite data and no verified answer, which the status said."""
        return sum(n for (_, promise), n in self.broken.items() if promise == UNSOLVED)

    @property
    def failed(self) -> int:
        """How many promises were broken."""
        return self.broken.total() - self.unsolved


def run_properties(
    examples: int,
    path: str | Path,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[float], None] | None = None,
) -> PropertyCounts:
    """Runs the blocks of examples that a file has no record of; counts all.

    Args:
        examples: How many; whole blocks are run.
        path: The file: one line a block. It is made if it is missing.
        seed: Of the examples.
        workers: How many processes; one is this process.
        progress: Called after each block with the fraction that is done.

    Raises:
        ScenarioError: The file holds something else than records of this campaign, or
            those of other code.
    """
    path, mine = Path(path), {"seed": seed, "code": code_fingerprint()}
    path.parent.mkdir(parents=True, exist_ok=True)
    wanted = range(-(-examples // BLOCK))
    records = {record["block"]: record for record in _read(path, mine)}
    missing = [block for block in wanted if block not in records]
    with path.open("a", encoding="utf-8", newline="\n") as file:
        for record in _run(missing, seed, workers):
            file.write(json.dumps(record | mine) + "\n")
            file.flush()
            records[record["block"]] = record
            if progress is not None:
                progress(len(records) / len(wanted))
    return _total(records[block] for block in wanted)


def _run(blocks: list[int], seed: int, workers: int) -> Iterator[Record]:
    if workers == 1 or len(blocks) == 1:
        yield from map(partial(run_block, seed), blocks)
        return
    with new_pool(workers) as pool:
        yield from pool.map(partial(run_block, seed), blocks)


def run_block(seed: int, block: int) -> Record:
    """Returns the counts of one block of examples.

    Args:
        seed: The campaign's.
        block: Which block.
    """
    statuses: Counter[tuple[str, str]] = Counter()
    broken: Counter[tuple[str, str]] = Counter()
    failures: list[Record] = []
    for number in range(block * BLOCK, (block + 1) * BLOCK):
        kind = ALL_KINDS[number % len(ALL_KINDS)]
        try:
            example = make_example(seed, number)
            status, promises = example.decision.status.name, example.broken
        except Exception as error:  # What the filter must never do.
            status, promises = type(error).__name__, (RAISED,)
        statuses[kind, status] += 1
        broken.update((kind, promise) for promise in promises)
        if promises and promises != (UNSOLVED,) and len(failures) < _MOST_SHOWN:
            failures.append({"number": number, "kind": kind, "broken": promises})
    return {
        "block": block,
        "statuses": [[*key, count] for key, count in sorted(statuses.items())],
        "broken": [[*key, count] for key, count in sorted(broken.items())],
        "failures": failures,
    }


def _total(records: Iterable[Record]) -> PropertyCounts:
    total = PropertyCounts(Counter(), Counter(), [])
    for record in records:
        for counter, name in ((total.statuses, "statuses"), (total.broken, "broken")):
            for kind, what, count in record[name]:
                counter[kind, what] += count
        total.failures.extend(record["failures"])
    return total


def _read(path: Path, mine: Record) -> Iterator[Record]:
    content = path.read_bytes() if path.exists() else b""
    lines = content.split(b"\n")
    if lines[-1]:  # It was cut short.
        path.write_bytes(content[: -len(lines[-1])])
    for number, line in enumerate(lines[:-1], start=1):
        try:
            record = json.loads(line)
            found = {key: record.get(key) for key in mine}
            record["block"] = int(record["block"])
        except (AttributeError, ValueError, KeyError, TypeError):
            raise ScenarioError(f"{path}:{number}: not a block of examples") from None
        if found != mine:
            raise ScenarioError(
                f"{path}:{number}: a block of {found}, not {mine}; use another file"
            )
        yield record
