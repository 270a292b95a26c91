"""Worker processes as an executor that goes on when one of them dies."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
import os
from threading import Thread
from typing import Any

from vcbf_drake.environment import show_warnings_only

# After so many a process makes room for a new one: pydrake does not free every diagram
# whose systems are written in Python, which is a few megabytes a trial.
TRIALS_A_PROCESS = 100


class WorkerProcesses(Executor):
    """Processes that make room for new ones after `TRIALS_A_PROCESS` tasks each.

    When one dies, all tasks under way fail with it, and nothing says which of them it
    was; those that are submitted afterwards have new processes.
    """

    def __init__(self, workers: int) -> None:
        """Starts the first ones.

        Args:
            workers: The number of simultaneous workers.
        """
        self._workers = workers
        self._renew()

    def _renew(self) -> None:
        self._pool = new_pool(self._workers)
        self._left = TRIALS_A_PROCESS * self._workers

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Hands a task to a process; see `concurrent.futures.Executor`."""
        if not self._left:
            self._pool.shutdown(wait=False)
            self._renew()
        self._left -= 1
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenProcessPool:
            self._renew()
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the processes; see `concurrent.futures.Executor`."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


def new_pool(workers: int) -> ProcessPoolExecutor:
    """Returns worker processes that end with this one.

    Args:
        workers: The number of workers.
    """
    # A forked process would share the threads' locks of solvers and of Meshcat.
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _prepare)


def _prepare() -> None:
    show_warnings_only()
    _end_with_parent()


def _end_with_parent() -> None:
    """Lets a worker end when the study is killed; a pool's worker waits for ever."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()
