"""What a proposal of each of Drake's solvers costs, and how often it is enough.

`python -m tests.benchmarks.solvers` prints the table "Solvers of the QP" of
docs/results/performance.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import time
from typing import Any
from unittest.mock import patch

import numpy as np

from tests.properties.campaign import make_example
from vcbf_drake import load_scenario, simulate
from vcbf_drake.checks import Array
from vcbf_drake.safety import decision
from vcbf_drake.safety.programs import SOLVERS, NearestPointProgram, check_solver
from vcbf_drake.safety.projection import (
    REACH,
    UnitRows,
    is_optimal,
    nearest_by_active_set,
    nearest_point,
)

_HOSTILE_TICKS = 4000
Asked = tuple[UnitRows, Array]


def main() -> None:
    """Prints the table."""
    test_2 = asked_of_qp(lambda: simulate(load_scenario("blimp-multiple-obstacles")))
    hostile = asked_of_qp(
        lambda: [make_example(0, number) for number in range(_HOSTILE_TICKS)]
    )
    print(f"{len(test_2)} QPs of Test 2, {len(hostile)} feasible ones of hostile ticks")
    print("\n| solver | Test 2 [us] | verified | hostile [us] | verified |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for solver in usable_solvers():
        cells = (
            f"{us:.0f} | {count}" for us, count in measured(solver, test_2, hostile)
        )
        print(f"| {solver} | {' | '.join(cells)} |", flush=True)


def usable_solvers() -> Iterator[str]:
    """Yields the names of the solvers that this machine has."""
    for name in SOLVERS:
        try:
            check_solver(name)
        except ValueError:
            continue
        yield name


def asked_of_qp(run: Callable[[], object]) -> list[Asked]:
    """Returns rows and reference of the QPs of a run.

    Args:
        run: What solves them; those without a solution do not count.
    """
    asked = []

    def remember(A: Array, b: Array, reference: Array, *others: Any) -> Array:
        found = nearest_point(A, b, reference, *others)
        asked.append((UnitRows(A, b), reference))
        return found

    with patch.object(decision, "nearest_point", remember):
        run()
    return asked


def measured(solver: str, *kinds: list[Asked]) -> Iterator[tuple[float, int]]:
    """Yields the first decile of a proposal's CPU time [us], and how many lead on.

    That is to a verified answer on the rows that they touch, before all are tried.

    Args:
        solver: One of `SOLVERS`.
        kinds: QPs.
    """
    for asked in kinds:
        spent, count = [], 0
        for rows, reference in asked:
            program = NearestPointProgram.of_size(*rows.A.shape, solver)
            started = time.thread_time()
            proposal = program.solve(rows.A, rows.b, reference)
            spent.append(time.thread_time() - started)
            if proposal is not None:
                near = np.flatnonzero(rows.b - rows.A @ proposal < REACH).tolist()
                found = nearest_by_active_set(rows.A, rows.b, reference, near)
                count += is_optimal(found, rows, reference)
        yield 1e6 * float(np.percentile(spent, 10.0)), count


if __name__ == "__main__":
    main()
