"""Progress on stderr: bars on a terminal, a line now and then in a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import sys
from threading import Event, Thread
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
    if sys.stderr.isatty():
        with _bars() as begin:
            yield begin
        return
    lines, done = _Lines(), Event()
    teller = Thread(target=lines.tell, args=[done], daemon=True)
    teller.start()
    try:
        yield lines.begin
    finally:
        done.set()
        teller.join()


@contextmanager
def _bars() -> Iterator[Callable[[str], Advance]]:
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


class _Lines:
    """The task at work, told every `_PATIENCE` seconds."""

    def __init__(self) -> None:
        self._name, self._started, self._done = "", time.monotonic(), 0.0

    def begin(self, name: str) -> Advance:
        self._name, self._started, self._done = name, time.monotonic(), 0.0
        return self._advance

    def _advance(self, done: float) -> None:
        self._done = done

    def tell(self, ended: Event) -> None:
        while not ended.wait(_PATIENCE):
            spent = time.monotonic() - self._started
            text = f"{self._name}: for {_duration(spent)}"
            if 0.0 < self._done < 1.0:
                left = _duration(spent * (1.0 / self._done - 1.0))
                text += f", {self._done:.0%}, about {left} left"
            print(text, file=sys.stderr, flush=True)


def _duration(seconds: float) -> str:
    minutes = seconds / 60.0
    if minutes < 1.5:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} min" if minutes < 90.0 else f"{minutes / 60.0:.1f} h"
