"""A solver that answers what a test says, under a name that settings take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

from vcbf_drake.checks import Array
from vcbf_drake.safety.programs import SOLVERS

_numbers = count()


class _Result:
    """What a solver returns, of what the programs ask it."""

    def __init__(self, answer: Array | None) -> None:
        self._answer = answer

    def is_success(self) -> bool:
        return self._answer is not None

    def get_x_val(self) -> Any:
        return self._answer


@contextmanager
def solver_that_answers(answer: Array | None) -> Iterator[str]:
    """Yields the name of a solver of `SOLVERS` that has one answer to everything.

    Args:
        answer: The point that it returns; None for one that gives up.
    """

    class Fake:
        def Solve(self, *asked: Any) -> _Result:
            return _Result(answer)

    name = f"fake {next(_numbers)}"  # Programs are kept by their solver's name.
    table: dict[str, Any] = SOLVERS
    table[name] = Fake
    try:
        yield name
    finally:
        del table[name]
