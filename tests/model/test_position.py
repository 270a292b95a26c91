"""Forward kinematics and dynamics of a MultibodyPlant from a URDF file."""

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression
import pytest

from tests.helpers.multibody_plants import PLANAR, load
from vcbf_drake import ControlAffineModel, InputSet, ModelError, SphereObstacle
from vcbf_drake.barriers import BarrierSet, HalfSpace, StateLimit
from vcbf_drake.model import point_position
from vcbf_drake.safety import SafetyFilter

UPPER, FOREARM, HEIGHT = 0.7, 0.5, 1.1  # As in the file [m].


@pytest.fixture(scope="module")
def arm():
    return load(PLANAR)


@pytest.fixture(scope="module")
def model(arm):
    return ControlAffineModel.from_system(arm, input_port="actuation")


def hand(x):
    """The hand in the x-z plane, by school geometry."""
    shoulder, both = x[0], x[0] + x[1]
    return np.array(
        [
            UPPER * np.cos(shoulder) + FOREARM * np.cos(both),
            HEIGHT + UPPER * np.sin(shoulder) + FOREARM * np.sin(both),
        ]
    )


def hand_jacobian(x):
    shoulder, both = x[0], x[0] + x[1]
    tip = FOREARM * np.array([-np.sin(both), np.cos(both)])
    root = UPPER * np.array([-np.sin(shoulder), np.cos(shoulder)])
    return np.column_stack([root + tip, tip])


def test_a_sphere_keeps_the_hand_away(arm, model):
    ball = SphereObstacle([0.9, 1.3], radius=0.2, margin=0.05)
    position = point_position(arm, "forearm", [FOREARM, 0.0, 0.0], axes=[0, 2])
    barriers = BarrierSet(model, [ball.barrier([9.0, 20.0], position=position)])
    rng = np.random.default_rng(1)
    for x in rng.uniform(-1.0, 1.0, (10, 4)):
        offset = hand(x) - ball.center
        rows = barriers.rows(x, 0.0)
        normal = offset / np.linalg.norm(offset)
        assert rows.value[0] == pytest.approx(np.linalg.norm(offset) - 0.25)
        gradient = normal @ hand_jacobian(x)
        assert rows.A[0] == pytest.approx(-gradient @ model.input_matrix(x)[2:])
        # phi^1 = h' + lambda_1 h with the larger rate, 5, of s^2 + 9 s + 20.
        assert rows.chain[0][1] == pytest.approx(gradient @ x[2:] + 5.0 * rows.value[0])


def test_every_shape_takes_a_function_and_checks_what_it_returns(arm, model):
    position = point_position(arm, "forearm", axes=[0, 2])
    wall = HalfSpace([-1.0, 0.0, 0.0], offset=-0.8)
    with pytest.raises(ModelError, match=r"position\(x\) must return 3 numbers, not 2"):
        BarrierSet(model, [wall.barrier([5.0, 6.0], position=position)])


def test_a_frame_that_does_not_exist_is_named(arm):
    with pytest.raises(ModelError, match="tentacle"):
        point_position(arm, "tentacle")


def test_effort_limits_belong_into_the_input_set(arm, model):
    """Drake clamps an actuator there; the model does not, so the set stays within."""
    assert model.effort_limits.tolist() == [80.0, 40.0]
    context = arm.CreateDefaultContext()
    x, u = np.array([0.4, -0.2, 0.3, 0.1]), np.array([80.0, -40.0])
    arm.SetPositionsAndVelocities(context, x)
    arm.get_actuation_input_port().FixValue(context, u)
    expected = arm.EvalTimeDerivatives(context).CopyToVector()
    assert model.drift(x) + model.input_matrix(x) @ u == pytest.approx(expected)
    speed = StateLimit(2, upper=1.0).barriers([5.0])
    SafetyFilter(model, speed, InputSet.box([-80.0, -40.0], [80.0, 40.0]))
    with pytest.raises(ValueError, match=r"input 1: 41; .* at most 40, the eff"):
        SafetyFilter(model, speed, InputSet.box([-80.0, -40.0], [80.0, 41.0]))


def test_the_port_of_one_model_instance_has_its_own_limits(arm):
    model = ControlAffineModel.from_system(arm, input_port="planar_arm_actuation")
    assert model.effort_limits.tolist() == [80.0, 40.0]


def test_a_discrete_plant_is_refused_with_what_to_do():
    plant = MultibodyPlant(time_step=1e-3)
    Parser(plant).AddModels(PLANAR)
    plant.Finalize()
    with pytest.raises(ModelError, match="the one with time_step=0"):
        ControlAffineModel.from_system(plant, input_port="actuation")


def test_a_body_that_is_but_a_frame_needs_no_mass(model):
    """A tool's tip, as URDF files have them, at the end of the forearm."""
    tip = (
        '<link name="tip"/><joint name="end" type="fixed"><parent link="forearm"/>'
        '<child link="tip"/><origin xyz="0.5 0 0"/></joint></robot>'
    )
    plant = MultibodyPlant(time_step=0.0)
    text = PLANAR.read_text(encoding="utf-8").replace("</robot>", tip)
    Parser(plant).AddModelsFromString(text, "urdf")
    plant.Finalize()
    with_tip = ControlAffineModel.from_system(plant, input_port="actuation")
    position = point_position(plant, "tip", axes=[0, 2])
    rng = np.random.default_rng(2)
    for x in rng.uniform(-1.0, 1.0, (5, 4)):
        for own, other in zip(
            with_tip.drift_and_input_matrix(x),
            model.drift_and_input_matrix(x),
            strict=True,
        ):
            np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-9)
        symbols = np.array([Expression(number) for number in x])
        found = [e.Evaluate() for e in position(symbols)]
        np.testing.assert_allclose(found, hand(x), atol=1e-12)
        np.testing.assert_allclose(position(x), hand(x), atol=1e-12)
