"""A robot from a file: its limits, its controller, a run that keeps them."""

from __future__ import annotations

from pathlib import Path
import pickle

import numpy as np
import pytest

from vcbf_drake import ScenarioError, load_scenario, simulate
from vcbf_drake.plants import MultibodyVehicle

ARM = Path(__file__).parents[2] / "examples" / "arm.yaml"


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
    assert (np.linalg.norm(hand - [0.55, 0.0, 0.6], axis=1) > 0.1).all()
    law = scenario.vehicle.make_controller(scenario.target)
    wish = law.GetSubsystemByName("posture")
    posture = wish.get_output_port().Eval(wish.CreateDefaultContext())[:7]
    there = scenario.vehicle.positions(np.concatenate([posture, 0 * posture])[None])
    np.testing.assert_allclose(there[0], scenario.target, atol=0.01)
    away = np.abs(q - posture).max(axis=1)
    assert away[-1] < away[0]


def test_a_vehicle_from_a_file_can_be_sent_to_another_process() -> None:
    vehicle = load_scenario(ARM).vehicle
    assert pickle.loads(pickle.dumps(vehicle)) == vehicle


def refusal(override: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(ARM, override)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("{vehicle: {frame: claw}}", "frame: 'claw'; it must be one of base, link_1"),
        ("{vehicle: {weld: floor}}", "weld: 'floor'; it must be one of base"),
        ("{vehicle: {file: nowhere.urdf}}", "it must be a URDF or SDFormat file"),
        ("{vehicle: {weld: ''}}", "vehicle: it does not move: An internal mass"),
        ("{vehicle: {stiffness: 4}}", "it is vehicle.controller.stiffness now"),
        (
            "{vehicle: {controller: {stiffness: [-1]}}}",
            "vehicle.controller.stiffness[0]: -1; it must be finite and above 0",
        ),
        (
            "{vehicle: {controller: {stiffness: [1, 2]}}}",
            "vehicle.controller.stiffness: [1.0, 2.0]; it must be 1 number, or 7",
        ),
        ("{target: [5, 0, 0]}", "target: [5.0, 0.0, 0.0]; it must be a place that the"),
        (
            "{vehicle: {actuators: [joint_1]}}",
            "vehicle.controller: '1 motors for 7 velocities'; it must be a motor each",
        ),
        ("{vehicle: {actuators: [elbow]}}", "actuators: 'elbow'; it must be one of"),
        ("{vehicle: {fixed: [elbow]}}", "fixed: 'elbow'; it must be one of joint_1"),
        ("{vehicle: {posture: [1]}}", "posture: [1.0]; it must be 7 numbers, one"),
    ],
)
def test_wrong_files_frames_and_numbers_are_refused(
    override: str, message: str
) -> None:
    assert message in refusal(override)


def test_a_place_out_of_reach_is_refused() -> None:
    vehicle = load_scenario(ARM).vehicle
    assert isinstance(vehicle, MultibodyVehicle)
    with pytest.raises(ValueError, match=r"target: .* a place that the robot reaches"):
        vehicle.make_controller([5.0, 0.0, 0.0])
