"""Who needs the cone program: python tests/benchmarks/ellipsoid_ways.py."""

import time

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError
from vcbf_drake.safety import InputSet, ellipsoid_solver
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver

SETS = 500
asked: list[int] = []
_by_cone_program = ellipsoid_solver._by_cone_program


def _counted(A: Array, b: Array) -> object:
    asked.append(len(b))
    return _by_cone_program(A, b)


def random_rows(
    m: int, count: int, facing: bool, generator: np.random.Generator
) -> tuple[Array, Array]:
    """Returns unit rows around the centre, each cutting the unit ball.

    Args:
        m: How many inputs.
        count: How many rows.
        facing: Whether the second faces the first and leaves a slab, 1e-4 to 0.3 wide.
        generator: Where they come from.
    """
    A = generator.normal(size=(count, m))
    A /= np.linalg.norm(A, axis=1)[:, None]
    b = generator.uniform(0.0, 0.95, count)
    if facing:
        A[1], b[1] = -A[0], 10.0 ** generator.uniform(-4.0, -0.5) - b[0]
    return A, b


def measured(m: int, count: int, facing: bool) -> str:
    """Returns the share of sets that need the cone program, and the median CPU time."""
    solver = InscribedEllipsoidSolver(InputSet.box(-np.ones(m), np.ones(m)))
    generator = np.random.default_rng(0)
    spent, num_asked = [], 0
    while len(spent) < SETS:
        A, b = random_rows(m, count, facing, generator)
        asked.clear()
        started = time.thread_time()
        try:
            solver.solve(A, b)
        except EmptySetError:
            continue
        spent.append(1e6 * (time.thread_time() - started))
        num_asked += len(asked)
    return f"{100.0 * num_asked / SETS:.1f} % | {np.median(spent):.0f}"


def main() -> None:
    """Prints a table of random rows, and of rows of which two face each other."""
    ellipsoid_solver._by_cone_program = _counted
    print("| inputs | cutting | cone program | us | facing: cone program | us |")
    print("| --- " * 6 + "|")
    for m in (2, 3, 4, 6):
        for count in (2, 4, 8):
            cells = " | ".join(measured(m, count, facing) for facing in (False, True))
            print(f"| {m} | {count} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
