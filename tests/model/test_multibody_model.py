"""Models of MultibodyPlants of any size, in Drake's own numbers."""

import numpy as np
from numpy.testing import assert_allclose
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
)
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder
import pytest

from tests.helpers.multibody_plants import (
    PLANAR,
    SEVEN,
    body,
    free_body_with_arm,
    load,
    quadrotor,
    states,
)
from vcbf_drake import ControlAffineModel, ModelError
from vcbf_drake.model.multibody_model import MultibodyModel


@pytest.mark.parametrize("path", [PLANAR, SEVEN])
def test_the_parts_solve_the_manipulator_equations(path):
    """M dv/dt = tau + gravity - C v - damping v, with M inverted by NumPy."""
    plant = load(path)
    model = ControlAffineModel.from_system(plant, "actuation")
    assert isinstance(model, MultibodyModel)
    context, nq = plant.CreateDefaultContext(), plant.num_positions()
    damping = [
        plant.get_joint(i).default_damping_vector()[0]
        for i in plant.GetJointIndices()
        if plant.get_joint(i).num_velocities()
    ]
    for x in states(plant, 5):
        plant.SetPositionsAndVelocities(context, x)
        M, v = plant.CalcMassMatrix(context), x[nq:]
        free = plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context)
        f, g = model.drift_and_input_matrix(x)
        assert_allclose(f, [*v, *np.linalg.solve(M, free - damping * v)], rtol=1e-9)
        B = plant.MakeActuationMatrix()
        assert_allclose(g[:nq], 0.0)
        assert_allclose(g[nq:], np.linalg.solve(M, B), rtol=1e-9, atol=1e-12)
        u = np.random.default_rng(1).normal(size=model.num_inputs)
        assert_allclose(model.nominal_rate(x, u), f + g @ u, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("plant", "port"),
    [
        (load(SEVEN), "actuation"),
        (free_body_with_arm(), "actuation"),
        (free_body_with_arm(), "applied_generalized_force"),
    ],
)
def test_sensitivities_are_central_differences(plant, port):
    model = ControlAffineModel.from_system(plant, port)
    (x,) = states(plant, 1)
    f_x, g_x = model.at(x).sensitivity
    for i, unit in enumerate(1e-6 * np.eye(len(x))):
        if plant.num_positions() > plant.num_velocities() and i < 4:
            continue  # A quaternion changes along its sphere only.
        f_1, g_1 = model.drift_and_input_matrix(x + unit)
        f_0, g_0 = model.drift_and_input_matrix(x - unit)
        scale = 1e-6 * (1.0 + np.abs(f_x).max())
        assert_allclose(f_x[:, i], (f_1 - f_0) / 2e-6, atol=scale)
        assert_allclose(g_x[:, :, i], (g_1 - g_0) / 2e-6, atol=scale)


def test_a_free_body_with_propellers_and_an_offset_mass_is_a_model_at_once():
    diagram, _ = quadrotor()
    model = ControlAffineModel.from_system(diagram)
    assert model.num_inputs == 4 and model.num_states == 13
    at_rest = np.zeros(13)
    at_rest[0] = 1.0
    f, g = model.drift_and_input_matrix(at_rest)
    # Of the centre of mass: gravity, and the thrusts' sum; the body's origin turns
    # about it.
    offset = np.array([0.01, 0.0, 0.0])
    turn, fall = np.arange(7, 10), np.arange(10, 13)
    centre = g[fall] + np.cross(g[turn].T, offset).T
    assert_allclose(
        centre, np.array([[0.0], [0.0], [1.0 / 1.5]]) * np.ones(4), atol=1e-9
    )
    assert_allclose(f[fall], [0.0, 0.0, -9.81], atol=1e-9)


def test_states_whose_rates_are_velocities_are_known():
    model = ControlAffineModel.from_system(load(SEVEN), "actuation")
    assert model.velocity_of_position == {i: 7 + i for i in range(7)}
    floating = ControlAffineModel.from_system(free_body_with_arm(), "actuation")
    # Four quaternion entries have none; x, y, z and the joint's angle do.
    assert floating.velocity_of_position == {4: 11, 5: 12, 6: 13, 7: 14}


def test_a_constant_disturbance_matrix_is_found_and_another_is_refused():
    plant = MultibodyPlant(0.0)
    cart = body(plant, "cart")
    joint = PrismaticJoint("slide", plant.world_frame(), cart.body_frame(), [1, 0, 0])
    plant.AddJointActuator("slide", plant.AddJoint(joint))
    plant.Finalize()
    model = ControlAffineModel.from_system(
        plant, "actuation", "applied_generalized_force"
    )
    assert_allclose(model.disturbance_matrix, [[0.0], [1.0 / 1.5]])
    with pytest.raises(ModelError, match="disturbance matrix E is not constant"):
        ControlAffineModel.from_system(
            load(PLANAR), "actuation", "applied_generalized_force"
        )


@pytest.mark.parametrize("symbolic", [False, True])
def test_a_plant_without_mass_has_no_model(symbolic):
    plant = MultibodyPlant(0.0)
    cart = plant.AddRigidBody("cart", SpatialInertia.Zero())
    joint = PrismaticJoint("slide", plant.world_frame(), cart.body_frame(), [1, 0, 0])
    plant.AddJointActuator("slide", plant.AddJoint(joint))
    plant.Finalize()
    with pytest.raises(ModelError, match="no derivatives: the matrix of inertia is"):
        ControlAffineModel.from_system(plant, symbolic=symbolic)


def test_a_plant_is_read_off_in_symbols_when_asked():
    plant = load(PLANAR)
    numbers = ControlAffineModel.from_system(plant, "actuation")
    symbols = ControlAffineModel.from_system(plant, "actuation", symbolic=True)
    assert not isinstance(symbols, MultibodyModel)
    for x in states(plant, 20):
        for a, b in zip(
            numbers.drift_and_input_matrix(x),
            symbols.drift_and_input_matrix(x),
            strict=True,
        ):
            assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_parameters_and_gravity_come_from_the_context():
    plant = load(PLANAR)
    context = plant.CreateDefaultContext()
    plant.GetBodyByName("forearm").SetMass(context, 5.0)
    model = ControlAffineModel.from_system(plant, "actuation", context=context)
    (x,) = states(plant, 1)
    plant.SetPositionsAndVelocities(context, x)
    plant.get_actuation_input_port().FixValue(context, [3.0, -2.0])
    expected = plant.EvalTimeDerivatives(context).CopyToVector()
    assert_allclose(model.nominal_rate(x, np.array([3.0, -2.0])), expected, rtol=1e-9)


def test_a_plant_with_collision_shapes_in_a_scene_is_a_model_without_contact():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(PLANAR))
    ball, friction = Sphere(0.05), CoulombFriction(0.5, 0.5)
    hand = plant.GetBodyByName("forearm")
    plant.RegisterCollisionGeometry(hand, RigidTransform(), ball, "ball", friction)
    plant.Finalize()
    model = ControlAffineModel.from_system(plant)
    bare = ControlAffineModel.from_system(load(PLANAR))
    for x in states(plant, 3):
        for a, b in zip(
            (*model.drift_and_input_matrix(x), *model.at(x).sensitivity),
            (*bare.drift_and_input_matrix(x), *bare.at(x).sensitivity),
            strict=True,
        ):
            assert_allclose(a, b, rtol=1e-9, atol=1e-9)
