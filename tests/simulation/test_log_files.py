"""Logs that grow on disk: whole at any time, and what the memory would hold."""

import json
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
from numpy.testing import assert_array_equal
import pytest

from vcbf_drake import load_scenario, simulate
from vcbf_drake.simulation import load_result, read_log_files
from vcbf_drake.simulation.result import LogFiles

CAR = load_scenario("car-avoidance", overrides="{duration: 5.5}")
LONG = load_scenario("car-avoidance", overrides="{duration: 30.0}")
LONG_RUN = """
import sys
from vcbf_drake import load_scenario, simulate
scenario = load_scenario("car-avoidance", overrides="{duration: 30.0}")
simulate(scenario, log_directory=sys.argv[1])
"""


def pieces(rng):
    for length in (3, 1, 4000, 2):
        yield {
            "x": rng.normal(size=(length, 2, 3)),
            "t": rng.normal(size=length),
            "s": rng.integers(0, 5, length),
        }


def test_a_file_is_an_array_after_every_piece(tmp_path):
    files, so_far = LogFiles(tmp_path), []
    for piece in pieces(np.random.default_rng(0)):
        files.append(piece)
        so_far.append(piece)
        for name in piece:
            whole = np.concatenate([each[name] for each in so_far])
            found = np.load(tmp_path / f"{name}.npy")
            assert found.dtype == whole.dtype
            assert_array_equal(found, whole)
            assert_array_equal(files.arrays()[name], whole)


def test_a_piece_that_was_not_finished_does_not_count(tmp_path):
    files = LogFiles(tmp_path)
    files.append({"a": np.zeros((4, 2)), "b": np.zeros(4)})
    files.append({"a": np.ones((3, 2))})  # The end came before b.
    with (tmp_path / "b.npy").open("ab") as file:
        file.write(b"half a number"[:5])
    found = read_log_files(tmp_path)
    assert {name: len(array) for name, array in found.items()} == {"a": 4, "b": 4}
    assert not found["a"].any()


def test_an_order_of_another_language_is_written_in_c(tmp_path):
    files, values = LogFiles(tmp_path), np.asfortranarray(np.arange(12.0).reshape(4, 3))
    files.append({"a": values})
    files.append({"a": values})
    assert_array_equal(files.arrays()["a"], np.concatenate([values, values]))


def test_an_earlier_log_goes_away(tmp_path):
    LogFiles(tmp_path).append({"old": np.zeros(2)})
    files = LogFiles(tmp_path)
    files.append({"new": np.ones(1)})
    assert list(files.arrays()) == ["new"]


def test_a_directory_without_a_log_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="no arrays"):
        read_log_files(tmp_path)


def test_a_run_is_the_same_wherever_its_log_goes(tmp_path):
    """A run of several pieces."""
    in_memory = simulate(CAR, step_time=False)
    on_disk = simulate(CAR, step_time=False, log_directory=tmp_path / "log")
    assert in_memory.log.keys() == on_disk.log.keys()
    for name, array in in_memory.log.items():
        assert isinstance(on_disk.log[name], np.memmap)
        assert_array_equal(on_disk.log[name], array)
    for result in (in_memory, on_disk):
        del result.summary["real_time_factor"]
    np.testing.assert_equal(on_disk.summary, in_memory.summary)
    on_disk.save(tmp_path / "result")
    assert_array_equal(
        load_result(tmp_path / "result").log["state"], in_memory.log["state"]
    )


def test_a_killed_run_leaves_its_log(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", LONG_RUN, str(tmp_path)], env=os.environ
    )
    try:
        wait_for(tmp_path / "time.npy", process)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    found = read_log_files(tmp_path)
    ticks = len(found["time"])
    assert ticks > 50  # Half a second and more.
    for name, array in simulate(LONG, step_time=False).log.items():
        assert_array_equal(found[name], array[:ticks])
    assert len(read_log_files(tmp_path / "path")["least_height"])


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    """Until an array has a second's ticks."""
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline:
        assert process.poll() is None
        if path.exists() and path.stat().st_size > 128 + 8 * 60:
            return
        time.sleep(0.05)
    raise TimeoutError(path)


def test_a_summary_of_what_has_no_number_is_json(tmp_path):
    """Infinite limits have no largest ellipsoid: V_v(0) is null, and loads."""
    limits = {"lower": [-math.inf] * 2, "upper": [math.inf] * 2}
    chosen = {"duration": 0.1, "method": "dob-cbf-qp", "input_set": limits}
    simulate(load_scenario("car-avoidance", chosen)).save(tmp_path)
    text = (tmp_path / "summary.json").read_text()

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    json.loads(text, parse_constant=refuse)
    assert '"V_v(0)": null' in text
    assert load_result(tmp_path).summary["guaranteed"] is True
