"""Trials in worker processes; a process that dies costs the trial that killed it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
import os
from threading import Thread

from vcbf_drake.environment import show_warnings_only
from vcbf_drake.studies.trial import Record, Trial, error_record, run_trial

# After so many a process makes room for a new one: pydrake does not free every diagram
# whose systems are written in Python, which is a few megabytes a trial.
TRIALS_A_PROCESS = 100


def run_in_processes(trials: Iterable[Trial], workers: int) -> Iterator[Record]:
    """Yields the records of trials as they finish.

    When a process dies, all of its pool fails and nothing says which trial it was. So
    no more trials are handed out than there are workers, and those that were under way
    are run again, each alone; the one that kills its process again is recorded so.

    Args:
        trials: The trials.
        workers: How many processes.
    """
    waiting = deque(trials)
    while waiting:
        running: dict[Future[Record], Trial] = {}
        try:
            with new_pool(workers) as pool:
                left = TRIALS_A_PROCESS * workers
                while running or (waiting and left):
                    while waiting and left and len(running) < workers:
                        running[pool.submit(run_trial, waiting[0])] = waiting[0]
                        waiting.popleft()
                        left -= 1
                    finished, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in finished:
                        record = future.result()
                        del running[future]
                        yield record
        except BrokenProcessPool:
            for trial in running.values():
                yield _run_alone(trial)


def _run_alone(trial: Trial) -> Record:
    with new_pool(1) as pool:
        try:
            return pool.submit(run_trial, trial).result()
        except BrokenProcessPool:
            return error_record(trial, "its process died, twice")


def new_pool(workers: int) -> ProcessPoolExecutor:
    """Returns worker processes that end with this one.

    Args:
        workers: How many.
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
