"""A robot from a file: its limits, its controller, a run that keeps them."""

from __future__ import annotations

import math
from pathlib import Path
import pickle

import numpy as np
import pytest

from vcbf_drake import InputLimits, Scenario, ScenarioError, load_scenario, simulate
from vcbf_drake.barriers import HalfSpace, StateLimit
from vcbf_drake.plants import MultibodyVehicle
from vcbf_drake.plants.robot_controllers import Lqr
from vcbf_drake.plants.vehicle import channels_of
from vcbf_drake.simulation.sections import BarrierGains

EXAMPLES = Path(__file__).parents[2] / "examples"
ARM = EXAMPLES / "arm.yaml"


def test_limits_are_those_of_the_file() -> None:
    scenario = load_scenario(ARM)
    assert scenario.input_set.upper[:3] == [300.0, 300.0, 170.0]
    names = [each.name for each in scenario.vehicle.barriers()]
    assert len(names) == 28
    assert names[:2] == ["joint_1 (low)", "joint_1 (high)"]
    assert "joint_7 speed (high)" in names
    message = refusal("{initial_state: [0]}")
    assert "14 numbers, one each of joint_1_q, joint_2_q" in message


def test_arm_moves_towards_its_target_within_its_limits() -> None:
    scenario = load_scenario(ARM, {"duration": 1.0})
    result = simulate(scenario, step_time=False)
    assert result.summary["outcome"] == "timeout"
    assert result.summary["min_barrier"] > 0.0
    plant = scenario.vehicle.make_plant()
    q, v = np.split(result.log["state"], 2, axis=1)
    assert (q >= plant.GetPositionLowerLimits()).all()
    assert (q <= plant.GetPositionUpperLimits()).all()
    assert (np.abs(v) <= plant.GetVelocityUpperLimits() + 1e-9).all()
    hand = scenario.vehicle.positions(result.log["state"])
    assert (np.linalg.norm(hand - [0.66, 0.0, 0.62], axis=1) > 0.15).all()
    poses = map(scenario.vehicle.poses, result.log["state"])
    wrist = np.array([each["link_6"].translation() for each in poses])
    assert (np.linalg.norm(wrist - [0.66, 0.0, 0.62], axis=1) > 0.18).all()
    away = np.linalg.norm(hand - scenario.target, axis=1)
    assert away[-1] < 0.7 * away[0]
    law = scenario.vehicle.make_controller(scenario.target)
    wish = law.GetSubsystemByName("posture")
    posture = wish.get_output_port().Eval(wish.CreateDefaultContext())
    there = scenario.vehicle.positions(posture[None])
    np.testing.assert_allclose(there[0], scenario.target, atol=0.01)


def test_a_vehicle_from_a_file_can_be_sent_to_another_process() -> None:
    vehicle = load_scenario(ARM).vehicle
    assert pickle.loads(pickle.dumps(vehicle)) == vehicle


def link(name: str, at: str) -> str:
    return (
        f"<link name='{name}'><inertial><origin xyz='{at}'/><mass value='2'/><inertia"
        " ixx='0.02' iyy='0.03' izz='0.04' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    )


FLOATING = f"""<robot name='free'>{link("hull", "0.02 0 0")}{link("arm", "0.2 0 0")}
<joint name='turn' type='revolute'><parent link='hull'/><child link='arm'/>
<axis xyz='0 0 1'/><limit lower='-1.5' upper='1.5' effort='5' velocity='1'/></joint>
</robot>"""


def test_a_base_may_float(tmp_path: Path) -> None:
    (tmp_path / "free.urdf").write_text(FLOATING)
    (tmp_path / "free.yaml").write_text("""
free:
  vehicle: !Multibody
    {file: free.urdf, frame: arm, point: [0.4, 0, 0], actuators: [turn],
     controller: !JointStiffness {stiffness: [4], damping: [2]}}
  obstacles: [!Sphere {center: [0.42, 0.2, 1], radius: 0.05}]
  initial_state: [1, 0, 0, 0, 0, 0, 0, -0.5, 0, 0, 0, 0, 0, 0, 0]
  target: [0.3509, 0.1918, 0] # The hull pushes off, so it is not reached.
  duration: 0.3
  method: cbf-qp
""")
    scenario = load_scenario(tmp_path / "free.yaml")
    result = simulate(scenario, step_time=False)
    assert result.summary["outcome"] == "timeout"
    assert result.summary["min_barrier"] > 0.0
    state = result.log["state"]
    assert state[-1, 7] > -0.3  # The arm turns, the hull against it, and it falls.
    assert state[-1, 10] < 0.0
    assert state[-1, 6] == pytest.approx(-0.5 * 9.81 * 0.3**2, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(state[:, :4], axis=1), 1.0, atol=1e-6)
    units = channels_of(scenario.vehicle.make_plant()).states
    assert units["hull_qw"] == "" and units["hull_x"] == "m"
    assert units["hull_wx"] == "rad/s" and units["turn_w"] == "rad/s"
    text = "{initial_state: [2, 0, 0, 0, 0, 0, 0, -0.5, 0, 0, 0, 0, 0, 0, 0]}"
    with pytest.raises(ScenarioError, match="hull_qz of length 1"):
        load_scenario(tmp_path / "free.yaml", text)
    with pytest.raises(ScenarioError, match="!Lqr: the base hull floats, and no motor"):
        load_scenario(tmp_path / "free.yaml", "{vehicle: {controller: !Lqr {}}}")


ACROBOT = "package://drake/examples/acrobot/Acrobot.urdf"


def test_the_regulator_holds_a_robot_with_fewer_motors_than_joints() -> None:
    scenario = Scenario(
        vehicle=MultibodyVehicle(
            ACROBOT, "lower_link", controller=Lqr(), posture=[math.pi, 0.0]
        ),
        input_set=InputLimits([-50.0], [50.0]),
        initial_state=[math.pi - 0.05, 0.02, 0.0, 0.0],
        target=[0.0, 0.25, 1.0],
        obstacles=[StateLimit("elbow_w", -3.0, 3.0, [5.0])],
        arrival_tolerance=0.01,
        duration=5.0,
        method="cbf-qp",
    )
    result = simulate(scenario, step_time=False)
    assert result.summary["outcome"] == "reached"
    np.testing.assert_allclose(
        result.log["state"][-1], [math.pi, 0.0, 0.0, 0.0], atol=0.02
    )
    with pytest.raises(ValueError, match="where its motors can hold it"):
        scenario.vehicle.make_controller([1.0, 0.25, 0.0])  # Outstretched sideways.


def test_a_small_arm_is_certified_between_the_ticks() -> None:
    robot = EXAMPLES / "models" / "planar_arm.urdf"
    scenario = Scenario(
        vehicle=MultibodyVehicle(str(robot), "forearm", [0.5, 0.0, 0.0]),
        initial_state=[0.5, 0.8, 0.0, 0.0],
        target=[0.9, 0.0, 1.5],
        obstacles=[HalfSpace([-1.0, 0.0, 0.0], -0.95)],
        barrier=BarrierGains(gains=[12.0, 35.0]),
        duration=1.0,
        method="cbf-qp",
        between_ticks="certified",
    )
    summary = simulate(scenario, step_time=False).summary
    assert summary["guaranteed"]
    assert 0.0 < summary["certified_min_barrier"] <= summary["min_barrier"] < 0.1


def test_a_start_is_moved_by_an_offset() -> None:
    vehicle, offset = load_scenario(ARM).vehicle, np.array([0.01, -0.02, 0.015])
    state = np.array(load_scenario(ARM).initial_state)
    moved = vehicle.moved(state, offset)
    places = vehicle.positions(np.array([state, moved]))
    np.testing.assert_allclose(places[1] - places[0], offset, atol=2e-3)
    assert not moved[7:].any()


def refusal(override: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(ARM, override)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("{vehicle: {frame: claw}}", "frame: 'claw'; it must be one of base, link_1"),
        ("{vehicle: {file: nowhere.urdf}}", "it must be a URDF or SDFormat file"),
        ("{vehicle: {weld: ''}}", "vehicle: it does not move: An internal mass"),
        ("{vehicle: {stiffness: 4}}", "it is vehicle.controller.stiffness now"),
        (
            "{vehicle: {controller: {stiffness: [-1]}}}",
            "vehicle.controller.stiffness[0]: -1; it must be finite and above 0",
        ),
        (
            "{vehicle: {controller: {stiffness: [1, 2]}}}",
            "vehicle.controller.stiffness: [1.0, 2.0]; it must be 1 number for all",
        ),
        ("{target: [5, 0, 0]}", "target: [5.0, 0.0, 0.0]; it must be a place that the"),
        (
            "{vehicle: {actuators: [joint_1]}}",
            "vehicle.controller: !InverseDynamics needs 7 motors for 7 velocities",
        ),
        (
            "{between_ticks: certified}",
            "between_ticks: 'certified, 7 velocities'; it must be none for over 3",
        ),
        ("{target: [1, 2]}", "target: [1.0, 2.0]; it must be 3 numbers, one each of x"),
        (
            "{initial_state: [3, 0, 0, -1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]}",
            "it must be inside the robot's limit joint_1 (high); its h is -0.1",
        ),
        ("{vehicle: {posture: [1]}}", "posture: [1.0]; it must be 7 numbers, one"),
    ],
)
def test_wrong_files_frames_and_numbers_are_refused(
    override: str, message: str
) -> None:
    assert message in refusal(override)
