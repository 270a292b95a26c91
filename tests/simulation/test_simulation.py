"""The shipped scenarios, run: what they show, and that they repeat bit for bit."""

import hashlib
import os
import subprocess
import sys

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator
import pytest

from tests.helpers.runs import shipped_run
from vcbf_drake import load_scenario, simulate
from vcbf_drake.barriers import BarrierSet, SphereObstacle
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp
from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation import (
    check_assumptions,
    load_result,
    make_loop,
    shipped_scenarios,
)
from vcbf_drake.simulation.collision_monitor import CollisionMonitor

DEMO = "blimp-multiple-obstacles"


def demo(method):
    """The demo's run under a method."""
    return shipped_run(DEMO, method)


def test_demo_without_volume_barrier_runs_out_of_inputs_in_flight():
    summary = demo("dob-cbf-qp").summary
    assert summary["outcome"] == "infeasible"
    assert 1.0 < summary["infeasible_at"] < 15.0
    assert summary["final_distance"] > 2.0
    assert any(row.startswith("obstacle") for row in summary["conflict"])


def test_demo_with_volume_barrier_arrives_without_slack():
    result = demo("dob-vcbf-qp")
    assert result.summary["outcome"] == "reached"
    assert result.summary["min_volume"] >= 0.0
    assert result.summary["max_abs_slack"] == 0.0
    assert not result.log["slack"].any()
    assert result.summary["min_barrier"] > 0.0
    assert result.summary["failed_ticks"] == 0


@pytest.mark.slow
def test_demo_outcome_is_the_same_from_starts_of_table_one():
    for start in range(3):  # `make reproduce` flies two hundred.
        rng = np.random.default_rng([2025, start])
        offset = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.2])
        outcomes = []
        for method in ("dob-cbf-qp", "dob-vcbf-qp"):
            scenario = load_scenario(DEMO, {"method": method})
            scenario.initial_state[:3] = offset.tolist()
            summary = simulate(scenario, step_time=False).summary
            outcomes.append((summary["outcome"], summary["max_abs_slack"]))
        assert outcomes == [("infeasible", 0.0), ("reached", 0.0)]


def test_single_obstacle_nominal_collides_and_the_observer_passes_close():
    found = {
        method: shipped_run("blimp-single-obstacle", method).summary
        for method in ("cbf-qp", "robust-cbf-qp", "dob-cbf-qp", "dob-vcbf-qp")
    }
    assert found["cbf-qp"]["outcome"] == "collision"
    for method in ("robust-cbf-qp", "dob-cbf-qp", "dob-vcbf-qp"):
        assert found[method]["outcome"] == "reached"
        assert found[method]["min_barrier"] > 0.0
    proposed, robust = found["dob-vcbf-qp"], found["robust-cbf-qp"]
    assert proposed["min_barrier"] < 0.5 * robust["min_barrier"]


@pytest.mark.parametrize("name", shipped_scenarios())
@pytest.mark.parametrize(("period", "duration"), [(1e-3, 2.0), (1e-2, 4.0)])
def test_estimate_stays_within_its_bound_at_every_tick(name, period, duration):
    scenario = load_scenario(name, {"period": period, "duration": duration})
    assert scenario.observer.step == "implicit"
    log = simulate(scenario, step_time=False).log
    error = np.linalg.norm(log["disturbance"] - log["disturbance_estimate"], axis=1)
    assert np.all(error <= log["error_bound"])
    observer = make_loop(scenario).GetSubsystemByName("filter_observer")
    if period == 1e-3:
        assert observer.error_bound(100.0) < 1e-3


@pytest.mark.parametrize("name", shipped_scenarios())
def test_inputs_stay_inside_their_limits_and_rows_hold(name):
    scenario = load_scenario(name, {"duration": 5.0})
    log = simulate(scenario).log
    margin = log["polytope_b"] - np.einsum(
        "trm,tm->tr", log["polytope_A"], log["input"]
    )
    feasible = log["status"] <= FilterStatus.RELAXED
    assert margin[feasible].min() > -1e-8
    limits = scenario.input_set.input_set()
    assert all(limits.contains(u) for u in log["input"])


def test_log_has_one_row_a_tick_and_the_shapes_it_promises():
    log = demo("dob-vcbf-qp").log
    ticks, rows = 1001, log["polytope_b"].shape[1]
    shapes = {
        "time": (ticks,),
        "state": (ticks, 8),
        "reference": (ticks, 3),
        "input": (ticks, 3),
        "disturbance": (ticks, 3),
        "disturbance_estimate": (ticks, 3),
        "error_bound": (ticks,),
        "slack": (ticks,),
        "volume": (ticks,),
        "status": (ticks,),
        "barriers": (ticks, rows - 6),
        "polytope_A": (ticks, rows, 3),
        "ellipsoid_shape": (ticks, 3, 3),
        "ellipsoid_center": (ticks, 3),
    }
    assert {name: log[name].shape for name in shapes} == shapes
    np.testing.assert_allclose(log["time"], np.arange(ticks) * 0.02, atol=1e-9)


def test_infeasible_run_ends_with_the_empty_set_in_its_log():
    log = demo("dob-cbf-qp").log
    assert log["status"][-1] == FilterStatus.INFEASIBLE
    assert np.isnan(log["ellipsoid_center"][-1]).all()
    assert np.all(log["status"][:-1] < FilterStatus.INFEASIBLE)


def test_summary_has_the_public_keys():
    keys = {
        "scenario", "method", "fidelity", "outcome", "running_time", "reached_at",
        "infeasible_at", "collided_at", "conflict", "min_barrier", "min_volume",
        "volume_measure",
        "max_abs_slack", "slack_active_fraction", "failed_ticks", "final_distance",
        "rows_without_authority", "audit", "guaranteed", "certified_min_barrier",
        "ticks", "final_status", "relaxed_ticks", "infeasible_ticks", "decayed_ticks",
        "backup_ticks",
        "reasons_against",
        "assumptions", "step_cpu_ms", "real_time_factor",
    }  # fmt: skip
    assert set(demo("dob-vcbf-qp").summary) == keys
    assert set(demo("dob-vcbf-qp").summary["step_cpu_ms"]) == {"median", "p99"}


def digest(result):
    arrays = b"".join(result.log[name].tobytes() for name in sorted(result.log))
    return hashlib.sha256(arrays).hexdigest()


REPEAT = """
import sys
from tests.simulation.test_simulation import DEMO, digest
from vcbf_drake import load_scenario, simulate
print(digest(simulate(load_scenario(DEMO, {"duration": 6.0}))))
"""


def test_a_run_repeats_bit_for_bit_here_and_in_another_process():
    scenario = load_scenario(DEMO, {"duration": 6.0})
    first = digest(simulate(scenario))
    assert digest(simulate(scenario)) == first
    output = subprocess.run(
        [sys.executable, "-c", REPEAT],
        env=os.environ | {"PYTHONHASHSEED": "1"},  # Here it is another one.
        capture_output=True,
        text=True,
        check=True,
    )
    assert output.stdout.strip() == first


def test_result_survives_saving_and_loading(tmp_path):
    result = demo("dob-cbf-qp")
    result.save(tmp_path)
    loaded = load_result(tmp_path)
    assert loaded.scenario == result.scenario
    assert loaded.summary == result.summary
    assert digest(loaded) == digest(result)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "log.npz",
        "scenario.yaml",
        "summary.json",
    ]


@pytest.mark.parametrize("policy", ["least_violation", "hold"])
def test_other_policies_fly_on_after_an_infeasible_tick(policy):
    scenario = load_scenario(DEMO, {"method": "dob-cbf-qp", "infeasible": policy})
    result = simulate(scenario)
    stopped = demo("dob-cbf-qp").summary
    assert result.summary["infeasible_at"] == stopped["infeasible_at"]
    assert result.summary["running_time"] == stopped["running_time"]
    assert result.log["time"][-1] > stopped["running_time"]
    limits = scenario.input_set.input_set()
    assert all(limits.contains(u) for u in result.log["input"])


def test_measurement_noise_is_seeded_and_felt():
    noise = {"std": [0.0] * 4 + [1e-3] * 3 + [0.0], "seed": 3}
    overrides = {"noise": noise, "duration": 2.0, "observer": {"step": "saturated"}}
    noisy = simulate(load_scenario(DEMO, overrides))
    assert digest(noisy) == digest(simulate(load_scenario(DEMO, overrides)))
    quiet = simulate(load_scenario(DEMO, {"duration": 2.0}))
    assert digest(noisy) != digest(quiet)
    assert noisy.log["error_bound"][-1] > quiet.log["error_bound"][-1]
    noise["seed"] = 4
    assert digest(noisy) != digest(simulate(load_scenario(DEMO, overrides)))


def test_infeasible_at_the_first_tick_ends_the_run_there():
    start = [0.0, 0.0, 0.0, 0.211, 3.0, 0.6, 0.0, 0.0]
    result = simulate(load_scenario(DEMO, {"initial_state": start}))
    assert result.summary["outcome"] == "infeasible"
    assert result.summary["running_time"] == 0.0
    assert len(result.log["time"]) == 1


def test_a_blimp_abeam_of_a_sphere_is_reported_as_without_authority():
    """Thrust has no part towards a sphere that is abeam, at the blimp's height."""
    start = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    abeam = [{"center": [0.0, 3.0, 0.0], "radius": 0.5}]
    overrides = {"initial_state": start, "obstacles": abeam, "duration": 1.0}
    summary = simulate(load_scenario(DEMO, overrides)).summary
    assert summary["rows_without_authority"] == ["obstacle 1"]


FIGURES = """
import hashlib, sys
from pathlib import Path
from tests.simulation.test_simulation import DEMO
from vcbf_drake import load_scenario, simulate
from vcbf_drake.viz import write_figures
result = simulate(load_scenario(DEMO, {"duration": 3.0}))
for path in write_figures([result], Path(sys.argv[1])):
    print(path.name, hashlib.sha256(path.read_bytes()).hexdigest())
"""


@pytest.mark.slow
def test_figures_repeat_bit_for_bit_in_another_process(tmp_path):
    printed = [
        subprocess.run(
            [sys.executable, "-c", FIGURES, str(tmp_path / seed)],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    ]
    assert printed[0] == printed[1]
    assert "overview.png" in printed[0]


def test_progress_is_reported_to_the_end():
    fractions = []
    simulate(load_scenario(DEMO, {"duration": 1.0}), fractions.append)
    assert fractions[-1] == 1.0
    assert fractions == sorted(fractions)


def test_collision_is_found_between_steps_at_its_exact_time():
    """A point moves along x at 1 m/s towards a sphere whose surface is at x = 0.7."""
    model = ControlAffineModel.from_system(Blimp())
    barriers = BarrierSet(
        model, [SphereObstacle([1.0, 0.0, 0.0], 0.3).barrier([4.0, 3.0])]
    )
    builder = DiagramBuilder()
    velocity = builder.AddSystem(ConstantVectorSource([1.0] + [0.0] * 7))
    motion = builder.AddSystem(Integrator(8))
    monitor = builder.AddNamedSystem("monitor", CollisionMonitor(barriers, 8))
    builder.Connect(velocity.get_output_port(), motion.get_input_port())
    builder.Connect(motion.get_output_port(), monitor.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.get_mutable_context().SetAccuracy(1e-4)
    status = simulator.AdvanceTo(2.0)
    assert "collision" in status.FormatMessage()
    assert status.return_time() == pytest.approx(0.7, abs=1e-6)


def test_assumptions_of_the_demo_hold_and_say_their_numbers():
    found = {a.name: a for a in check_assumptions(load_scenario(DEMO))}
    assert all(a.holds is not False for a in found.values())
    assert found["volume at the start"].numbers["V_v(0)"] == pytest.approx(0.98)
    information = [a.name for a in found.values() if a.holds is None]
    assert "lambda_V >= lambda_r" in information


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ({"observer": {"beta": 0.05, "uncertified": True}}, "observer gain: beta"),
        ({"method": "cbf-qp"}, "no disturbance"),
        ({"initial_state": [0.0] * 4 + [60.0] + [0.0] * 3}, "start inside"),
        ({"noise": {"std": [1e-3] * 8}}, "known start"),
    ],
)
def test_assumptions_that_fail_are_reported_as_such(overrides, name):
    broken = [
        a for a in check_assumptions(load_scenario(DEMO, overrides)) if a.holds is False
    ]
    assert any(a.name.startswith(name) for a in broken)
    assert all(a.consequence for a in broken)


def test_observer_may_run_faster_than_the_controller():
    """The explicit step's chatter grows with the root of its own period (E27)."""
    errors = []
    for period in (0.02, 0.002):
        observer = {"step": "explicit", "period": period}
        scenario = load_scenario(
            "blimp-multiple-obstacles", {"observer": observer, "duration": 2.0}
        )
        log = simulate(scenario).log
        assert len(log["time"]) == 101  # One row a control tick all the same.
        settled = log["time"] > 1.0
        error = log["disturbance"] - log["disturbance_estimate"]
        errors.append(np.linalg.norm(error, axis=1)[settled].max())
    assert errors[0] / errors[1] == pytest.approx(np.sqrt(10.0), rel=0.3)


def test_a_run_may_end_where_it_arrives():
    whole = shipped_run("car-avoidance", "dob-vcbf-qp")
    found = simulate(load_scenario("car-avoidance", {"ends_at_target": True}))
    assert found.summary["outcome"] == whole.summary["outcome"] == "reached"
    assert found.summary["reached_at"] == whole.summary["reached_at"] < 12.5
    ended = found.log["time"][-1]
    assert abs(ended - found.summary["reached_at"]) <= 0.02
    ticks = len(found.log["time"])
    np.testing.assert_array_equal(found.log["state"], whole.log["state"][:ticks])
