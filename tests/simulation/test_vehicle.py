"""A robot of one's own: a scenario from a Python file, and what follows from one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import re
from typing import Any

import numpy as np
from pydrake.examples import PendulumPlant
from pydrake.geometry import Sphere
from pydrake.math import cos, sin
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
import pytest

from vcbf_drake import InputLimits, Scenario, ScenarioError, load_scenario, simulate
from vcbf_drake.barriers import StateLimit
from vcbf_drake.errors import InvalidValueError, UserCodeError
from vcbf_drake.plants import BlimpVehicle, CarVehicle, StateFeedback, Vehicle
from vcbf_drake.plants.vehicle import channels_of
from vcbf_drake.simulation import check_assumptions, dump_scenario
from vcbf_drake.simulation.loading import parse_scenario
from vcbf_drake.viz import write_figures, write_replay
from vcbf_drake.viz.runs import barrier_unit

EXAMPLES = Path(__file__).parents[2] / "examples"
OWN = EXAMPLES / "own_robot.py"


def refusal(path: Path, overrides: str | None = None) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@dataclass
class Pendulum(Vehicle):
    """Drake's own plant, its ports called as Drake calls them."""

    gain: float = 2.0
    position = (0,)

    def make_plant(self) -> PendulumPlant:
        return PendulumPlant()

    def make_controller(self, target: Any) -> StateFeedback:
        return StateFeedback(lambda x: self.gain * (target - x[:1]) - x[1:], 2, 1)


def test_a_stock_plant_keeps_its_range(tmp_path: Path) -> None:
    scenario = Scenario(
        vehicle=Pendulum(),
        input_set=InputLimits([-8.0], [8.0]),
        obstacles=[StateLimit("x0", upper=0.2, gains=[4.0, 4.0])],
        initial_state=[0.0, 0.0],
        target=[2.0],
        duration=3.0,
    )
    result = simulate(scenario, step_time=False)
    assert result.summary["guaranteed"]
    # It settles a little below the range's end; gravity takes it where it may go.
    assert 0.1 < result.log["state"][-1, 0] < 0.2
    # A single input has a feasible set in the plane too, and h no unit that is known.
    names = [path.name for path in write_figures([result], tmp_path)]
    assert "feasible_sets.png" in names
    assert barrier_unit(scenario) == ""
    assert barrier_unit(load_scenario("car-avoidance")) == "m²"
    assert barrier_unit(load_scenario(EXAMPLES / "arm.yaml")) == ""


def test_example_has_at_most_60_lines() -> None:
    assert len(OWN.read_text().splitlines()) <= 60


def test_robot_from_a_python_file_reaches_its_target_with_every_promise_kept() -> None:
    result = simulate(load_scenario(OWN, {"duration": 8.0}), step_time=False)
    assert result.summary["scenario"] == "own_robot"
    assert result.summary["outcome"] == "reached"
    assert result.summary["guaranteed"]
    # The distance to the posts, by hand.
    posts = np.array([[1.0, 0.1], [2.0, -0.3]])
    away = np.linalg.norm(result.log["state"][:, None, :2] - posts, axis=2)
    clearance = (away - [0.2, 0.3]).min()
    assert clearance > 0.0
    assert result.summary["min_barrier"] == pytest.approx(clearance, abs=1e-3)


def test_robot_can_be_overridden_dumped_and_loaded_back() -> None:
    scenario = load_scenario(OWN, "{vehicle: {mass: 0.7}, method: cbf-qp}")
    assert scenario.vehicle.mass == 0.7  # type: ignore[attr-defined]
    text = dump_scenario(scenario)
    assert "vehicle: !Puck" in text
    assert parse_scenario(text, "dump.yaml") == scenario


def test_hypotheses_are_checked_for_a_robot_of_ones_own() -> None:
    names = {each.name for each in check_assumptions(load_scenario(OWN))}
    assert "input authority" in names


def test_messages_name_the_robots_states() -> None:
    message = refusal(OWN, "{initial_state: [0, 0]}")
    assert message.endswith("it must be 4 numbers, one each of x, y, vx, vy")
    message = refusal(OWN, "{vehicle: {masss: 1}}")
    assert message == "override: vehicle.masss: unknown key; did you mean mass?"


@pytest.mark.parametrize(
    ("text", "place", "problem"),
    [
        ("x = 1\n", "", "scenario(): None; it must be a function of this file"),
        (
            "def scenario():\n    return 3\n",
            "",
            "scenario(): 3; it must be a vcbf_drake.Scenario or Fleet",
        ),
        ("x = 1\ny = z\n", ":2", "NameError: name 'z' is not defined"),
        ("def scenario(:\n", ":1", "SyntaxError"),
        ("\ndef scenario():\n    return [].pop()\n", ":3", "IndexError: pop from"),
        (
            "from vcbf_drake import SphereObstacle\n\ndef scenario():\n"
            "    return SphereObstacle([0.0, 0.0], -1.0)\n",
            ":4",
            "radius: -1; it must be finite and not below 0",
        ),
    ],
)
def test_a_file_that_makes_no_scenario_says_where(
    tmp_path: Path, text: str, place: str, problem: str
) -> None:
    path = tmp_path / "robot.py"
    path.write_text(text)
    message = refusal(path)
    assert message.startswith(f"{path}{place}: ")
    assert problem in message


def test_a_robot_that_nothing_disturbs_needs_no_port_for_it(tmp_path: Path) -> None:
    text = OWN.read_text().replace(
        'self.draught = self.DeclareVectorInputPort("disturbance", 2)', "pass"
    )
    text = text.replace("self.draught.Eval(context)", "0.0")
    kept = [line for line in text.splitlines() if "disturbance=[" not in line]
    path = tmp_path / "calm.py"
    path.write_text("\n".join(kept))
    result = simulate(load_scenario(path, {"duration": 1.0}), step_time=False)
    assert result.summary["guaranteed"]
    assert result.log["disturbance_estimate"].shape == (51, 0)
    write_figures([result], tmp_path)
    assert not (tmp_path / "disturbance.png").exists()
    write_replay([result], tmp_path / "replay.html")


def test_faults_scale_what_a_vehicle_has() -> None:
    car = CarVehicle(mass=2.0).altered(mass=1.5, drag=1.0)
    assert car == CarVehicle(mass=3.0)
    with pytest.raises(InvalidValueError, match="drag: 2; it must be 1, for !Car has"):
        CarVehicle().altered(mass=1.0, drag=2.0)
    blimp = BlimpVehicle().altered(mass=2.0, drag=0.5)
    assert blimp.yaw_inertia == 2.0 * BlimpVehicle().yaw_inertia
    assert blimp.drag == [0.5 * each for each in BlimpVehicle().drag]
    message = "override: faults.drag: 2; it must be 1, for !Car has no drag"
    with pytest.raises(ScenarioError, match=message):
        load_scenario("car-avoidance", "{faults: {drag: 2}}")


def test_position_may_be_a_function_of_the_state() -> None:
    @dataclass
    class Pendulum(Vehicle):
        length: float = 2.0

        def position(self, x: Any) -> Any:  # type: ignore[override]
            return np.array([self.length * sin(x[0]), -self.length * cos(x[0])])

        def make_plant(self) -> Any: ...

        def make_controller(self, target: Any) -> Any: ...

    states = np.array([[0.3, 0.0], [-1.2, 5.0]])
    expected = 2.0 * np.column_stack([np.sin(states[:, 0]), -np.cos(states[:, 0])])
    np.testing.assert_allclose(Pendulum().positions(states), expected)
    pose = Pendulum().pose(states[0])
    np.testing.assert_allclose(pose.translation(), [*expected[0], 0.0])


def test_a_vehicle_that_looks_like_nothing_is_a_ball() -> None:
    (part,) = load_scenario(OWN).vehicle.geometry("#123456")
    assert part.color == "#123456"
    assert isinstance(part.shape, Sphere) and part.shape.radius() == 0.1


def test_state_feedback_is_its_law() -> None:
    law = StateFeedback(lambda x: 2.0 * x[:2], 3, 2)
    context = law.CreateDefaultContext()
    law.GetInputPort("state").FixValue(context, [1.0, -2.0, 5.0])
    assert law.GetOutputPort("reference").Eval(context).tolist() == [2.0, -4.0]


def test_a_multibody_plant_knows_its_channels() -> None:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(EXAMPLES / "models" / "planar_arm.urdf"))
    plant.Finalize()
    channels = channels_of(plant)
    assert all(unit in ("rad", "rad/s") for unit in channels.states.values())
    assert len(channels.states) == plant.num_multibody_states()
    assert set(channels.inputs.values()) == {"N m"}
    assert channels.angles == tuple(range(plant.num_positions()))
    assert channels.input_labels[0].endswith(" [N m]")


def test_a_controller_whose_state_is_not_connected_has_no_reference() -> None:
    controller = StateFeedback(lambda x, d: [x[0] + d[0]], 1, 1, 1)
    context = controller.CreateDefaultContext()
    reference = controller.GetOutputPort("reference")
    with pytest.raises(RuntimeError, match="state"):
        reference.Eval(context)
    controller.GetInputPort("state").FixValue(context, [2.0])
    assert reference.Eval(context).tolist() == [2.0]  # The estimate is optional.


def test_two_files_may_define_a_vehicle_of_one_name(tmp_path: Path) -> None:
    paths = [tmp_path / folder / "robot.py" for folder in ("one", "other")]
    for path in paths:
        path.parent.mkdir()
        path.write_text(OWN.read_text())
    for path in (*paths, *paths):
        loaded = load_scenario(path, {"duration": 1.0})
        law = type(loaded.vehicle).make_controller
        assert law.__code__.co_filename == str(path)


def test_a_law_that_raises_is_named_with_time_and_line(tmp_path: Path) -> None:
    text = OWN.read_text().replace(
        "lambda x: target - x[:2] - x[2:]", "lambda x: LAWS[int(x[0] > 0.2)](x, target)"
    )
    text += "\n\nLAWS = [lambda x, target: target - x[:2] - x[2:]]\n"
    path = tmp_path / "robot.py"
    path.write_text(text)
    (number,) = (i for i, line in enumerate(text.splitlines(), 1) if "LAWS[" in line)
    with pytest.raises(UserCodeError) as caught:
        simulate(load_scenario(path), step_time=False)
    message = str(caught.value)
    assert re.fullmatch(
        rf"controller at t = [\d.]+ s, {path}:{number}: IndexError: list index.*",
        message,
    )
    assert isinstance(caught.value.__cause__, IndexError)


@pytest.mark.parametrize("found", [None, [1.0], "text"])
def test_a_law_that_returns_no_input_is_named_with_the_time(found: Any) -> None:
    scenario = load_scenario(OWN)
    law = StateFeedback(lambda x: found, 4, 2)
    with pytest.raises(InvalidValueError, match="controller at t = 0 s: what the law"):
        simulate(scenario, controller=law, step_time=False)


def test_arrival_is_a_tenth_of_a_short_way() -> None:
    near = load_scenario(OWN, "{target: [0.4, 0.0], obstacles: []}")
    assert near.arrival_distance == pytest.approx(0.04)
    assert load_scenario(OWN, "{target: [9.0, 0.0]}").arrival_distance == 0.3
    there = load_scenario(OWN, "{target: [0.0, 0.0], obstacles: []}")
    assert there.arrival_distance == 0.3
    assert load_scenario(OWN, "{arrival_tolerance: 0.7}").arrival_distance == 0.7
