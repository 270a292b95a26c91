"""A cluster without workers: alone in its module, for another would be beside it."""

import pytest

from vcbf_drake.studies.executors import dask_executor


def test_a_cluster_without_a_worker_is_refused() -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 0, "dashboard_address": ":0", "silence_logs": 50}
    with distributed.LocalCluster(**options) as empty:
        address = empty.scheduler_address
        with pytest.raises(RuntimeError, match="has no worker"):
            with dask_executor(address, start=0.2):
                pass
