"""Progress on stderr: bars on a terminal, a line now and then in a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import sys
import time

Advance = Callable[[float], None]

# One line in so many seconds, in a pipe; a short command says nothing.
_PATIENCE = 15.0


@contextmanager
def progress() -> Iterator[Callable[[str], Advance]]:
    """Yields a function that begins a task and returns what to call as it goes on.

    That is called with the fraction that is done. A task begins when the one before it
    is done. It shows the remaining time; bars disappear at the end.
    """
    if not sys.stderr.isatty():
        yield _lines
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:

        def begin(name: str) -> Advance:
            task = bars.add_task(name, total=1.0)
            return lambda done: bars.update(task, completed=done)

        yield begin


def _lines(name: str) -> Advance:
    """Begins a task that prints a line when it goes on, every `_PATIENCE` seconds."""
    started = told = time.monotonic()

    def advance(done: float) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told < _PATIENCE:
            return
        told, spent = now, now - started
        text = f"{name}: for {_duration(spent)}"
        if 0.0 < done < 1.0:
            left = _duration(spent * (1.0 / done - 1.0))
            text += f", {done:.0%}, about {left} left"
        print(text, file=sys.stderr, flush=True)

    return advance


def _duration(seconds: float) -> str:
    minutes = seconds / 60.0
    if minutes < 1.5:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} min" if minutes < 90.0 else f"{minutes / 60.0:.1f} h"
