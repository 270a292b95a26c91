import json
import pickle

import pytest
from typer.testing import CliRunner

from vcbf_drake import load_scenario
from vcbf_drake.cli import app
from vcbf_drake.simulation import dump_scenario, validate
from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.sections import MeasurementNoise
from vcbf_drake.studies import run_trial
from vcbf_drake.studies.faults import (
    FAULTS,
    campaign_markdown,
    fault_trials,
    headline,
    summarise_faults,
)

CAR = "car-avoidance"
SCENARIOS = ("blimp-multiple-obstacles", CAR)


def record(**changes):
    return {
        "outcome": "reached", "ticks": 100, "relaxed_ticks": 0, "infeasible_ticks": 0,
        "failed_ticks": 0, "final_status": 0, "min_barrier": 0.2, "error": None,
        "reasons_against": [],
    } | changes  # fmt: skip


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_draw_is_a_valid_scenario_that_breaks_something(scenario, fault):
    base = load_scenario(scenario)
    drawn = load_scenario(scenario, fault.draw(base, 0, 3))
    validate(drawn)
    broken = drawn.faults != Faults() or drawn.noise != MeasurementNoise()
    assert broken == (fault.name != "none")
    assert drawn.initial_state != base.initial_state
    assert fault.draw(base, 0, 3) == fault.draw(base, 0, 3)
    assert fault.draw(base, 0, 3) != fault.draw(base, 0, 4)


def test_every_kind_shares_its_draws_and_every_trial_pickles():
    kinds = fault_trials([CAR], 2)
    assert len(kinds) == len(FAULTS) * 4
    for (_, fault, method, fidelity), trials in kinds.items():
        assert [trial.index for trial in trials] == [0, 1]
        assert {trial.variation.name for trial in trials} == {fault}
        first = pickle.loads(pickle.dumps(trials[0])).load()
        assert (first.method, first.fidelity) == (method, fidelity)
        assert first.infeasible == "least_violation"
    starts = {tuple(trials[1].load().initial_state) for trials in kinds.values()}
    assert len(starts) == 1


def test_a_trial_records_what_the_table_needs():
    (trial,) = fault_trials([CAR], 1)[(CAR, "solver", "dob-vcbf-qp", "corrected")]
    found = run_trial(trial)
    assert found["error"] is None and found["failed_ticks"] > 0
    assert "hypothesis: solvers at every tick" in found["reasons_against"]
    summary = summarise_faults([found])
    assert summary["failed_share"] == found["failed_ticks"] / found["ticks"]
    assert summary["runs_with_bad_ticks"] == 1 and summary["inside_assumptions"] == 0


def test_a_run_recovers_when_it_ends_well():
    records = [
        record(infeasible_ticks=10),
        record(infeasible_ticks=10, final_status=3),
        record(failed_ticks=5, outcome="collision"),
        record(failed_ticks=5),
        record(),
    ]
    summary = summarise_faults(records)
    assert summary["runs_with_bad_ticks"] == 4 and summary["recovered"] == 2
    assert summary["infeasible_share"] == pytest.approx(0.04)
    assert summary["collisions"] == 1 and summary["guaranteed"] == 5


def test_inside_the_assumptions_a_broken_promise_is_counted():
    records = [
        record(),
        record(reasons_against=["audit: chain"]),
        record(reasons_against=["audit: feasible", "audit: chain"]),
        record(reasons_against=["hypothesis: known start", "audit: chain"]),
    ]
    summary = summarise_faults(records)
    assert summary["inside_assumptions"] == 2 and summary["broken_inside"] == 1
    assert summary["guaranteed"] == 1


def test_a_run_that_crashed_is_an_error_and_nothing_else():
    crashed = dict.fromkeys(record()) | {"outcome": "error", "error": "ValueError: no"}
    summary = summarise_faults([crashed, record()])
    assert summary["errors"] == 1 and summary["reached"] == 1
    assert summarise_faults([crashed])["least_barrier"] is None


def test_the_page_names_command_and_trials_and_has_a_row_a_kind():
    kinds = fault_trials([CAR], 1)
    summaries = {kind: summarise_faults([record()]) for kind in kinds}
    page = campaign_markdown(summaries, "vcbf-drake faults car-avoidance")
    assert "`vcbf-drake faults car-avoidance`: 1 trial of each" in page
    assert "](" not in page  # Nothing lies beside a user's page.
    for kind in kinds:
        assert f"| {' | '.join(kind[1:])} | 1 | 0 |" in page
    guaranteed = f"{len(kinds) - 4} runs under a fault passed as guaranteed."
    assert guaranteed in headline(summaries)
    (one,) = [kind for kind in kinds if kind[1:] == ("gust", "dob-cbf-qp", "paper")]
    assert headline({one: summaries[one]}) == [
        "1 run, 0 ended in an error.",
        "0 runs had an input that was not finite or outside its limits.",
        "1 run stayed inside the assumptions; 0 of them broke a promise.",
        "1 run under a fault passed as guaranteed.",
    ]


def test_the_command_ends_with_a_table(tmp_path):
    brief = tmp_path / "brief.yaml"
    brief.write_text(dump_scenario(load_scenario(CAR, {"duration": 0.5})))
    arguments = ["faults", str(brief), "--trials", "1", "--workers", "1", "--out"]
    done = CliRunner().invoke(app, [*arguments, str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "0 runs had an input that was not finite" in done.output
    assert "0 of them broke a promise" in done.output
    rows = json.loads((tmp_path / "summary.json").read_text())
    assert len(rows) == 4 * len(FAULTS)
    assert (tmp_path / "faults.md").exists()


def test_an_unknown_scenario_is_refused_before_anything_runs(tmp_path):
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["faults", CAR, "nope", "--out", str(out)])
    assert done.exit_code == 2
    assert done.output.startswith("vcbf-drake: nope: neither a file nor")
    assert not out.exists()
