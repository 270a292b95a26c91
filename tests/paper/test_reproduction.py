"""The reproduction's machinery on tiny settings, and every verdict both ways."""

from __future__ import annotations

import json
import os
from pathlib import Path
import shlex
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples.paper.__main__ import EXPERIMENTS, main
from examples.paper.archive import reproduce
from examples.paper.experiment import (
    FULL,
    QUICK,
    Experiment,
    Plan,
    Settings,
    describe,
    entries,
    failure_rates,
    pairs,
    runs_under,
    share,
    verdicts,
)
from examples.paper.one_obstacle import clearance, estimation
from tests.helpers.runs import shipped_run
from tests.helpers.stand_ins import of_each_vehicle
from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation import load_scenario, simulate
from vcbf_drake.studies import Trial

ROOT = Path(__file__).parents[2]
CAR, BLIMP = "car-avoidance", "blimp-multiple-obstacles"
METHODS = ("dob-cbf-qp", "dob-vcbf-qp")
SIMULATE_FLEET = "vcbf_drake.studies.trial.simulate_fleet"
CLAIMS = [claim for each in EXPERIMENTS.values() for claim in each.claims]


# A tiny reproduction ---------------------------------------------------------------


def tiny(settings: Any, count: int = 6) -> Plan:
    """Two runs and a study on a car that is given a little more time each time."""
    runs = runs_under(METHODS, CAR, "tiny", {"duration": 0.3})
    trials = [
        Trial(CAR, method, index, overrides=f"{{duration: {0.2 + 0.02 * index}}}")
        for index in range(count)
        for method in METHODS
    ]

    def evaluate(archive, records):
        return {
            "runs": entries(archive, runs, "tiny"),
            "inputs": archive.result("tiny/dob-cbf-qp").log["input"].tolist(),
            "methods": {m: describe(records["tiny"], m) for m in METHODS},
            "records": records["tiny"],
        }

    return Plan(evaluate, runs, {"tiny": trials})


TINY = Experiment("tiny", "Tiny", tiny, lambda numbers, archive: iter(()))


def run_tiny(directory: Path, plan: Any = tiny, **options: Any) -> dict[str, Any]:
    experiment = Experiment("tiny", "Tiny", plan, TINY.show)
    return reproduce(directory, [experiment], QUICK, **options)


def results(directory: Path) -> bytes:
    return (directory / "reproduction.json").read_bytes()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny reproduction's directory, to be looked at, only."""
    path = tmp_path_factory.mktemp("undisturbed")
    run_tiny(path)
    return path


@pytest.fixture
def done(undisturbed: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(undisturbed, tmp_path / "done"))


def test_what_is_there_is_not_run_again(tmp_path, monkeypatch):
    seen = []
    data = run_tiny(tmp_path, progress=lambda name, done: seen.append((name, done)))
    assert seen[-1] == ("tiny", 1.0)
    assert [done for _, done in seen] == sorted(done for _, done in seen)
    assert json.loads(results(tmp_path)) == json.loads(json.dumps(data))
    before = results(tmp_path)

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("run again")

    monkeypatch.setattr(SIMULATE_FLEET, of_each_vehicle(refuse))
    monkeypatch.setattr("examples.paper.archive.simulate", refuse)
    run_tiny(tmp_path)
    assert results(tmp_path) == before


def test_results_hold_no_timings_and_no_nan(undisturbed):
    text = results(undisturbed).decode()
    assert "step_cpu_ms" not in text and "real_time_factor" not in text
    assert str(undisturbed) not in text

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(text, parse_constant=refuse)


def test_a_run_cut_short_or_changed_is_run_again(done):
    before = results(done)
    run = done / "runs" / "tiny" / "dob-cbf-qp"
    (run / "summary.json").unlink()
    (run / "log.npz").write_bytes(b"cut short")
    other = done / "runs" / "tiny" / "dob-vcbf-qp" / "scenario.yaml"
    other.write_text(other.read_text().replace("duration: 0.3", "duration: 0.4"))
    run_tiny(done)
    assert results(done) == before


def test_a_directory_is_for_one_reproduction(done):
    before = results(done)
    with pytest.raises(ScenarioError, match="other settings, versions or code"):
        reproduce(done, [TINY], Settings(trials=3))
    settings = done / "settings.json"
    other_code = json.loads(settings.read_text()) | {"code": "0123456789abcdef"}
    settings.write_text(json.dumps(other_code))
    with pytest.raises(ScenarioError, match="other settings, versions or code"):
        run_tiny(done)
    assert results(done) == before


KILLED = """
import sys
from tests.paper.test_reproduction import run_tiny

if __name__ == "__main__":
    run_tiny(sys.argv[1], workers={workers})
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_reproduction_ends_with_the_same_numbers(
    tmp_path, workers, undisturbed
):
    script = tmp_path / "tiny.py"
    script.write_text(KILLED.format(workers=workers))
    killed = tmp_path / "killed"
    records = killed / "studies" / "tiny.jsonl"
    process = subprocess.Popen(
        [sys.executable, str(script), str(killed)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    deadline = time.monotonic() + 900.0
    while not (records.exists() and records.read_bytes().count(b"\n") >= 3):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed / "reproduction.json").exists()
    assert records.read_bytes().count(b"\n") < 12

    run_tiny(killed)
    assert results(killed) == results(undisturbed)


def test_a_crashed_trial_is_recorded_and_does_not_end_the_study(tmp_path, monkeypatch):
    def crash(scenario, step_time):
        if scenario.method == "dob-vcbf-qp" and scenario.duration == 0.2:
            raise RuntimeError("broken")
        return simulate(scenario, step_time=step_time)

    monkeypatch.setattr(SIMULATE_FLEET, of_each_vehicle(crash))
    methods = run_tiny(tmp_path, lambda s: tiny(s, count=2))["tiny"]["methods"]
    assert methods["dob-vcbf-qp"]["outcomes"] == {"error": 1, "timeout": 1}
    assert methods["dob-cbf-qp"]["outcomes"] == {"timeout": 2}


# Experiments -----------------------------------------------------------------------


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_run_and_study_of_an_experiment_loads(name):
    section = EXPERIMENTS[name].plan(QUICK)
    assert EXPERIMENTS[name].key == name and section.cost > 0
    for key, trial in section.runs.items():
        assert key.endswith(f"/{trial.load().method}")
    for trials in section.studies.values():
        assert len({json.dumps(trial.identity) for trial in trials}) == len(trials)
        trials[0].load()


def test_studies_come_to_numbers_in_pairs(tmp_path, monkeypatch):
    """Every study's section, evaluated on made-up outcomes."""

    def made_up(scenario, step_time):
        stops = scenario.method == "dob-cbf-qp" and not scenario.name.endswith("0")
        numbers = summary("infeasible" if stops else "reached")
        numbers["running_time"] = 4.0 if stops else scenario.duration
        return SimpleNamespace(summary=numbers)

    monkeypatch.setattr(SIMULATE_FLEET, of_each_vehicle(made_up))
    few = Settings(True, 2, 3, 2, 1, 1, 1)
    names = ("table_1", "population_blimp", "population_car", "ablation", "knobs")
    data = reproduce(tmp_path, [EXPERIMENTS[name] for name in names], few)

    case = data["table_1"]["case_1"]
    assert (case["T1"]["mean"], case["T2"]["mean"]) == (20.0, 4.0)
    assert (case["comparisons"][0]["worse_trials"], case["errors"]) == ([], [])
    assert (tmp_path / case["file"]).is_file()
    rates = data["population_blimp"]["rates"]
    # Course 0 alone is made to succeed.
    assert rates["dob-cbf-qp fails"] == share(2, 3)
    assert rates["of its failures, dob-vcbf-qp reaches"] == share(2, 2)
    car = data["population_car"]
    assert car["rates"]["dob-cbf-qp fails"]["count"] == 5
    assert car["layouts_with_a_failure"]["dob-cbf-qp"] == share(1, 2)
    variants = data["ablation"]["starts"].values()
    assert [variant["outcomes"] for variant in variants] == [{"reached": 1}] * 6
    rate = data["knobs"]["rate"]["points"]
    assert [point["value"] for point in rate] == [20.0, 50.0, 100.0, 200.0, 500.0]
    assert all(point["dob-cbf-qp"]["trials"] == 1 for point in rate)
    for key in names:
        assert data[key]["command"] == f"python -m examples.paper --quick --only {key}"


def test_a_worse_trial_is_listed_with_its_command(tmp_path, monkeypatch):
    def made_up(scenario, step_time):
        worse = scenario.method == "dob-vcbf-qp"
        numbers = summary("infeasible" if worse else "reached")
        numbers["running_time"] = 4.0 if worse else scenario.duration
        return SimpleNamespace(summary=numbers)

    monkeypatch.setattr(SIMULATE_FLEET, of_each_vehicle(made_up))
    few = Settings(True, 1, 1, 1, 1, 1, 1)
    chosen = [EXPERIMENTS[name] for name in ("table_1", "population_blimp")]
    data = reproduce(tmp_path, chosen, few)
    (worse,) = data["table_1"]["case_1"]["comparisons"][0]["worse_trials"]
    (course,) = data["population_blimp"]["comparisons"][0]["worse_trials"]
    for listed, name in ((worse, BLIMP), (course, "blimp-course-0")):
        words = shlex.split(listed["replay"])
        assert words[:5] == ["vcbf-drake", "run", BLIMP, "--method", "dob-vcbf-qp"]
        assert words[5] == "--override"
        assert load_scenario(BLIMP, words[6]).name == name
    assert worse["index"] == 0


def test_full_settings_are_what_the_paper_needs():
    full = {name: each.plan(FULL) for name, each in EXPERIMENTS.items()}
    for trials in full["table_1"].studies.values():
        assert len(trials) >= 2 * 200
    assert len(full["population_blimp"].studies["population_blimp"]) >= 2 * 600


# Numbers ---------------------------------------------------------------------------


def record(index, method, outcome, **numbers):
    return {"index": index, "method": method, "outcome": outcome, "error": None} | {
        "running_time": 20.0,
        "min_barrier": 0.1,
        "min_volume": 0.1,
        "max_abs_slack": 0.0,
        **numbers,
    }


def test_failure_rates_count_pairs():
    outcomes = [
        ("infeasible", "reached"),
        ("infeasible", "timeout"),
        ("collision", "infeasible"),
        ("reached", "infeasible"),
        ("timeout", "timeout"),
    ]
    records = [
        record(index, method, outcome)
        for index, pair in enumerate(outcomes)
        for method, outcome in zip(METHODS, pair, strict=True)
    ]
    crashed = record(9, "dob-cbf-qp", "error") | {"error": "broken"}
    rates = failure_rates(list(pairs([*records, crashed])))
    counts = {name: (each["count"], each["of"]) for name, each in rates.items()}
    assert counts == {
        "dob-cbf-qp fails": (3, 5),
        "dob-vcbf-qp fails": (2, 5),
        "of its failures, dob-vcbf-qp reaches": (1, 3),
        "of its failures, dob-vcbf-qp stays feasible": (1, 3),
        "of its failures, dob-vcbf-qp fails too": (1, 3),
        "of its successes, dob-vcbf-qp fails": (1, 2),
    }


def test_describe_leaves_crashed_trials_out_of_the_extremes():
    records = [
        record(0, "dob-vcbf-qp", "reached", min_volume=0.3, max_abs_slack=0.2),
        record(1, "dob-vcbf-qp", "reached", min_volume=None, min_barrier=-0.1),
        record(2, "dob-vcbf-qp", "error", min_volume=-9.0) | {"error": "broken"},
        record(0, "dob-cbf-qp", "reached", min_volume=-5.0),
    ]
    numbers = describe(records, "dob-vcbf-qp")
    assert numbers["least_volume"] == 0.3
    assert numbers["least_barrier"] == -0.1
    assert numbers["greatest_slack"] == 0.2
    assert (numbers["with_slack"]["count"], numbers["with_slack"]["of"]) == (1, 2)
    assert numbers["trials"] == 3


def test_clearance_is_what_the_linear_equation_gives():
    """The simulated least h against the equation of the closed form, by method."""
    for method in ("robust-cbf-qp", "cbf-qp"):
        row = clearance(shipped_run("blimp-single-obstacle", method))
        assert row["integrated"] == pytest.approx(row["measured"], abs=2e-3)
        assert row["least"] <= row["integrated"] <= row["greatest"]


def test_clearance_without_contact_has_no_reading():
    overrides = {"method": "cbf-qp", "duration": 0.1, "disturbance": []}
    row = clearance(simulate(load_scenario("blimp-single-obstacle", overrides)))
    assert row["integrated"] is None


def test_estimation_compares_errors_with_both_bounds():
    scenario = load_scenario("blimp-single-obstacle")
    time_ = np.arange(0.0, 3.0, 0.5)
    error = np.array([0.5, 0.1, 0.01, 0.03, 0.02, 0.01])
    log = {
        "time": time_,
        "disturbance": np.outer(np.ones(6), [0.6, 0.0, 0.0]),
        "disturbance_estimate": np.outer(0.6 - error, [1.0, 0.0, 0.0]),
        "error_bound": np.array([1.0, 1.0, 1.0, 0.02, 1.0, 1.0]),
    }
    found = estimation(SimpleNamespace(scenario=scenario, log=log))
    assert found["greatest_disturbance"] == pytest.approx(0.6)
    assert found["greatest_error"] == pytest.approx(0.03)
    assert found["rms_error"] == pytest.approx(np.sqrt(np.mean(error[2:] ** 2)))
    assert found["above_certified_bound"] == pytest.approx(1 / 6)
    # delta1 is about 0.78 and lambda_V = 4: 0.78 exp(-2 t) is below 0.02 from 1.85 s.
    assert found["above_printed_bound"] == pytest.approx(2 / 6)


# Verdicts --------------------------------------------------------------------------


def summary(outcome="reached", **numbers):
    return {
        "outcome": outcome,
        "running_time": 20.0,
        "reached_at": 9.0 if outcome == "reached" else None,
        "infeasible_at": 4.0 if outcome == "infeasible" else None,
        "collided_at": 4.0 if outcome == "collision" else None,
        "min_barrier": -0.01 if outcome == "collision" else 0.1,
        "min_volume": 0.1,
        "max_abs_slack": 0.0,
        "final_distance": 3.0,
        "ticks": 1001,
        "relaxed_ticks": 0,
        "infeasible_ticks": 0,
        "decayed_ticks": 0,
        "failed_ticks": 0,
        "final_status": 1,
        "reasons_against": [],
        **numbers,
    }


def runs(**summaries):
    return {
        name.replace("_", "-"): {"summary": each} for name, each in summaries.items()
    }


def mean(value, half_width=0.5):
    return {"mean": value, "interval": [value - half_width, value + half_width]}


def method(value, least_volume=0.1):
    numbers = mean(value)
    return {
        "mean_running_time": numbers["mean"],
        "interval": numbers["interval"],
        "least_volume": least_volume,
    }


def case(own, other, paper):
    return {
        "command": "c",
        "T1": mean(own),
        "T2": mean(other),
        "paper": paper,
        "methods": {"dob-vcbf-qp": method(own), "dob-cbf-qp": method(other)},
    }


def snapshot(distance, volume):
    return {"time": 2.0, "input_to_nearest_face": distance, "volume": volume}


def rates(with_fails, without_fails, total=100):
    return {
        "dob-vcbf-qp fails": share(with_fails, total),
        "dob-cbf-qp fails": share(without_fails, total),
        "of its failures, dob-vcbf-qp reaches": share(without_fails, without_fails),
    }


ALL_SAFE = {
    "dob_vcbf_qp": summary(min_barrier=0.05),
    "dob_cbf_qp": summary(min_barrier=0.04),
    "wang_xu_dob_cbf_qp": summary(min_barrier=0.2),
    "robust_cbf_qp": summary(min_barrier=0.3),
    "cbf_qp": summary("collision"),
}
GOOD_ESTIMATE = {
    "greatest_error": 0.001,
    "greatest_disturbance": 1.0,
    "above_printed_bound": 0.0,
    "above_certified_bound": 0.0,
}
GAINS = ("k_p=0.2", "k_p=0.4", "k_p=0.6", "k_p=0.8", "k_p=1.0")

# Results in which every claim of the paper holds, everywhere.
IDEAL = {
    "test_1": {
        "command": "c",
        "runs": runs(**ALL_SAFE),
        "steady_winds": [{"runs": runs(**ALL_SAFE)}],
        "estimation": GOOD_ESTIMATE,
    },
    "test_2": {
        "command": "c",
        "runs": runs(dob_vcbf_qp=summary(), dob_cbf_qp=summary("infeasible")),
        "as_printed": runs(dob_vcbf_qp=summary()),
        "estimation": GOOD_ESTIMATE,
        "volumes": {
            "not_lower": {"count": 9, "of": 9, "rate": 1.0},
            "greatest_deficit": 0.0,
            "mean_difference": 0.1,
        },
        "interior": {
            "dob-vcbf-qp": {"count": 9, "of": 9, "rate": 1.0},
            "dob-cbf-qp": {"count": 0, "of": 9, "rate": 0.0},
        },
        "at_snapshots": {
            "dob-vcbf-qp": [snapshot(0.2, 0.2), snapshot(0.2, 0.2)],
            "dob-cbf-qp": [snapshot(0.0, 0.1), snapshot(0.0, -0.02)],
        },
    },
    "test_2_explicit": {
        "observer_rate": 300.0,
        "explicit": {"estimation": GOOD_ESTIMATE},
    },
    "table_1": {
        "command": "c",
        "case_1": case(20.0, 10.0, {"T1": 18.22, "T2": 10.67}),
        "case_2": case(18.0, 8.0, {"T1": 16.21, "T2": 8.67}),
    },
    "population_blimp": {
        "command": "c",
        "rates": rates(0, 100),
        "methods": {"dob-vcbf-qp": method(20.0), "dob-cbf-qp": method(10.0)},
    },
    "car_1": {"command": "c", "runs": runs(**ALL_SAFE)},
    "car_2": {
        "command": "c",
        "runs": {
            gain: runs(
                dob_vcbf_qp=summary(),
                dob_cbf_qp=summary("infeasible" if gain == "k_p=0.2" else "reached"),
            )
            for gain in GAINS
        },
    },
    "population_car": {
        "command": "c",
        "rates": rates(0, 50),
        "layouts_with_a_failure": {
            "dob-vcbf-qp": share(0, 60),
            "dob-cbf-qp": share(50, 60),
        },
        "by_gain": {"0.2": {"rates": rates(0, 100)}},
    },
}


def found(data) -> dict[str, str]:
    return {
        each["claim"]: each["found"] for each in verdicts(EXPERIMENTS.values(), data)
    }


def changed(path: str, value: Any) -> dict[str, Any]:
    """The ideal results with one entry changed; the path is dotted."""
    data = json.loads(json.dumps(IDEAL))  # Nothing is shared.
    *parents, last = path.split("/")
    place: Any = data
    for key in parents:
        place = place[int(key) if isinstance(place, list) else key]
    place[int(last) if isinstance(place, list) else last] = value
    return data


def test_ideal_results_reproduce_every_claim():
    judged = found(IDEAL)
    assert len(judged) == len(CLAIMS)
    assert set(judged.values()) == {"reproduced"}


VCBF, CBF = "runs/dob-vcbf-qp/summary", "runs/dob-cbf-qp/summary"
STEADY = "test_1/steady_winds/0/runs"
NOT, CONDITIONS = "not reproduced", "reproduced under stated conditions"
UNDECIDED = "undecided"

SPOILED = [
    ("Nominal CBF does not", "test_1/runs/cbf-qp/summary", summary(), NOT),
    ("Nominal CBF does not", f"{STEADY}/cbf-qp/summary", summary(), CONDITIONS),
    ("pass the sphere", f"test_1/{VCBF}", summary("timeout"), NOT),
    (
        "pass the sphere",
        f"{STEADY}/robust-cbf-qp/summary",
        summary("timeout"),
        CONDITIONS,
    ),
    ("lowest h", f"test_1/{VCBF}", summary(min_barrier=0.25), NOT),
    ("lowest h", f"test_1/{VCBF}", summary(min_barrier=-0.1), NOT),
    (
        "lowest h",
        f"{STEADY}/dob-vcbf-qp/summary",
        summary(min_barrier=0.25),
        CONDITIONS,
    ),
    ("estimate is accurate", "test_1/estimation/greatest_error", 0.1, NOT),
    (
        "estimate is accurate",
        "test_2_explicit/explicit/estimation/greatest_error",
        0.1,
        CONDITIONS,
    ),
    ("error stays below", "test_1/estimation/above_printed_bound", 0.1, NOT),
    ("stops part of the way", f"test_2/{VCBF}", summary("infeasible"), NOT),
    ("stops part of the way", f"test_2/{CBF}", summary(), NOT),
    ("stops part of the way", "population_blimp/rates", rates(0, 27), CONDITIONS),
    ("slack is zero", f"test_2/{VCBF}", summary(max_abs_slack=1e-9), NOT),
    (
        "slack is zero",
        "test_2/as_printed/dob-vcbf-qp/summary",
        summary(max_abs_slack=1e-3),
        CONDITIONS,
    ),
    ("always the higher", "test_2/volumes/greatest_deficit", 0.1, NOT),
    ("V_v >= 0", f"test_2/{VCBF}", summary(min_volume=-1e-3), NOT),
    (
        "V_v >= 0",
        "population_blimp/methods/dob-vcbf-qp",
        method(20.0, least_volume=-0.02),
        CONDITIONS,
    ),
    (
        "interior point",
        "test_2/at_snapshots/dob-vcbf-qp/0",
        snapshot(0.0, 0.2),
        NOT,
    ),
    (
        "interior point",
        "test_2/interior/dob-vcbf-qp",
        {"count": 1, "of": 9, "rate": 0.11},
        CONDITIONS,
    ),
    (
        "set of DOB-CBF vanishes",
        "test_2/at_snapshots/dob-vcbf-qp/1",
        snapshot(0.0, -0.01),
        NOT,
    ),
    ("from random starts", "table_1/case_1/T2", mean(19.5), UNDECIDED),
    ("from random starts", "table_1/case_1/T2", mean(22.0), NOT),
    (
        "from random starts",
        "population_blimp/methods/dob-cbf-qp",
        method(19.9),
        CONDITIONS,
    ),
    ("random observer gains", "table_1/case_2/T1", mean(8.0), UNDECIDED),
    ("random observer gains", "table_1/case_2/T1", mean(1.0), NOT),
    ("shorter in case 2", "table_1/case_2/T2", mean(10.0), UNDECIDED),
    ("shorter in case 2", "table_1/case_2/T2", mean(19.0), NOT),
    ("more rarely", "population_blimp/rates", rates(25, 27), UNDECIDED),
    ("more rarely", "population_blimp/rates", rates(60, 27), NOT),
    (
        "more rarely",
        "population_car/layouts_with_a_failure/dob-vcbf-qp",
        share(50, 60),
        CONDITIONS,
    ),
    ("avoids the obstacle", f"car_1/{VCBF}", summary("timeout"), NOT),
    (
        "larger distance",
        "car_1/runs/robust-cbf-qp/summary",
        summary(min_barrier=0.01),
        NOT,
    ),
    ("Nominal CBF collides", "car_1/runs/cbf-qp/summary", summary(), NOT),
    (
        "feasible at all five",
        f"car_2/runs/k_p=0.6/{VCBF[5:]}",
        summary("infeasible"),
        NOT,
    ),
    ("feasible at all five", "population_car/rates", rates(1, 50), CONDITIONS),
    ("arrives at all five", f"car_2/runs/k_p=0.2/{VCBF[5:]}", summary("timeout"), NOT),
    ("k_p = 0.2 soon", f"car_2/runs/k_p=0.2/{CBF[5:]}", summary(), NOT),
    (
        "k_p = 0.2 soon",
        "population_car/by_gain/0.2/rates",
        rates(0, 30),
        CONDITIONS,
    ),
]


@pytest.mark.parametrize(("claim", "path", "value", "expected"), SPOILED)
def test_a_spoiled_number_changes_its_verdict(claim, path, value, expected):
    data = changed(path, value)
    judged = {text: each for text, each in found(data).items() if claim in text}
    assert list(judged.values()) == [expected]


def test_equal_times_without_any_spread_need_no_more_trials():
    data = changed("table_1/case_1/T1", mean(20.0, 0.0))
    data["table_1"]["case_2"]["T1"] = mean(20.0, 0.0)
    assert found(data)["Both running times are shorter in case 2 than in case 1"] == NOT


def test_every_claim_is_spoiled_by_some_number():
    spoiled = {
        each["claim"]
        for claim, *_ in SPOILED
        for each in verdicts(EXPERIMENTS.values(), IDEAL)
        if claim in each["claim"]
    }
    assert spoiled == {claim.text for claim in CLAIMS}


def test_verdicts_speak_of_what_is_there_only():
    assert verdicts(EXPERIMENTS.values(), {}) == []
    alone = found({"test_1": IDEAL["test_1"]})
    assert 0 < len(alone) < len(CLAIMS)
    assert all(set(claim.needs) <= set(EXPERIMENTS) for claim in CLAIMS)


# The command -----------------------------------------------------------------------


def test_an_unknown_experiment_is_refused_with_what_is_allowed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--only", "table_2"])
    assert stop.value.code == 2
    assert "no experiment 'table_2'; allowed: test_1" in capsys.readouterr().err
