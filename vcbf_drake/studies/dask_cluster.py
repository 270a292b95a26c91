"""A running Dask cluster as the executor of a study."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
import sys
from typing import Any

from vcbf_drake.environment import installed_version

_PACKAGES = ("vcbf-drake", "drake", "numpy")
_PATIENCE = 10.0  # The time limit of a scheduler's answer [s].
_START = 60.0  # The time limit of a cluster's first worker [s].


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yields an executor that runs trials on a cluster; the cluster stays as it is.

    Give each worker one thread (``dask worker ADDRESS --nthreads 1``): a trial computes
    in Python, so threads of one process only wait for each other. A worker with other
    versions, which could give other results, is refused; one that comes later refuses
    the trials that it is given.

    Args:
        address: The scheduler's address, like ``tcp://10.0.0.1:8786``.

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
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConnectionError(f"no scheduler answers at {address} ({error})") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_START)
        except TimeoutError:
            raise RuntimeError(f"the cluster at {address} has no worker") from None
        for worker, versions in client.run(_versions).items():
            if versions != _versions():
                raise RuntimeError(
                    f"the worker {worker} has {versions}; here it is {_versions()}"
                )
        # Not pure: a trial that is submitted again is to be run again.
        yield _Checked(client.get_executor(pure=False), _versions())


class _Checked(Executor):
    """An executor whose workers check their versions before every task."""

    def __init__(self, executor: Executor, versions: str) -> None:
        self._executor, self._versions = executor, versions

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        return self._executor.submit(_run, self._versions, fn, *args, **kwargs)


def _run(expected: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    if _versions() != expected:
        raise RuntimeError(f"this worker has {_versions()}; the study has {expected}")
    return function(*args, **kwargs)


def _versions() -> str:
    python = "python {}.{}".format(*sys.version_info)
    packages = (f"{name} {installed_version(name)}".strip() for name in _PACKAGES)
    return ", ".join([python, *packages])
