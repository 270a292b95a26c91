from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
)
from dataclasses import dataclass, replace
import json
import os
from pathlib import Path
import pickle
import re
import shlex
import subprocess
from subprocess import PIPE
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from examples.paper.table_1 import RANDOM_GAINS, RANDOM_STARTS
from vcbf_drake.cli import app
from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.loading import (
    dump_scenario,
    load_scenario,
    scenario_path,
)
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.studies import (
    Trial,
    Variation,
    executors,
    run_study,
    run_trial,
    share_interval,
    summarise_study,
)
from vcbf_drake.studies.statistics import mean_interval
import vcbf_drake.studies.trial as trial_module
from vcbf_drake.studies.trial import error_record
from vcbf_drake.viz.running_time_figure import (
    running_time_figure,
    write_running_times,
)

BLIMP = "blimp-multiple-obstacles"
METHODS = ("dob-cbf-qp", "dob-vcbf-qp")
GAINS = {"alpha": (4.6, 6.0), "beta": (5.0, 7.0), "gamma": (3.6, 4.4)}
SHORT = "{duration: 0.1}"


def plan(count: int, **fields: Any) -> list[Trial]:
    """Pairs of trials around the blimp's scenario."""
    fields = {"variation": RANDOM_STARTS, **fields}
    return [
        Trial(BLIMP, method, index, **fields)
        for index in range(count)
        for method in METHODS
    ]


TICKS = {
    "ticks": 1001,
    "relaxed_ticks": 3,
    "infeasible_ticks": 0,
    "decayed_ticks": 0,
    "failed_ticks": 1,
    "final_status": 1,
    "reasons_against": ["audit: slack"],
}


def stand_in_summary(scenario: Scenario) -> dict[str, Any]:
    """Made up, and different for every draw."""
    stays_feasible = scenario.method == "dob-vcbf-qp"
    time = scenario.duration if stays_feasible else 10 + 50 * scenario.initial_state[0]
    return {
        "outcome": "reached" if stays_feasible else "infeasible",
        "running_time": time,
        "reached_at": 17.0 if stays_feasible else None,
        "infeasible_at": None if stays_feasible else time,
        "collided_at": None,
        "min_barrier": 0.1,
        "min_volume": float("nan"),
        "max_abs_slack": 0.0,
        **TICKS,
    }


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> list[Scenario]:
    """Replaces the simulation in this process; collects the scenarios run."""
    scenarios: list[Scenario] = []

    def simulate_fleet(fleet: Fleet, step_time: bool) -> list[SimpleNamespace]:
        (scenario,) = fleet.vehicles
        scenarios.append(scenario)
        return [SimpleNamespace(summary=stand_in_summary(scenario))]

    monkeypatch.setattr(trial_module, "simulate_fleet", simulate_fleet)
    return scenarios


@dataclass(frozen=True)
class Saboteur(Variation):
    """Kills the process, or raises, at one draw."""

    deadly: int = -1
    wrong: int = -1

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        if index == self.deadly:
            os._exit(3)
        if index == self.wrong:
            raise ZeroDivisionError("made to fail")
        return {}


# Draws -----------------------------------------------------------------------------


def test_a_pair_sees_the_same_draw() -> None:
    for variation in (RANDOM_STARTS, RANDOM_GAINS):
        first, second = plan(1, variation=variation)
        scenarios = [first.load(), second.load()]
        assert [scenario.method for scenario in scenarios] == list(METHODS)
        scenarios[1].method = scenarios[0].method
        assert dump_scenario(scenarios[0]) == dump_scenario(scenarios[1])


def test_draws_differ_by_index_and_by_seed() -> None:
    drawn = [
        Trial(BLIMP, "dob-cbf-qp", index, seed, RANDOM_STARTS).all_overrides()
        for index in range(3)
        for seed in range(3)
    ]
    assert len(set(drawn)) == 9


def test_draws_are_uniform_over_the_ranges_of_table_one() -> None:
    scenario = load_scenario(BLIMP)
    draws = [RANDOM_STARTS.draw(scenario, 0, index) for index in range(500)]
    starts = np.array([draw["initial_state"] for draw in draws])
    assert (starts[:, 3:] == scenario.initial_state[3:]).all()
    draws = [RANDOM_GAINS.draw(scenario, 0, index) for index in range(500)]
    assert all(list(draw) == ["observer"] for draw in draws)
    gains = [[draw["observer"][name] for draw in draws] for name in GAINS]
    ranges = [(-0.1, 0.1), (-0.1, 0.1), (0.0, 0.2), *GAINS.values()]
    for sample, (low, high) in zip([*starts.T[:3], *gains], ranges, strict=True):
        assert low <= np.min(sample) <= np.max(sample) <= high
        assert stats.kstest(sample, stats.uniform(low, high - low).cdf).pvalue > 0.01


def test_draws_are_around_the_overrides() -> None:
    moved = "{initial_state: [1.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0], duration: 3.0}"
    trial = Trial(BLIMP, "cbf-qp", 0, variation=RANDOM_STARTS, overrides=moved)
    scenario = trial.load()
    assert scenario.duration == 3.0
    assert 0.9 < scenario.initial_state[0] < 1.1
    assert 5.0 <= scenario.initial_state[2] < 5.2


@pytest.mark.parametrize("overrides", ["", '{description: "it\'s\\nodd"}'])
@pytest.mark.parametrize("variation", [RANDOM_STARTS, RANDOM_GAINS])
def test_the_command_line_loads_the_same_scenario(
    variation: Variation, overrides: str
) -> None:
    trial = Trial(BLIMP, "vcbf-qp", 7, 3, variation, overrides)
    program, run, name, *options = shlex.split(trial.command())
    assert (program, run, options[0], options[2]) == (
        "vcbf-drake",
        "run",
        "--method",
        "--override",
    )
    scenario = load_scenario(name, options[3])
    scenario.method = options[1]
    assert dump_scenario(scenario) == dump_scenario(trial.load())
    assert "\n" not in trial.command()


def test_a_trial_pickles() -> None:
    (trial, _) = plan(1)
    assert pickle.loads(pickle.dumps(trial)) == trial


# Records ---------------------------------------------------------------------------


@pytest.mark.usefixtures("simulated")
def test_a_record_is_plain_and_strict_json() -> None:
    record = run_trial(plan(1)[1])
    made_with = record.pop("made_with")
    assert re.fullmatch(r"python .*drake .*numpy .*, scenario [0-9a-f]{8}", made_with)
    assert record == {
        "scenario": BLIMP,
        "overrides": "",
        "variation": "case-1",
        "seed": 0,
        "index": 0,
        "method": "dob-vcbf-qp",
        "outcome": "reached",
        "running_time": 20.0,
        "reached_at": 17.0,
        "infeasible_at": None,
        "collided_at": None,
        "min_barrier": 0.1,
        "min_volume": None,
        "max_abs_slack": 0.0,
        **TICKS,
        "guaranteed_feasible": None,
        "error": None,
    }
    json.dumps(record, allow_nan=False)


@pytest.mark.usefixtures("simulated")
def test_a_crash_is_recorded_and_the_study_goes_on(tmp_path: Path) -> None:
    trials = plan(3, variation=Saboteur(label="sabotage", wrong=1))
    records = run_study(trials, tmp_path / "trials.jsonl")
    assert [record["outcome"] == "error" for record in records] == [
        trial.index == 1 for trial in trials
    ]
    assert records[2]["error"] == "ZeroDivisionError: made to fail"
    assert records[2]["running_time"] is None


def test_a_scenario_that_does_not_load_is_recorded() -> None:
    record = run_trial(Trial("no-such-scenario", "cbf-qp", 0))
    assert record["outcome"] == "error"
    assert record["error"].startswith("ScenarioError: no-such-scenario: neither")


# Files -----------------------------------------------------------------------------


def test_one_and_two_workers_write_the_same_file(tmp_path: Path) -> None:
    """Real simulations, in this process and in two others; one of them dies."""
    trials = plan(2, overrides=SHORT)
    trials += plan(2, overrides=SHORT, variation=RANDOM_GAINS)
    one, two = tmp_path / "one.jsonl", tmp_path / "two.jsonl"
    run_study(trials, one)
    killer = Trial(BLIMP, "cbf-qp", 0, variation=Saboteur(label="sabotage", deadly=0))
    with_killer = [*trials[:3], killer, *trials[3:]]
    done: list[float] = []
    records = run_study(with_killer, two, workers=2, progress=done.append)
    lines = two.read_bytes().splitlines()
    assert records[3]["error"] == "its process died, twice"
    assert lines[:3] + lines[4:] == one.read_bytes().splitlines()
    assert done == pytest.approx(np.arange(1, 10) / 9)
    assert [json.loads(line) for line in lines] == records


def test_processes_make_room_for_new_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    pools: list[ThreadPoolExecutor] = []

    def new_pool(workers: int) -> ThreadPoolExecutor:
        pools.append(ThreadPoolExecutor(workers))
        return pools[-1]

    monkeypatch.setattr(executors, "new_pool", new_pool)
    monkeypatch.setattr(executors, "TRIALS_A_PROCESS", 2)
    with executors.WorkerProcesses(workers=2) as processes:
        futures = [processes.submit(abs, index) for index in range(9)]
    assert [future.result() for future in futures] == list(range(9))
    assert len(pools) == 3


def test_a_killed_study_leaves_no_process_behind(tmp_path: Path) -> None:
    path = tmp_path / "trials.jsonl"
    script = (
        "from vcbf_drake.studies import Trial, run_study\n"
        f"trials = [Trial({BLIMP!r}, 'cbf-qp', index, overrides={SHORT!r})"
        " for index in range(1000)]\n"
        f"run_study(trials, {str(path)!r}, workers=2,"
        " progress=lambda done: print(done, flush=True))\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=PIPE) as study:
        assert study.stdout is not None
        assert study.stdout.readline() == b"0.001\n"
        study.kill()
        # Its workers hold the pipe's other end, too: it closes with the last of them.
        study.communicate(timeout=60)
    assert json.loads(path.read_text().splitlines()[0])["outcome"] == "timeout"


def cuts(content: bytes) -> Iterator[int]:
    """Everywhere that matters, and the rest coarsely."""
    breaks = [at for at, byte in enumerate(content) if byte == ord("\n")]
    yield from (at + shift for at in breaks for shift in (-1, 0, 1))
    yield from range(0, len(content), 97)


def test_a_truncated_file_is_completed_to_the_same_content(
    simulated: list[Scenario], tmp_path: Path
) -> None:
    trials = plan(3)
    path = tmp_path / "trials.jsonl"
    run_study(trials, path)
    whole = path.read_bytes()
    for cut in cuts(whole):
        path.write_bytes(whole[:cut])
        simulated.clear()
        run_study(trials, path)
        assert path.read_bytes() == whole
        assert len(simulated) == len(trials) - whole[:cut].count(b"\n")
    assert [each.name for each in tmp_path.iterdir()] == ["trials.jsonl"]


def test_an_interrupted_study_keeps_what_is_done(
    monkeypatch: pytest.MonkeyPatch, simulated: list[Scenario], tmp_path: Path
) -> None:
    trials = plan(2)
    run_study(trials, tmp_path / "undisturbed.jsonl")
    path = tmp_path / "trials.jsonl"

    def interrupt(fleet: Fleet, step_time: bool) -> list[SimpleNamespace]:
        (scenario,) = fleet.vehicles
        if scenario.method == "dob-vcbf-qp":
            raise KeyboardInterrupt
        return [SimpleNamespace(summary=stand_in_summary(scenario))]

    with monkeypatch.context() as interrupted:
        interrupted.setattr(trial_module, "simulate_fleet", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_study(trials, path)
    assert path.read_text().count("\n") == 1
    run_study(trials, path)
    assert path.read_bytes() == (tmp_path / "undisturbed.jsonl").read_bytes()


def test_a_study_can_be_made_longer(simulated: list[Scenario], tmp_path: Path) -> None:
    path = tmp_path / "trials.jsonl"
    run_study(plan(2), path)
    simulated.clear()
    records = run_study(plan(3), path)
    assert len(simulated) == 2
    assert [(record["index"], record["method"]) for record in records] == [
        (trial.index, trial.method) for trial in plan(3)
    ]


@pytest.mark.usefixtures("simulated")
@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"overrides": SHORT},
        {"variation": RANDOM_GAINS},
    ],
)
def test_another_studys_file_is_refused(tmp_path: Path, other: dict[str, Any]) -> None:
    path = tmp_path / "trials.jsonl"
    run_study(plan(1, **other), path)
    before = path.read_bytes()
    with pytest.raises(ScenarioError, match=r"jsonl:1: the record of another study"):
        run_study(plan(1), path)
    assert path.read_bytes() == before


@pytest.mark.usefixtures("simulated")
def test_records_of_other_versions_or_of_a_changed_scenario_are_refused(
    tmp_path: Path,
) -> None:
    """A study that goes on after an upgrade or an edit would mix two."""
    path, scenario = tmp_path / "trials.jsonl", tmp_path / "own.yaml"
    scenario.write_text(scenario_path(BLIMP).read_text())
    trials = [Trial(str(scenario), "cbf-qp", index) for index in range(2)]
    run_study(trials[:1], path)
    assert len(run_study(trials, path)) == 2
    before = path.read_bytes()
    path.write_bytes(before.replace(b"numpy ", b"numpy 0."))
    with pytest.raises(ScenarioError, match=r"jsonl:1: made with python .* numpy 0\."):
        run_study(trials, path)
    path.write_bytes(before.replace(b'"made_with"', b'"of_old"'))
    with pytest.raises(ScenarioError, match=r"made with versions that it does not"):
        run_study(trials, path)
    path.write_bytes(before)
    scenario.write_text(scenario.read_text() + "# edited\n")
    with pytest.raises(ScenarioError, match=r"here it is .*; use another file"):
        run_study(trials, path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("line", ["{}", "[1]", "3", "{", "", "null"])
def test_a_file_of_something_else_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "trials.jsonl"
    path.write_text(f"{line}\n")
    with pytest.raises(ScenarioError, match=r"jsonl:1: not the record of a trial"):
        run_study(plan(1), path)


# Executors -------------------------------------------------------------------------


class BackwardsExecutor(Executor):
    """Runs the last first, when the first result is asked for."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error

    def submit(  # type: ignore[override]
        self, function: Callable[..., Any], *arguments: Any
    ) -> Future[Any]:
        future: Future[Any] = Future()
        if self.error is not None and arguments[0].index == 1:
            future.set_exception(self.error)
        else:
            future.set_result(function(*arguments))
        return future


@pytest.mark.usefixtures("simulated")
def test_any_executor_will_do(tmp_path: Path) -> None:
    trials = plan(4)
    paths = [tmp_path / f"{number}.jsonl" for number in range(3)]
    run_study(trials, paths[0])
    run_study(trials, paths[1], BackwardsExecutor())
    with ThreadPoolExecutor(3) as pool:
        run_study(trials, paths[2], pool)
    assert paths[0].read_bytes() == paths[1].read_bytes() == paths[2].read_bytes()


@pytest.mark.usefixtures("simulated")
def test_an_executors_failures(tmp_path: Path) -> None:
    """A lost trial is recorded; a broken executor is not every trial's fault."""
    lost = BackwardsExecutor(RuntimeError("worker killed"))
    records = run_study(plan(3), tmp_path / "lost.jsonl", lost)
    assert [record["error"] for record in records] == [
        None,
        None,
        *["RuntimeError: worker killed"] * 2,
        None,
        None,
    ]
    path = tmp_path / "broken.jsonl"
    with ThreadPoolExecutor(1, initializer=sys.exit) as broken:
        with pytest.raises(BrokenExecutor):
            run_study(plan(3), path, broken)
    assert 'error": "' not in path.read_text()


# Statistics ------------------------------------------------------------------------


def made_up(
    times: list[tuple[float, float]], outcomes: list[tuple[str, str]] | None = None
) -> tuple[list[Trial], list[dict[str, Any]]]:
    """Trials and records with these running times, and outcomes by the times."""
    trials = plan(len(times))
    flat = [time for pair in times for time in pair]
    words = [word for pair in outcomes or [] for word in pair] or [
        "reached" if time >= 20.0 else "infeasible" for time in flat
    ]
    return trials, [
        error_record(trial, "")
        | {"running_time": time, "outcome": word, "error": None}
        | {"reached_at": time if word == "reached" else None}
        for trial, time, word in zip(trials, flat, words, strict=True)
    ]


def test_means_and_differences_of_pairs() -> None:
    rng = np.random.default_rng(5)
    without = np.minimum(20.0, rng.exponential(12.0, 60))
    with_volume = np.minimum(20.0, without + rng.normal(4.0, 3.0, 60))
    times = [(float(a), float(b)) for a, b in zip(without, with_volume, strict=True)]
    summary = summarise_study(*made_up(times))
    (comparison,) = summary["comparisons"]
    pairs = zip(summary["methods"].values(), (without, with_volume), strict=True)
    samples = [
        *((each["mean_running_time"], each["interval"], x) for each, x in pairs),
        (comparison["mean_difference"], comparison["interval"], with_volume - without),
    ]
    for mean, interval, sample in samples:
        assert mean == pytest.approx(np.mean(sample), rel=1e-12)
        by_t = stats.t.interval(0.95, 59, np.mean(sample), stats.sem(sample))
        assert interval == pytest.approx(by_t, abs=0.25 * stats.sem(sample))
    assert comparison["pairs"] == 60
    assert comparison["worse"] == np.sum(with_volume < without) > 0
    assert comparison["better"] == np.sum(with_volume > without)


def test_a_shares_interval_is_wilsons() -> None:
    z, count, total = stats.norm.ppf(0.975), 161, 600
    share = count / total
    # The two shares whose score test just keeps the one that was found.
    low, high = share_interval(count, total)  # type: ignore[misc]
    for bound in (low, high):
        deviation = np.sqrt(bound * (1.0 - bound) / total)
        assert abs(share - bound) == pytest.approx(z * deviation, rel=1e-9)
    assert share_interval(0, 0) is None


def test_intervals_cover_the_mean_as_often_as_they_say() -> None:
    rng = np.random.default_rng(8)
    samples = rng.uniform(0.0, 1.0, (150, 30))
    hits = [low <= 0.5 <= high for low, high in map(mean_interval, samples)]  # type: ignore[misc]
    assert 0.88 < np.mean(hits) <= 1.0


def test_an_interval_is_repeatable_and_needs_two_values() -> None:
    assert mean_interval([1.0, 2.0, 4.0]) == mean_interval([1.0, 2.0, 4.0])
    assert mean_interval([1.0]) is None
    assert mean_interval([20.0, 20.0]) == (20.0, 20.0)


def test_who_did_worse() -> None:
    trials, records = made_up(
        [(20.0, 20.0), (20.0, 20.0), (9.0, 8.0), (9.0, 12.0), (9.0, 12.0), (5.0, 20.0)],
        [
            ("reached", "reached"),
            ("reached", "timeout"),
            ("infeasible", "infeasible"),
            ("infeasible", "collision"),
            ("collision", "infeasible"),
            ("infeasible", "reached"),
        ],
    )
    summary = summarise_study(trials, records)
    (comparison,) = summary["comparisons"]
    assert (comparison["method"], comparison["baseline"]) == METHODS[::-1]
    counts = [comparison[name] for name in ("better", "same", "worse")]
    assert counts == [2, 1, 3]
    worse = comparison["worse_trials"]
    assert [trial["index"] for trial in worse] == [1, 2, 3]
    assert worse[1] == {
        "index": 2,
        "outcome": "infeasible",
        "running_time": 8.0,
        "baseline_outcome": "infeasible",
        "baseline_running_time": 9.0,
        "replay": trials[5].command(),
    }
    assert summary["methods"]["dob-cbf-qp"]["outcomes"] == {
        "collision": 1,
        "infeasible": 3,
        "reached": 2,
    }


def test_crashes_leave_their_pairs_out() -> None:
    trials, records = made_up([(10.0, 20.0), (10.0, 20.0), (4.0, 6.0)])
    records[3] |= {"running_time": None, "outcome": "error", "error": "E: x"}
    summary = summarise_study(trials, records)
    (comparison,) = summary["comparisons"]
    assert comparison["pairs"] == 2
    assert comparison["mean_difference"] == pytest.approx(6.0)
    assert summary["methods"]["dob-vcbf-qp"]["mean_running_time"] == pytest.approx(13.0)
    assert summary["methods"]["dob-vcbf-qp"]["trials"] == 3
    assert summary["errors"] == [
        {
            "index": 1,
            "method": "dob-vcbf-qp",
            "error": "E: x",
            "replay": trials[3].command(),
        }
    ]


def test_a_study_of_crashes_alone_has_no_numbers() -> None:
    trials, records = made_up([(1.0, 1.0)])
    for record in records:
        record |= {"running_time": None, "outcome": "error", "error": "E: x"}
    summary = summarise_study(trials, records)
    assert summary["methods"]["dob-cbf-qp"]["mean_running_time"] is None
    assert summary["comparisons"][0]["mean_difference"] is None


# Figure ----------------------------------------------------------------------------


def test_the_figure_is_the_same_bytes_every_time(tmp_path: Path) -> None:
    trials, records = made_up([(10.0, 20.0), (20.0, 20.0), (4.0, 6.0)])
    records[5] |= {"running_time": None, "outcome": "error", "error": "E: x"}
    summary = summarise_study(trials, records)
    contents = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        paths = write_running_times(records, summary, tmp_path / name)
        assert [path.name for path in paths] == [
            "running_times.png",
            "running_times.svg",
        ]
        contents.append([path.read_bytes() for path in paths])
    assert contents[0] == contents[1]


def test_the_figure_of_a_long_study_shows_some_of_its_columns() -> None:
    rng = np.random.default_rng(2)
    times = [(float(a), 20.0) for a in rng.uniform(0.0, 20.0, 2500)]
    _, records = made_up(times)
    summary = {"methods": {name: {"mean_running_time": None} for name in METHODS}}
    axes = running_time_figure(records, summary).axes[0]
    assert "one trial in 3, in the order of DOB-CBF-QP" in axes.get_xlabel()
    assert len(axes.collections) == 1
    shown = [segment[0][1] for segment in axes.collections[0].get_segments()]
    assert shown == sorted(time for time, _ in times)[::3]


# Command line ----------------------------------------------------------------------


def invoke(*arguments: str) -> Any:
    if "--vary" not in arguments:
        arguments = (*arguments, "--vary", RANDOM_STARTS.text)
    return CliRunner().invoke(app, ["monte-carlo", BLIMP, *arguments])


def test_the_command_writes_everything(
    simulated: list[Scenario], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = ["--trials", "3", "--workers", "1", "--out", str(out)]
    shown = invoke(*options)
    assert shown.exit_code == 0, shown.output
    assert {path.name for path in out.iterdir()} == {
        "trials.jsonl",
        "summary.json",
        "running_times.png",
        "running_times.svg",
    }
    summary = json.loads((out / "summary.json").read_text())
    assert summary["methods"]["dob-vcbf-qp"]["outcomes"] == {"reached": 3}
    assert summary["comparisons"][0]["better"] == 3
    lines = shown.output.splitlines()
    assert "20.00 .. 20.00" in shown.output and "against dob-cbf-qp" in shown.output
    best = summary["methods"]["dob-vcbf-qp"]
    assert (best["median_arrival"], best["least_barrier"]) == (17.0, 0.1)
    assert summary["methods"]["dob-cbf-qp"]["median_arrival"] is None
    assert [line.split() for line in lines if line.startswith("dob-vcbf-qp  ")][1] == (
        ["dob-vcbf-qp", "17.00", "0.1", "-"]
    )
    assert max(len(line) for line in lines if "written to" not in line) <= 80

    before = (out / "trials.jsonl").read_bytes()
    refused = invoke(*options)
    assert refused.exit_code == 2
    assert refused.output.count("\n") == 1
    assert "has results; --resume goes on with them" in refused.output

    simulated.clear()
    shown = invoke(*options, "--resume")
    assert shown.exit_code == 0 and simulated == []
    assert (out / "trials.jsonl").read_bytes() == before

    other = invoke(*options, "--resume", "--vary", RANDOM_GAINS.text)
    assert other.exit_code == 2
    assert "the record of another study" in other.output


def test_the_command_shows_what_to_run_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def simulate_fleet(fleet: Fleet, step_time: bool) -> list[SimpleNamespace]:
        (scenario,) = fleet.vehicles
        if scenario.method == "cbf-qp":
            raise RuntimeError("broken")
        return [SimpleNamespace(summary=stand_in_summary(scenario))]

    monkeypatch.setattr(trial_module, "simulate_fleet", simulate_fleet)
    shown = invoke(
        *("--trials", "7", "--workers", "1", "--out", str(tmp_path / "out")),
        *("--methods", "dob-vcbf-qp, dob-cbf-qp,cbf-qp"),
    )
    assert shown.exit_code == 0, shown.output
    worse, crashed = shown.output.split("worse with dob-cbf-qp:\n")[1].split("crashed:")
    for commands, method in ((worse, "dob-cbf-qp"), (crashed, "cbf-qp")):
        assert commands.count(f"vcbf-drake run {BLIMP} --method {method} ") == 5
        assert "and 2 more, in summary.json" in commands


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--trials", "0"], "--trials"),
        (["--trials", "1", "--vary", "a: !Gauss [0, 1]"], "!Gauss is no distribution"),
        (["--trials", "1", "--vary", "perod: !Uniform [0, 1]"], "variation: perod"),
        (
            ["--trials", "1", "--vary", "period: !Uniform [-2, -1]"],
            "vcbf-drake: variation: period: -",
        ),
        (["--trials", "1", "--vary", "nowhere.yaml"], "nowhere.yaml: No such file"),
        (["--trials", "1", "--methods", "dob-cbf-qp,x"], "method: 'x'"),
        (["--trials", "1", "--override", "{period: 0}"], "override: period: 0"),
        ([], "--trials"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(
    simulated: list[Scenario], tmp_path: Path, arguments: list[str], problem: str
) -> None:
    shown = invoke(*arguments, "--out", str(tmp_path / "out"))
    assert shown.exit_code == 2
    assert shown.output.count("\n") == 1
    assert problem in shown.output
    assert simulated == []
    assert not (tmp_path / "out").exists()


def test_a_real_pair(tmp_path: Path) -> None:
    """The record of a trial is what its command line's scenario comes to."""
    out = tmp_path / "out"
    shown = invoke(
        *("--trials", "1", "--workers", "1", "--vary", RANDOM_GAINS.text),
        *("--override", "{duration: 2.0}", "--out", str(out)),
    )
    assert shown.exit_code == 0, shown.output
    lines = (out / "trials.jsonl").read_text().splitlines()
    first, second = map(json.loads, lines)
    assert first["running_time"] == second["running_time"] == 2.0
    assert first["outcome"] == second["outcome"] == "timeout"
    assert first["min_barrier"] > 0.0 and second["max_abs_slack"] == 0.0
    gains = Variation(RANDOM_GAINS.text)
    trial = Trial(BLIMP, METHODS[0], 0, 0, gains, "{duration: 2.0}")
    assert run_trial(trial) == first
    assert run_trial(replace(trial, method=METHODS[1])) == second
