"""Runs that never run out of inputs, and what they say where that is not certain."""

import numpy as np
import pytest

from tests.helpers.runs import shipped_run
from vcbf_drake import load_scenario, simulate
from vcbf_drake.errors import VcbfError
from vcbf_drake.simulation import check_assumptions

# One car towards one disc, by a method whose gains its brakes are too weak for.
WEAK_BRAKES = {
    "method": "dob-cbf-qp",
    "infeasible": "backup",
    "duration": 6.0,
    "target": [6.0, 0.0],
    "input_set": {"lower": [-0.5, -0.3], "upper": [0.5, 0.3]},
    "obstacles": [{"center": [3.0, 0.02], "radius": 0.5}],
    "barrier": {"form": "distance", "gains": [10.0, 20.0]},
    "vehicle": {"controller": {"approach_gain": 1.0}},
}


def run(**changes):
    scenario = load_scenario("car-sensitivity", WEAK_BRAKES | changes)
    return simulate(scenario, step_time=False)


def by_name(assumptions):
    return {each.name: each.holds for each in assumptions}


def test_where_the_rows_have_no_input_the_backup_has_one():
    lost = run(infeasible="least_violation")
    assert lost.summary["infeasible_ticks"] > 0
    assert lost.summary["outcome"] == "collision"
    assert "guaranteed_feasible" not in lost.summary
    kept = run()
    assert kept.summary["outcome"] != "collision"
    assert kept.summary["min_barrier"] >= 0.0
    assert kept.summary["backup_ticks"] > 0
    assert kept.summary["guaranteed_feasible"]
    assert kept.summary["reasons_against_feasible"] == []
    assert np.all(kept.log["backup"][:, 1] == 1.0)
    acted = kept.log["backup"][:, 0] > 0.0
    assert np.sum(acted) == kept.summary["backup_ticks"]


def test_a_run_that_needs_no_backup_is_as_it_was():
    plain = shipped_run("car-avoidance", "dob-vcbf-qp")
    gated = simulate(
        load_scenario("car-avoidance", {"infeasible": "backup"}), step_time=False
    )
    assert gated.summary["backup_ticks"] == 0
    assert gated.summary["guaranteed_feasible"] and gated.summary["guaranteed"]
    np.testing.assert_array_equal(plain.log["input"], gated.log["input"])


def test_a_start_from_which_no_brake_helps_is_told_before_the_run(caplog):
    changes = {"initial_state": [2.0, 0.0, 1.5, 0.0]}
    scenario = load_scenario("car-sensitivity", WEAK_BRAKES | changes)
    assert by_name(check_assumptions(scenario))["certified plan"] is False
    found = run(**changes, warn=True).summary
    assert "certified plan does not hold" in caplog.text
    assert not found["guaranteed_feasible"]
    assert "hypothesis: certified plan" in found["reasons_against_feasible"]


@pytest.mark.parametrize(
    ("broken", "before", "reason"),
    [
        ({"faults": {"actuator_limit": 0.3}}, "held input", "hypothesis: held input"),
        (
            {"faults": {"mass": 2.0}},
            "plant as modelled",
            "hypothesis: plant as modelled",
        ),
        (
            {"faults": {"disturbance": 3.0}},
            "disturbance as declared",
            "audit: disturbance",
        ),
        (
            {"noise": {"std": [0.01, 0.01, 0.01, 0.0]}},
            "exact state",
            "hypothesis: exact state",
        ),
    ],
)
def test_a_premise_that_fails_is_named_before_anything_fails(broken, before, reason):
    found = run(**broken).summary
    assert not found["guaranteed_feasible"]
    assert reason in found["reasons_against_feasible"]
    scenario = load_scenario("car-sensitivity", WEAK_BRAKES | broken)
    assert by_name(check_assumptions(scenario))[before] is False


# A disc whose way leads over a car that waits.
RUN_OVER = {
    "duration": 0.5,
    "target": [0.5, 0.0],
    "obstacles": [{"center": [8.0, 0.0], "radius": 0.5, "velocity": [-0.8, 0.0]}],
}


@pytest.mark.parametrize("obstacle", [{"center": [3.0, 50.0]}, *RUN_OVER["obstacles"]])
def test_rows_along_the_way_of_a_law_guarantee_nothing(obstacle):
    """They look at instants, of a way without a disturbance, 6 s ahead."""
    obstacles = [{"radius": 0.5} | obstacle]
    changes = {"method": "backup", "infeasible": "least_violation"}
    changes |= RUN_OVER | {"obstacles": obstacles}
    scenario = load_scenario("car-sensitivity", WEAK_BRAKES | changes)
    assert by_name(check_assumptions(scenario))["rows of the whole way"] is False
    summary = run(**changes).summary
    assert summary["reasons_against"] == ["hypothesis: rows of the whole way"]


def test_a_car_in_the_way_of_a_disc_has_no_certified_plan():
    scenario = load_scenario("car-sensitivity", WEAK_BRAKES | RUN_OVER)
    assert by_name(check_assumptions(scenario))["certified plan"] is False
    assert not run(**RUN_OVER).summary["guaranteed_feasible"]


def test_brakes_weaker_than_the_wind_are_refused_in_one_line():
    limits = {"lower": [-0.2, -0.3], "upper": [0.2, 0.3]}
    with pytest.raises(VcbfError, match=r"no backup manoeuvre of .* is safe"):
        run(input_set=limits)


def test_a_wind_beyond_its_bound_is_refuted_by_the_observer_first():
    """The brakes give 0.25 m/s^2, the wind 0.45 where 0.15 was declared."""
    found = run(faults={"disturbance": 3.0})
    plans = found.log["backup"][:, 1]
    assert plans[0] == 1.0 and np.any(plans == 0.0)
    first = found.log["time"][int(np.argmin(plans))]
    collided = found.summary["collided_at"]
    assert collided is None or first < collided
