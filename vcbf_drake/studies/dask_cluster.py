"""A running Dask cluster as the executor of a study."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
import sys

from vcbf_drake.environment import installed_version

_PACKAGES = ("vcbf-drake", "drake", "numpy")
_PATIENCE = 10.0  # How long a scheduler may take to answer [s].


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yields an executor that runs trials on a cluster; the cluster stays as it is.

    Give each worker one thread (``dask worker ADDRESS --nthreads 1``): a trial computes
    in Python, so threads of one process only wait for each other.

    Args:
        address: The scheduler's address, like ``tcp://10.0.0.1:8786``.

    Raises:
        ModuleNotFoundError: The package distributed is not installed.
        ConnectionError: No scheduler answers there.
        RuntimeError: A worker has other versions, so it could give other results.
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
        for worker, versions in client.run(_versions).items():
            if versions != _versions():
                raise RuntimeError(
                    f"the worker {worker} has {versions}; here it is {_versions()}"
                )
        # Not pure: a trial that is submitted again is to be run again.
        yield client.get_executor(pure=False)


def _versions() -> str:
    python = "python {}.{}".format(*sys.version_info)
    packages = (f"{name} {installed_version(name)}".strip() for name in _PACKAGES)
    return ", ".join([python, *packages])
