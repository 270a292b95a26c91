"""Executors of trials: processes that may die, and a running Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import metadata
import multiprocessing
import os
import sys
from threading import Thread
from typing import Any

from vcbf_drake.environment import show_warnings_only

# After so many a process makes room for a new one: pydrake does not free every diagram
# whose systems are written in Python, which is a few megabytes a trial.
TRIALS_A_PROCESS = 100
# A cluster's workers have the versions of these.
_PACKAGES = ("vcbf-drake", "drake", "numpy")


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
    """Returns worker processes that end with this one."""
    # A forked process would share the threads' locks of solvers and of Meshcat.
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _prepare)


def _prepare() -> None:
    show_warnings_only()
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Lets a worker end when the study is killed; a pool's worker waits for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def dask_executor(
    address: str, patience: float = 10.0, start: float = 60.0
) -> Iterator[Executor]:
    """Yields an executor that runs trials on a cluster; the cluster stays as it is.

    Give each worker one thread (``dask worker ADDRESS --nthreads 1``): a trial computes
    in Python, so threads of one process only wait for each other. A worker with other
    versions, which could give other results, is refused; one that comes later refuses
    the trials that it is given.

    Args:
        address: The scheduler's address, like ``tcp://10.0.0.1:8786``.
        patience: The time limit of its answer [s].
        start: The time limit of its first worker [s].

    Raises:
        ModuleNotFoundError: The package distributed is not installed.
        ConnectionError: No scheduler answers there.
        RuntimeError: There is no worker, or one that has other versions.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "a cluster needs the package distributed: pip install 'vcbf-drake[cluster]'"
        ) from None
    try:
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConnectionError(f"no scheduler answers at {address} ({error})") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=start)
        except TimeoutError:
            raise RuntimeError(f"the cluster at {address} has no worker") from None
        for worker, theirs in client.run(versions).items():
            if theirs != versions():
                raise RuntimeError(
                    f"the worker {worker} has {theirs}; here it is {versions()}"
                )
        # Not pure: a trial that is submitted again is to be run again.
        yield _Checked(client.get_executor(pure=False), versions())


class _Checked(Executor):
    """An executor whose workers check their versions before every task."""

    def __init__(self, executor: Executor, versions: str) -> None:
        self._executor, self._versions = executor, versions

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        return self._executor.submit(_run, self._versions, fn, *args, **kwargs)


def _run(expected: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    if versions() != expected:
        raise RuntimeError(f"this worker has {versions()}; the study has {expected}")
    return function(*args, **kwargs)


def versions() -> str:
    """Returns the versions that results rest on."""
    found = ["python {}.{}".format(*sys.version_info)]
    for name in _PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:  # A checkout, or Drake's archive.
            found.append(name)
    return ", ".join(found)
