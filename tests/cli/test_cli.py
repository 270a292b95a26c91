from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
import json
import logging
import math
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from vcbf_drake.cli import app
from vcbf_drake.cli.options import METHODS as METHOD_NAMES
from vcbf_drake.safety.assumptions import Assumption
from vcbf_drake.safety.settings import METHODS
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.loading import load_scenario, shipped_scenarios
from vcbf_drake.simulation.result import LogFiles
import vcbf_drake.simulation.run as run_module
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.schema import scenario_schema
import vcbf_drake.viz.figures as figures_module
import vcbf_drake.viz.replay as replay_module
from vcbf_drake.viz.terminal import number_text

SHORT = "{duration: 0.1}"


def invoke(*arguments: str) -> Any:
    return CliRunner().invoke(app, arguments)


def process(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vcbf_drake", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )


def summary(scenario: Scenario) -> dict[str, Any]:
    infeasible = scenario.method == "dob-cbf-qp"
    return {
        "scenario": scenario.name,
        "method": scenario.method,
        "fidelity": scenario.fidelity,
        "outcome": "infeasible" if infeasible else "reached",
        "running_time": 7.6 if infeasible else 20.0,
        "reached_at": None if infeasible else 19.01,
        "infeasible_at": 7.6 if infeasible else None,
        "collided_at": None,
        "conflict": ["input limit 1", "obstacle 5"] if infeasible else None,
        "min_barrier": -1.23456e-10,
        "min_volume": -0.0123456,
        "max_abs_slack": 1.23456e-5,
        "slack_active_fraction": 0.0,
        "failed_ticks": 0,
        "final_distance": 0.112,
        "assumptions": [{"name": "known start", "holds": not infeasible}],
        "step_cpu_ms": {"median": 0.4, "p99": 1.3},
        "real_time_factor": 123.4,
    }


class StandInResult:
    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.summary = scenario, summary(scenario)

    def save(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "summary.json").write_text(json.dumps(self.summary))


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> list[Scenario]:
    """Replaces the simulation and the pictures; collects the scenarios run."""
    simulated: list[Scenario] = []

    def simulate_fleet(
        fleet: Fleet, progress: Callable[[float], None], log_directory: Path | None
    ) -> list[StandInResult]:
        (scenario,) = fleet.vehicles
        simulated.append(scenario)
        progress(0.5)
        if log_directory is not None:
            LogFiles(log_directory).append({"time": np.zeros(1)})
        return [StandInResult(scenario)]

    def write_figures(results: Sequence[Any], directory: Path) -> list[Path]:
        path = directory / "paths.svg"
        path.write_text(" ".join(result.scenario.method for result in results))
        return [path]

    def write_replay(results: Sequence[Any], path: Path) -> Path:
        path.write_text(" ".join(result.scenario.method for result in results))
        return path

    monkeypatch.setattr(run_module, "simulate_fleet", simulate_fleet)
    monkeypatch.setattr(figures_module, "write_figures", write_figures)
    monkeypatch.setattr(replay_module, "write_replay", write_replay)
    return simulated


def files(directory: Path) -> set[str]:
    return {
        str(path.relative_to(directory))
        for path in directory.rglob("*")
        if path.is_file()
    }


# Help ------------------------------------------------------------------------------


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys; sys.argv = ['vcbf-drake', *sys.argv[1:]]\n"
        "from vcbf_drake.cli import main\n"
        "try: main()\n"
        "except SystemExit as stop: assert stop.code == 0\n"
        "heavy = {'pydrake', 'numpy', 'matplotlib', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    for arguments in (["--help"], ["run", "--help"], ["monte-carlo", "--help"]):
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments],
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    "command",
    [
        "list",
        "run",
        "compare",
        "check",
        "diagram",
        "monte-carlo",
        "faults",
    ],
)
def test_help_lists_commands(command: str) -> None:
    assert command in invoke("--help").output
    assert invoke(command, "--help").exit_code == 0


def test_nothing_at_all_asks_for_help() -> None:
    shown = invoke()
    assert shown.exit_code == 0
    assert shown.output == invoke("--help").output
    assert "Exit status: 0 done" in " ".join(shown.output.split())


def test_help_names_every_method_and_wraps_once() -> None:
    assert METHOD_NAMES == ", ".join(METHODS)
    for command in ("run", "plant", "controller", "monte-carlo"):
        told = invoke(command, "--help").output.partition("╭")[0]
        lines = [line.strip() for line in told.splitlines()]
        broken = [a for a, b in pairwise(lines) if b and a]
        assert all(len(line) > 50 for line in broken), broken


def test_counts_are_printed_in_full_and_measures_in_three_digits() -> None:
    assert number_text(2001) == "2001"
    assert number_text(2001.4) == "2e+03"
    assert number_text(None) == "-"


def test_show_prints_a_scenario_that_loads(tmp_path: Path) -> None:
    shown = invoke("show", "car-avoidance")
    copy = tmp_path / "mine.yaml"
    copy.write_text(shown.output)
    assert load_scenario(copy) == load_scenario("car-avoidance")
    assert invoke("show", "car-avoidence").exit_code == 2


def test_schema_prints_the_format_for_editors() -> None:
    assert json.loads(invoke("schema").stdout) == scenario_schema()


def test_one_scenario_of_a_file_is_chosen_by_its_name(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    text = "".join(invoke("show", name).output for name in shipped_scenarios()[:2])
    (tmp_path / "two.yaml").write_text(text)
    refused = invoke("run", str(tmp_path / "two.yaml"))
    assert refused.exit_code == 2 and "scenario" in refused.output
    name = shipped_scenarios()[1]
    options = ["--scenario-name", name, "--out", str(tmp_path / "out")]
    assert invoke("run", str(tmp_path / "two.yaml"), *options).exit_code == 0
    assert [scenario.name for scenario in stand_ins] == [name]


def test_a_terminated_command_ends_with_the_signals_status(tmp_path: Path) -> None:
    arguments = ["monte-carlo", "car-avoidance", "--trials", "50", "--workers", "1"]
    arguments += ["--vary", "initial_state.0: !Add [-0.1, 0.1]", "--override", SHORT]
    command = [sys.executable, "-m", "vcbf_drake", *arguments, "--out", str(tmp_path)]
    records = tmp_path / "trials.jsonl"
    running = subprocess.Popen(command)
    while not (records.exists() and records.read_bytes()):
        assert running.poll() is None
        time.sleep(0.01)
    running.terminate()
    assert running.wait(timeout=60) == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == [records]


def test_ctrl_c_ends_a_live_run_in_one_line(tmp_path: Path) -> None:
    arguments = ["run", "car-avoidance", "--live", "--out", str(tmp_path / "out")]
    command = [sys.executable, "-m", "vcbf_drake", *arguments]
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert running.stderr is not None
    assert running.stderr.readline().startswith("open http://127.0.0.1:")
    running.send_signal(signal.SIGINT)
    assert running.communicate(timeout=60) == ("", "vcbf-drake: interrupted\n")
    assert running.returncode == 128 + signal.SIGINT
    assert not (tmp_path / "out").exists()


def test_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda name: f"{name} 1.2.3")
    shown = invoke("--version")
    assert (shown.exit_code, shown.output) == (0, "vcbf-drake 1.2.3\n")


def test_list_shows_each_scenario_on_a_line() -> None:
    lines = invoke("list").stdout.splitlines()
    assert [line.split()[0] for line in lines] == [
        "blimp-multiple-obstacles",
        "blimp-single-obstacle",
        "car-avoidance",
        "car-sensitivity",
    ]
    assert all("  " in line and len(line) <= 80 for line in lines)


# Bad usage -------------------------------------------------------------------------

ONE_GAIN = "{barrier: {gains: [4.0]}}"


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["rnu"], "No such command 'rnu'"),
        (["--colour"], "--colour"),
        (["run"], "Missing argument 'SCENARIO'"),
        (["run", "car-avoidance", "--metod", "x"], "--metod"),
        (["run", "car-avoidence"], "did you mean car-avoidance?"),
        (["run", "car-avoidance", "--method", "cbf"], "vcbf-drake: method: 'cbf'; it"),
        (["run", "car-avoidance", "--override", "{a: [}"], "override: not YAML"),
        (["run", "car-avoidance", "--override", "{period: 0}"], "override: period: 0"),
        (["run", "car-avoidance", "--out", __file__], "is a file"),
        (["compare", "car-avoidance", "--out", f"{__file__}/a/b"], "is no directory"),
        (["compare", "car-avoidance", "--methods", "cbf-qp,x"], "drake: method: 'x'"),
        (["check", "car-avoidance", "--method", "x"], "vcbf-drake: method: 'x'"),
        (["check", "car-avoidance", "--override", ONE_GAIN], "give 2 gains"),
        (
            ["check", "car-avoidance", "--override", "{input_weights: [1]}"],
            "vcbf-drake: override: input_weights: [1.0]; it must be 2 positive numbers",
        ),
    ],
)
def test_bad_usage_is_one_line_and_status_2(
    stand_ins: list[Scenario], arguments: list[str], problem: str
) -> None:
    shown = invoke(*arguments)
    assert shown.exit_code == 2
    assert shown.output.startswith("vcbf-drake: ")
    assert shown.output.count("\n") == 1
    assert problem in shown.output
    assert stand_ins == []


def test_bad_scenario_from_a_shell() -> None:
    done = process("check", "car-avoidance", "--override", "{observer: {alpha: '5'}}")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == (
        "vcbf-drake: override: observer.alpha: '5'; it must be a number,"
        " unquoted and decimal: 1.5708 for 90 degrees\n"
    )


def test_a_log_can_grow_somewhere_else(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    log, out = tmp_path / "log", tmp_path / "out"
    shown = invoke(
        "run", "car-avoidance", "--log-to", str(log), "--out", str(out), "--no-replay"
    )
    assert shown.exit_code == 0
    assert files(log) == {"time.npy"}
    assert "time.npy" not in files(out)


def test_other_failures_are_one_line_and_status_1(
    stand_ins: list[Scenario], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def simulate_fleet(fleet: Fleet, progress: object, **_: object) -> None:
        raise RuntimeError("the solver\nbroke")

    monkeypatch.setattr(run_module, "simulate_fleet", simulate_fleet)
    arguments = ["run", "car-avoidance", "--out", str(tmp_path / "out")]
    shown = invoke(*arguments)
    assert shown.exit_code == 1
    assert shown.output == (
        "vcbf-drake: RuntimeError: the solver broke"
        " (vcbf-drake --traceback ... shows where)\n"
    )
    shown = invoke("--traceback", *arguments)
    assert shown.exit_code == 1
    assert "Traceback" in shown.output
    assert "in simulate_fleet" in shown.output


# Results ---------------------------------------------------------------------------


def test_run_writes_results_figures_and_replay(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "out"
    shown = invoke("run", "car-avoidance", "--out", str(out), "--method", "vcbf-qp")
    assert shown.exit_code == 0
    assert files(out) == {"summary.json", "paths.svg", "replay.html"}
    assert [scenario.method for scenario in stand_ins] == ["vcbf-qp"]
    assert "reached" in shown.output
    assert str(out) in shown.output.replace("\n", "")


def test_run_leaves_out_what_is_not_wanted(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    invoke("run", "car-avoidance", "--out", str(out), "--no-replay", "--no-figures")
    assert files(out) == {"summary.json"}


def test_default_directories(
    stand_ins: list[Scenario], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    invoke("run", "car-avoidance", "--method", "cbf-qp")
    invoke("compare", "car-avoidance", "--methods", "cbf-qp")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "car-avoidance-cbf-qp",
        "car-avoidance",
    }


def test_compare_writes_one_replay_and_a_directory_per_method(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    methods = "dob-cbf-qp, dob-vcbf-qp,dob-cbf-qp"
    shown = invoke("compare", "car-avoidance", "--methods", methods, "--out", str(out))
    assert shown.exit_code == 0
    assert files(out) == {
        "dob-cbf-qp/summary.json",
        "dob-vcbf-qp/summary.json",
        "paths.svg",
        "replay.html",
    }
    assert (out / "replay.html").read_text() == "dob-cbf-qp dob-vcbf-qp"
    assert "no input satisfies input limit 1, obstacle 5" in shown.output
    assert "hypotheses that fail (see vcbf-drake check): known start" in shown.output


def test_compare_runs_all_methods_in_80_columns(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    shown = invoke("compare", "car-avoidance", "--out", str(tmp_path))
    assert [scenario.method for scenario in stand_ins] == list(METHODS)
    lines = shown.output.splitlines()
    table = [line for line in lines if "written to" not in line]
    assert max(len(line) for line in table) <= 80
    # No cell is cut short and no label is broken.
    assert "…" not in shown.output
    rows = [line for line in table if line.startswith("infeasible s")]
    cells = [cell for row in rows for cell in row.split()[2:]]
    assert cells == ["7.6" if m == "dob-cbf-qp" else "-" for m in METHODS]


def test_results_are_written_first_and_each_file_whole_or_not_at_all(
    stand_ins: list[Scenario], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    (out / "mine").mkdir(parents=True)
    (out / "mine" / "notes.txt").write_text("keep")
    (out / "replay.html").write_text("old")

    def write_replay(results: Sequence[Any], path: Path) -> None:
        path.write_text("half a page")
        raise OSError("no space left")

    with monkeypatch.context() as broken:
        broken.setattr(replay_module, "write_replay", write_replay)
        assert invoke("run", "car-avoidance", "--out", str(out)).exit_code == 1
    whole = {
        "out/mine/notes.txt",
        "out/summary.json",
        "out/paths.svg",
        "out/replay.html",
    }
    assert files(tmp_path) == whole
    assert json.loads((out / "summary.json").read_text())["outcome"] == "reached"
    assert (out / "replay.html").read_text() == "old"

    assert invoke("run", "car-avoidance", "--out", str(out)).exit_code == 0
    assert files(tmp_path) == whole
    assert (out / "replay.html").read_text() != "old"


def test_what_a_killed_process_left_is_removed(
    stand_ins: list[Scenario], tmp_path: Path
) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f".out-{dead.pid}").mkdir()
    (tmp_path / f".out-{dead.pid}" / "log.npz").write_text("half")
    (tmp_path / ".out-of-reach").mkdir()
    done = invoke("run", "car-avoidance", "--out", str(tmp_path / "out"))
    assert done.exit_code == 0
    assert {path.name for path in tmp_path.iterdir()} == {"out", ".out-of-reach"}


# Check -----------------------------------------------------------------------------

ASSUMPTIONS = (
    Assumption("bounded", "U is bounded [N]", True, {"width": 0.5}, "no ellipsoid"),
    Assumption("no wind", "d = 0", False, {"delta1": math.inf}, "h may be negative"),
    Assumption("rates", "lambda_V >= 1", None, {"lambda_V": 4.0, "x": math.nan}, ""),
)


@pytest.fixture
def fixed_assumptions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "check_assumptions", lambda scenario: ASSUMPTIONS)


@pytest.mark.usefixtures("fixed_assumptions")
def test_check_lists_hypotheses() -> None:
    shown = invoke("check", "car-avoidance", "--method", "cbf-qp")
    assert shown.exit_code == 0
    words = " ".join(shown.output.split())
    assert words.startswith("car-avoidance, cbf-qp")
    assert "holds bounded U is bounded [N] width = 0.5" in words
    assert "does not hold no wind d = 0 delta1 = inf cost: h may be negative" in words
    assert "information rates lambda_V >= 1 lambda_V = 4, x = -" in words
    assert "no ellipsoid" not in words


@pytest.mark.usefixtures("fixed_assumptions")
def test_check_prints_strict_json() -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    shown = invoke("check", "car-avoidance", "--json")
    listed = json.loads(shown.output, parse_constant=refuse)
    assert [each["holds"] for each in listed] == [True, False, None]
    assert listed[1]["numbers"] == {"delta1": None}
    assert listed[0] == {
        "name": "bounded",
        "statement": "U is bounded [N]",
        "holds": True,
        "numbers": {"width": 0.5},
        "consequence": "no ellipsoid",
    }


# The real thing --------------------------------------------------------------------


RESULT = {"log.npz", "replay.html", "scenario.yaml", "summary.json"}


@pytest.mark.parametrize("name", shipped_scenarios())
def test_runs_shipped_scenario(name: str, tmp_path: Path) -> None:
    out = tmp_path / name
    done = invoke("run", name, "--override", SHORT, "--no-figures", "--out", str(out))
    assert (done.exit_code, done.stderr) == (0, "")
    assert files(out) == RESULT
    saved = json.loads((out / "summary.json").read_text())
    assert saved["outcome"] == "timeout"
    assert saved["outcome"] in done.stdout


def test_a_pipe_sees_the_summary_on_stdout_and_nothing_on_stderr(
    tmp_path: Path,
) -> None:
    options = ("--override", SHORT, "--no-figures", "--out", str(tmp_path / "out"))
    done = process("run", "car-avoidance", *options)
    assert (done.returncode, done.stderr) == (0, "")
    assert files(tmp_path / "out") == RESULT
    assert "timeout" in done.stdout
    assert "\x1b" not in done.stdout


def test_checks_shipped_scenario() -> None:
    listed = json.loads(invoke("check", "car-avoidance", "--json").output)
    assert all(each["holds"] is not False for each in listed)
    assert all(each["name"] and each["statement"] for each in listed)


def test_diagram_writes_the_loop_and_the_filter(tmp_path: Path) -> None:
    done = invoke("diagram", "car-avoidance", "--out", str(tmp_path / "drawn"))
    assert done.exit_code == 0
    names = {path.name for path in (tmp_path / "drawn").iterdir()}
    assert {"car-avoidance.dot", "safety-filter.dot"} <= names


def test_what_drake_says_of_its_solvers_is_kept_back(
    caplog: pytest.LogCaptureFixture,
) -> None:
    log = logging.getLogger("drake")
    assert CliRunner().invoke(app, ["list"]).exit_code == 0
    with caplog.at_level(logging.INFO, "drake"):
        log.info("Clarabel returns InsufficientProgress")
        log.warning("something is wrong")
    assert caplog.messages == ["something is wrong"]


def test_a_bound_below_zero_certifies_nothing(tmp_path: Path) -> None:
    """A period of 5 s: the car touches between two ticks."""
    without = ["--no-figures", "--no-replay", "--out", str(tmp_path)]
    done = invoke("run", "car-avoidance", "--override", "{period: 5}", *without)
    assert "promises broken" in done.stdout
    assert "certified at every instant" not in done.stdout
