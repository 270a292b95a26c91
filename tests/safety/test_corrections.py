"""Each correction is a choice of its own, from the scenario to the filter's tick."""

from __future__ import annotations

import pytest

from vcbf_drake.safety import FIDELITIES, Corrections
from vcbf_drake.simulation import load_scenario, make_loop, simulate
from vcbf_drake.simulation.loading import dump_scenario

CAR = "car-avoidance"


def with_only(correction: str):
    return load_scenario(CAR, {"fidelity": {correction: True}})


def test_fidelity_is_all_of_them_or_none():
    assert FIDELITIES["corrected"] == Corrections(True, True, True)
    assert FIDELITIES["paper"] == Corrections(False, False, False)
    for fidelity, corrections in FIDELITIES.items():
        scenario = load_scenario(CAR, {"fidelity": fidelity})
        assert scenario.corrections == corrections


def test_corrections_stand_in_for_those_of_the_fidelity(tmp_path):
    scenario = with_only("exact_slack")
    assert scenario.corrections == Corrections(exact_slack=True)
    path = tmp_path / "scenario.yaml"
    path.write_text(dump_scenario(scenario))
    assert load_scenario(path).corrections == Corrections(exact_slack=True)


def test_error_floor_is_the_observers_floor_and_the_holds_margin():
    for correction in ("error_floor", "total_derivative"):
        loop = make_loop(with_only(correction))
        safety_filter = loop.GetSubsystemByName("filter")
        observer = loop.GetSubsystemByName("filter_observer")
        context = loop.CreateDefaultContext()
        known = safety_filter.knowledge(safety_filter.GetMyContextFromRoot(context))
        margin = known.bound - observer.error_bound(0.0)
        if correction == "error_floor":
            assert observer.error_bound(1e3) > 0.0
            period = observer.period
            assert margin == pytest.approx(observer.bounds.delta2 * period)
        else:
            assert observer.error_bound(1e3) == pytest.approx(0.0, abs=1e-12)
            assert margin == pytest.approx(0.0, abs=1e-12)


def test_every_correction_changes_the_run():
    """Against the paper's row the inputs differ, as do the reported choices."""

    def inputs(overrides):
        short = {"duration": 3.5, "volume": {"threshold": 0.1}}
        result = simulate(load_scenario("car-sensitivity", short | overrides))
        return result.summary["fidelity"], result.log["input"]

    name, paper = inputs({"fidelity": "paper"})
    assert name == "paper"
    for correction in vars(Corrections()):
        name, corrected = inputs({"fidelity": {correction: True}})
        assert name == "custom"
        assert abs(corrected - paper[: len(corrected)]).max() > 1e-6, correction
