"""Several vehicles in one scenario: each its own filter, which sees the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vcbf_drake import Car, ControlAffineModel, PerceivedSpheres, ScenarioError
from vcbf_drake.barriers import BarrierSet
from vcbf_drake.simulation import (
    Fleet,
    Result,
    check_assumptions,
    load_fleet,
    load_result,
    load_scenario,
    simulate_fleet,
)
from vcbf_drake.simulation.loading import dump_fleet

CROSSING = Path(__file__).parents[2] / "examples" / "two_vehicles.yaml"
DISTANCE, LENGTH = 0.8, 0.42  # Between the cars; of a car [m].


def crossing(**changes: Any) -> list[Result]:
    brief = {"duration": 6.0, **changes}
    return simulate_fleet(load_fleet(CROSSING, brief), step_time=False)


@pytest.fixture(scope="module")
def apart() -> list[Result]:
    return crossing()


def places(result: Result) -> Any:
    return result.log["state"][:, :2]


def test_each_keeps_its_distance_on_the_way_to_its_target(apart: list[Result]) -> None:
    away = np.linalg.norm(places(apart[0]) - places(apart[1]), axis=1)
    assert DISTANCE <= away.min() < 1.1 * DISTANCE  # It is asked for.
    for result in apart:
        least = result.summary["least_separation"]
        assert DISTANCE <= least <= away.min()
        assert least == pytest.approx(away.min(), abs=1e-3)
        assert result.summary["min_barrier"] <= least - DISTANCE + 1e-12
        assert result.summary["outcome"] in ("reached", "timeout")
        assert result.summary["infeasible_ticks"] == 0


def test_without_the_separation_they_would_collide() -> None:
    found = crossing(separation={"distance": 0.01}, method="cbf-qp", duration=4.0)
    assert found[0].summary["least_separation"] < LENGTH


def test_a_run_ends_for_all_where_two_meet() -> None:
    found = crossing(method="cbf-qp")
    assert [each.summary["outcome"] for each in found] == ["collision", "collision"]
    first, second = (each.summary["collided_at"] for each in found)
    assert first == second < 6.0
    assert len(found[0].log["time"]) == len(found[1].log["time"])


def test_a_run_ends_for_all_where_one_meets_an_obstacle() -> None:
    wall = [{"center": [4.0, 0.0], "radius": 0.5}]
    found = crossing(
        method="cbf-qp",
        disturbance=[{"_tag": "!Constant", "value": [0.0]}],
        vehicles={
            "0": {
                "obstacles": wall,
                "disturbance": [{"_tag": "!Constant", "value": [3.0]}],
            },
            "1": {"initial_state": [9.0, 9.0, 0.0, 1.5708], "target": [9.0, 15.0]},
        },
    )
    assert [each.summary["outcome"] for each in found] == ["collision", "timeout"]
    end = found[1].summary["running_time"]
    assert found[0].summary["collided_at"] == pytest.approx(end, abs=0.01)
    assert end < 6.0


def test_each_is_told_where_the_other_is_and_how_fast(apart: list[Result]) -> None:
    for own, other in ((0, 1), (1, 0)):
        told = apart[own].log["obstacles"]
        np.testing.assert_array_equal(told[:, :2], places(apart[other]))
        speed, heading = apart[other].log["state"][:, 2:].T
        velocity = np.column_stack([speed * np.cos(heading), speed * np.sin(heading)])
        np.testing.assert_allclose(told[:, 2:4], velocity, atol=1e-8)
        assert (told[:, 4] == DISTANCE).all()
        assert (told[:, 5] == 1.0).all()


def test_the_margin_is_what_a_bounded_acceleration_takes_off_the_row() -> None:
    gains, bound = [4.0, 3.0], 1.5
    model = ControlAffineModel.from_system(Car())
    generator = np.random.default_rng(0)
    exact = PerceivedSpheres(1, 2)
    kept = PerceivedSpheres(1, 2, margin=bound / gains[-1])
    rows = [
        BarrierSet(model, each.barriers(gains, position=(0, 1)))
        for each in (exact, kept)
    ]
    for _ in range(20):
        x, center = generator.standard_normal(4), 4.0 + generator.random(2)
        seen = exact.pack([center], [generator.standard_normal(2)], [DISTANCE])
        plain, allowing = (each.rows(x, 0.3, seen) for each in rows)
        np.testing.assert_allclose(allowing.A, plain.A, atol=1e-12)
        np.testing.assert_allclose(allowing.b, plain.b - bound, atol=1e-12)


def test_nothing_is_guaranteed_of_others_that_may_accelerate(
    apart: list[Result],
) -> None:
    assert "hypothesis: other vehicles" in apart[0].summary["reasons_against"]
    assert apart[0].summary["certified_min_barrier"] is None
    found = check_assumptions(load_fleet(CROSSING))
    named = [each for each in found if each.name.endswith(": other vehicles")]
    assert [each.holds for each in named] == [False, False]


def test_a_bound_on_their_acceleration_is_audited() -> None:
    method = "dob-cbf-qp"
    bounded = crossing(method=method, separation={"acceleration": 3.0})
    assert all(each.summary["guaranteed"] for each in bounded)
    broken = crossing(method=method, separation={"acceleration": 0.1}, duration=2.0)
    assert broken[0].summary["reasons_against"] == ["audit: other vehicles"]
    finding = broken[0].summary["audit"]["other vehicles"]
    velocity = broken[0].log["obstacles"][:, 2:4]
    most = np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / 0.02
    assert finding["worst"] == pytest.approx(0.1 - most)


def test_three_are_told_of_two_each() -> None:
    third = load_scenario(CROSSING.parent / "yard" / "yard.yaml", {"duration": 1.0})
    fleet = load_fleet(CROSSING, {"duration": 1.0})
    third.separation, third.name = fleet.vehicles[0].separation, "far"
    third.initial_state = [-9.0, -9.0, 0.0, 0.0]
    found = simulate_fleet(
        Fleet(name="three", vehicles=[*fleet.vehicles, third]), step_time=False
    )
    assert [each.log["obstacles"].shape[1] for each in found] == 3 * [2 * 6]


def test_a_fleet_is_written_and_read_again(tmp_path: Path) -> None:
    fleet = load_fleet(CROSSING)
    path = tmp_path / "again.yaml"
    path.write_text(dump_fleet(fleet))
    assert load_fleet(path) == fleet
    (tmp_path / "fleet.py").write_text(
        "from vcbf_drake.simulation import load_fleet\n\n\ndef scenario():\n"
        f"    return load_fleet({str(path)!r})\n"
    )
    assert load_fleet(tmp_path / "fleet.py", {"duration": 14.0}) == fleet


def test_what_stands_beside_the_list_is_every_vehicles() -> None:
    fleet = load_fleet(CROSSING, "{vehicles: {1: {target: [3, 4]}}}")
    east, north = fleet.vehicles
    assert east.obstacles == north.obstacles
    assert (east.vehicle.mass, north.vehicle.mass) == (2.0, 2.5)
    assert (east.target, north.target) == ([6.0, 0.0], [3.0, 4.0])
    assert load_fleet("car-avoidance").vehicles == [load_scenario("car-avoidance")]


def test_a_result_of_one_is_read_again(apart: list[Result], tmp_path: Path) -> None:
    apart[1].save(tmp_path)
    assert load_result(tmp_path).summary["least_separation"] >= DISTANCE


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("{vehicles: {1: {name: eastbound}}}", "a name that no other vehicle has"),
        ("{vehicles: {1: {period: 0.01}}}", "they share the time"),
        ("{vehicles: {0: {separation: {distance: 0}}}}", "above 0 where there are"),
        ("{vehicles: {1: {initial_state: [0.5, 0, 0, 0]}}}", "it is 0.5 m away"),
        ("{faults: {sight: 2}}", "0 where there are other vehicles"),
        ("{vehicles: {2: {}}}", "they are 0 to 1"),
        ("{vehicles: 3}", "expected a list"),
        ("{vehicles: []}", "one at least"),
        ("{separation: {acceleration: 1, form: squared}}", "0 but for two gains"),
        ("{vehicles: {1: {target: [3]}}}", "2 numbers"),
    ],
)
def test_a_wrong_fleet_is_refused_in_one_line(change: str, problem: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        load_fleet(CROSSING, change)
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value)


def test_where_one_vehicle_is_needed_several_are_refused() -> None:
    message = r"2 vehicles \(eastbound, northbound\), where one is needed"
    with pytest.raises(ScenarioError, match=message):
        load_scenario(CROSSING)
