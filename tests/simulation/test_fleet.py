"""Several vehicles in one scenario: each its own filter, which sees the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.primitives import LinearSystem
import pytest

from vcbf_drake import (
    Car,
    ControlAffineModel,
    InputLimits,
    PerceivedSpheres,
    Scenario,
    ScenarioError,
    StateFeedback,
    Vehicle,
)
from vcbf_drake.barriers import BarrierSet
from vcbf_drake.simulation import (
    Fleet,
    Result,
    Separation,
    check_assumptions,
    load_fleet,
    load_result,
    load_scenario,
    simulate_fleet,
)
from vcbf_drake.simulation.fleet import loops_of, make_fleet_loop, others_finding
from vcbf_drake.simulation.loading import dump_scenario

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
    log = broken[1].log
    along = log["input"][:, 0] / 2.5 + log["disturbance"][:, 0]
    across = log["state"][:, 2] * log["input"][:, 1]
    most = np.hypot(along, across).max()  # At the ticks; on the way there is some more.
    assert finding["worst"] == pytest.approx(0.1 - most, rel=1e-2)


@dataclass
class Double(Vehicle):
    """A point whose input is its acceleration, held at the most it has."""

    position = (0, 1)
    acceleration: float = 1.0

    def make_plant(self) -> LinearSystem:
        A, B = np.eye(4, k=2), np.eye(4, 2, k=-2)
        return LinearSystem(A, B, np.eye(4), np.zeros((4, 2)))

    def make_controller(self, target: Any) -> Any:
        def law(x: Any) -> Any:
            ahead = target - x[:2] - 0.3 * x[2:]
            angle = np.arctan2(ahead[1], ahead[0]) + 0.7 * np.sin(90.0 * x[0])
            return self.acceleration * np.array([np.cos(angle), np.sin(angle)])

        return StateFeedback(law, 4, 2)


@dataclass
class Single(Vehicle):
    """A point whose input is its velocity."""

    position = (0, 1)

    def make_plant(self) -> LinearSystem:
        return LinearSystem(np.zeros((2, 2)), np.eye(2), np.eye(2), np.zeros((2, 2)))

    def make_controller(self, target: Any) -> Any:
        return StateFeedback(lambda x: 2.0 * (target - x), 2, 2)


def meets(other: Scenario, bound: float) -> Result:
    """The run of a strong point that stands in another vehicle's way."""
    own = Scenario(
        name="own",
        vehicle=Double(0.0),
        method="cbf-qp",
        input_set=InputLimits([-8.0, -8.0], [8.0, 8.0]),
        separation=Separation(distance=0.5, gains=[4.0, 3.0], acceleration=bound),
        initial_state=[0.0, 0.0, 0.0, 0.0],
        target=[0.0, 0.0],
        duration=4.0,
    )
    fleet = Fleet(name="meeting", vehicles=[own, other])
    return simulate_fleet(fleet, step_time=False)[0]


@pytest.mark.parametrize("y", [-0.7, 0.1, 0.9])
def test_no_motion_within_the_bound_brings_another_nearer(y: float) -> None:
    found = meets(
        Scenario(
            name="ram",
            vehicle=Double(1.0),
            method="cbf-qp",
            input_set=InputLimits([-1.0, -1.0], [1.0, 1.0]),
            separation=Separation(distance=1e-3, gains=[400.0, 1e4]),
            initial_state=[2.0, y, 0.0, 0.0],
            target=[0.0, 0.0],
            duration=4.0,
        ),
        bound=1.0,
    )
    assert found.summary["guaranteed"]
    # Its input, held, is the acceleration: the whole bound is used, and found.
    worst = found.summary["audit"]["other vehicles"]["worst"]
    assert worst == pytest.approx(0.0, abs=1e-6)
    # It comes near, into what is kept for the bound, 1 / 3 m, but no nearer.
    assert 0.5 <= found.summary["least_separation"] < 1.0


def test_a_vehicle_whose_input_is_its_velocity_accelerates_beyond_any_bound() -> None:
    found = meets(
        Scenario(
            name="single",
            vehicle=Single(),
            method="cbf-qp",
            input_set=InputLimits([-2.0, -2.0], [2.0, 2.0]),
            separation=Separation(distance=0.01, gains=[1.0]),
            initial_state=[4.0, 0.0],
            target=[0.0, 0.0],
            duration=4.0,
        ),
        bound=1.0,
    )
    told, period = found.log["obstacles"][:, :4], 0.02
    moved = np.diff(told[:, :2], axis=0) / period
    assert moved[0] == pytest.approx([-2.0, 0.0])
    # Once it moves, it is told how fast: its input of the period before.
    np.testing.assert_allclose(told[1:, 2:], moved, atol=1e-6)
    # Of the start nobody knew: it strays by 2 m/s times the period, a T^2 / 2.
    worst = found.summary["audit"]["other vehicles"]["worst"]
    assert worst == pytest.approx(1.0 - 2.0 * 2.0 / period)
    assert found.summary["reasons_against"] == ["audit: other vehicles"]
    assert found.summary["least_separation"] >= 0.5


def test_a_motion_that_only_its_places_show_is_found() -> None:
    """A turn of a whole circle a tick: every told velocity is the same."""
    own = load_fleet(CROSSING, {"separation": {"acceleration": 1.0}}).vehicles[0]
    told = np.zeros((4, 6))
    told[:, 0], told[:, 3] = [0.0, 0.0, 0.001, 0.001], 0.3
    told[:, 1] = 0.3 * 0.02 * np.arange(4)
    log = {"time": 0.02 * np.arange(4), "obstacles": told}
    found = others_finding(log, own)
    assert found["worst"] == pytest.approx(1.0 - 2.0 * 0.001 / 0.02**2)
    assert found["worst_at"] == pytest.approx(0.04)
    single = others_finding({name: each[:1] for name, each in log.items()}, own)
    assert single["held"] is True


@pytest.mark.parametrize(
    ("change", "hypothesis"),
    [
        ({"infeasible": "backup"}, "declared obstacles"),
        ({"method": "backup"}, "rows of the whole way"),
    ],
)
def test_no_plan_among_others_is_guaranteed(
    change: dict[str, Any], hypothesis: str
) -> None:
    far = {"1": {"initial_state": [30.0, 9.0, 0.0, 1.5708], "target": [30.0, 9.0]}}
    apart = {"separation": {"acceleration": 6.0}, "vehicles": far}
    found = crossing(**{"method": "dob-cbf-qp", "duration": 0.2, **apart, **change})
    for each in found:
        assert each.summary["reasons_against"] == [f"hypothesis: {hypothesis}"]
        assert not each.summary.get("guaranteed_feasible", False)


def test_rows_and_systems_have_the_vehicles_names() -> None:
    fleet = load_fleet(CROSSING, {"vehicles": {"0": {"name": "seen_by_northbound"}}})
    diagram = make_fleet_loop(fleet)
    names = [
        loop.GetSubsystemByName("filter").barrier_set.names[-1]
        for loop in loops_of(diagram, fleet)
    ]
    assert names == ["vehicle northbound", "vehicle seen_by_northbound"]


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
    path.write_text(dump_scenario(fleet))
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
        ("{between_ticks: certified}", "none where there are other vehicles"),
        ("{vehicles: {2: {}}}", "2; it must be an entry of the list, 0 to 1"),
        ("{vehicles: 3}", "3; it must be a list of Scenarios"),
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


@pytest.mark.parametrize(
    "entry",
    ["perod: 1", "separation: {distnce: 1}", "duration: -6", "input_set: {lower: [1]}"],
)
def test_a_wrong_entry_of_all_vehicles_is_found_in_its_own_line(
    entry: str, tmp_path: Path
) -> None:
    own = "{initial_state: [0, 0, 0, 0], target: [5, 0]}"
    path = tmp_path / "fleet.yaml"
    path.write_text(f"fleet:\n  vehicle: !Car {{}}\n  {entry}\n  vehicles: [{own}]\n")
    with pytest.raises(ScenarioError) as refused:
        load_fleet(path)
    assert str(refused.value).startswith(f"{path}:3: vehicles[0].")


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ("input_weights: [1.0]", "2: vehicles[0].input_weights: [1.0]; it must be 2 p"),
        ("observer: {beta: 0.001}", "2: vehicles[0].observer: gains alpha, beta, "),
    ],
)
def test_a_value_that_only_the_loop_refuses_is_found_in_its_line(
    entry: str, problem: str, tmp_path: Path
) -> None:
    path = tmp_path / "fleet.yaml"
    text = CROSSING.read_text().replace("crossing:", f"crossing:\n  {entry}", 1)
    path.write_text(text[text.index("crossing:") :])
    fleet = load_fleet(path)
    with pytest.raises(ScenarioError) as refused:
        check_assumptions(fleet)
    assert str(refused.value).startswith(f"{path}:{problem}")


def test_where_one_vehicle_is_needed_several_are_refused() -> None:
    message = r"2 vehicles \(eastbound, northbound\), where one is needed"
    with pytest.raises(ScenarioError, match=message):
        load_scenario(CROSSING)
