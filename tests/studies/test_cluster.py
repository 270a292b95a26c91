"""Studies on a Dask cluster: a scheduler and two workers, over real sockets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import json
import os
from pathlib import Path
import signal
import sys
from typing import Any

import pytest
from typer.testing import CliRunner

from vcbf_drake.cli import app
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.studies import Trial, Variation, run_study
from vcbf_drake.studies.executors import dask_executor

BLIMP = "blimp-multiple-obstacles"
SHORT = "{duration: 0.1}"
STARTS = Variation("initial_state.0: !Add [-0.1, 0.1]")
TRIALS = [
    Trial(BLIMP, method, index, variation=STARTS, overrides=SHORT)
    for index in range(5)
    for method in ("dob-cbf-qp", "dob-vcbf-qp")
]


@dataclass(frozen=True)
class Deadly(Variation):
    """Kills the process that draws from it."""

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGKILL)
        return {}


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address=":0",  # Any: tests run side by side.
        silence_logs=50,
        # So that workers find this module, for Deadly.
        env={"PYTHONPATH": os.pathsep.join([os.path.dirname(__file__), *sys.path])},
    ) as cluster:
        cluster.wait_for_workers(2, timeout=60)
        assert cluster.scheduler_address.startswith("tcp://")
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def in_one_process(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("serial") / "trials.jsonl"
    run_study(TRIALS, path)
    return path.read_bytes()


def invoke(*arguments: str) -> Any:
    study = ["monte-carlo", BLIMP, "--trials", "5", "--vary", STARTS.text]
    return CliRunner().invoke(app, [*study, *arguments])


def test_the_command_gets_the_same_results_from_a_cluster(
    address: str, in_one_process: bytes, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shown = invoke("--scheduler", address, "--override", SHORT, "--out", str(out))
    assert shown.exit_code == 0, shown.output
    assert (out / "trials.jsonl").read_bytes() == in_one_process


def test_a_killed_worker_costs_its_trials_time_and_nothing_else(
    address: str, in_one_process: bytes, tmp_path: Path
) -> None:
    from distributed import Client

    path = tmp_path / "trials.jsonl"
    with Client(address, set_as_default=False) as client:
        pids = list(client.run(os.getpid).values())
    killed: list[int] = []

    def kill_one(done: float) -> None:
        if not killed:
            os.kill(pids[0], signal.SIGKILL)
            killed.append(pids[0])

    with dask_executor(address) as executor:
        run_study(TRIALS, path, executor, progress=kill_one)
    assert killed
    assert path.read_bytes() == in_one_process


@pytest.mark.slow
def test_a_trial_that_kills_its_workers_is_recorded_and_no_other(
    address: str, in_one_process: bytes, tmp_path: Path
) -> None:
    deadly = Trial(BLIMP, "cbf-qp", 0, variation=Deadly(label="deadly"))
    path = tmp_path / "trials.jsonl"
    with dask_executor(address) as executor:
        records = run_study([*TRIALS[:3], deadly, *TRIALS[3:]], path, executor)
    assert records[3]["error"].startswith("KilledWorker: ")
    lines = path.read_bytes().splitlines(keepends=True)
    assert b"".join(lines[:3] + lines[4:]) == in_one_process
    assert json.loads(lines[3]) == records[3]


# Bad usage ---------------------------------------------------------------------------


def refusal(out: Path, *arguments: str) -> str:
    shown = invoke("--out", str(out), *arguments)
    assert shown.exit_code == 2
    assert shown.output.count("\n") == 1
    assert not (out / "summary.json").exists()
    return shown.output


def test_workers_of_ones_own_and_a_cluster_exclude_each_other(tmp_path: Path) -> None:
    said = refusal(tmp_path, "--scheduler", "tcp://x:1", "--workers", "2")
    assert "--scheduler and --workers exclude each other" in said


def test_the_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    said = refusal(tmp_path, "--scheduler", "tcp://x:1")
    assert "pip install 'vcbf-drake[cluster]'" in said


@pytest.mark.parametrize("scheduler", ["tcp://127.0.0.1:9", "nonsense://x", ""])
def test_a_scheduler_that_does_not_answer(scheduler: str) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(ConnectionError, match=f"no scheduler answers at {scheduler}"):
        with dask_executor(scheduler, patience=0.2):
            pass


def test_the_command_says_so_in_a_line(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    said = refusal(tmp_path, "--scheduler", "nonsense://x")
    assert "no scheduler answers at nonsense://x" in said


def test_workers_with_other_versions_are_refused(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vcbf_drake.studies.executors._PACKAGES", ("drake",))
    assert "here it is python 3." in refusal(tmp_path, "--scheduler", address)


def test_a_worker_with_other_versions_that_comes_later_refuses_its_trials(
    address: str, tmp_path: Path
) -> None:
    with dask_executor(address) as executor:
        executor._versions = "python 2.7"  # type: ignore[attr-defined]
        records = run_study(TRIALS[:2], tmp_path / "trials.jsonl", executor)
    assert all("the study has python 2.7" in record["error"] for record in records)
