"""Positions a plant does not say, names given twice, what symbols cannot do."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    PlanarJoint,
    SpatialInertia,
    UnitInertia,
)
import pytest

from vcbf_drake.barriers import (
    Barrier,
    BarrierSet,
    Geofence,
    HalfSpace,
    PerceivedSpheres,
    SphereObstacle,
)
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel, point_position
from vcbf_drake.plants import Blimp, Car

GAINS = [3.0, 2.0]
URDF = Path(__file__).parents[2] / "examples" / "models" / "planar_arm.urdf"
INERTIA = SpatialInertia(1.3, [0.0, 0.0, 0.0], UnitInertia(0.1, 0.2, 0.25))


@pytest.fixture(scope="module")
def car() -> ControlAffineModel:
    return ControlAffineModel.from_system(Car())


@pytest.fixture(scope="module")
def arm() -> ControlAffineModel:
    return ControlAffineModel.from_system(_arm(), "actuation")


def _arm() -> MultibodyPlant:
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(URDF)
    plant.Finalize()
    return plant


def refusal(model: ControlAffineModel, *barriers: Barrier) -> str:
    with pytest.raises(ModelError) as error:
        BarrierSet(model, barriers)
    assert error.value.__cause__ is None
    assert error.value.__suppress_context__
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_center_in_more_dimensions_than_the_plant_is_refused(car) -> None:
    message = refusal(car, SphereObstacle([3.0, 0.1, 0.0], 0.5).barrier(GAINS))
    assert "it is in 3 dimensions, the position of" in message
    assert "leave a coordinate out" in message


@pytest.mark.parametrize(
    "barriers",
    [
        [SphereObstacle([1.0, 0.0], 0.1).barrier(GAINS)],
        [HalfSpace([1.0, 0.0]).barrier(GAINS)],
        Geofence([-1.0, -1.0], [1.0, 1.0]).barriers(GAINS),
        PerceivedSpheres(2, dimensions=2).barriers(GAINS),
    ],
)
def test_an_arm_is_asked_where_it_is(arm, barriers) -> None:
    message = refusal(arm, *barriers)
    assert "does not say which of its states (planar_arm_shoulder_q, " in message
    assert "position=[i, j]" in message
    assert "point_position" in message


def test_a_disc_is_a_pillar_for_a_plant_in_space() -> None:
    blimp = ControlAffineModel.from_system(Blimp())
    pillar = SphereObstacle([3.0, 4.0], 1.0).barrier(GAINS)
    x = np.array([0.0, 0.0, 7.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert BarrierSet(blimp, [pillar]).values(x, 0.0) == pytest.approx([4.0])


def test_multibody_plants_name_the_position_of_planar_and_free_bodies() -> None:
    plant = MultibodyPlant(time_step=0.0)
    body = plant.AddRigidBody("puck", INERTIA)
    plant.AddJoint(PlanarJoint("table", plant.world_frame(), body.body_frame()))
    plant.Finalize()
    puck = ControlAffineModel.from_system(plant, "applied_generalized_force")
    assert puck.position == (0, 1)
    plant = MultibodyPlant(time_step=0.0)
    plant.AddRigidBody("free", INERTIA)
    plant.Finalize()
    free = ControlAffineModel.from_system(plant, "applied_generalized_force")
    assert free.position == (4, 5, 6)


def test_barriers_of_one_name_get_numbers(car) -> None:
    rock = SphereObstacle([3.0, 0.1], 0.5)
    barriers = [rock.barrier(GAINS), rock.barrier(GAINS), rock.barrier(GAINS, name="x")]
    assert BarrierSet(car, barriers).names == ("obstacle 1", "obstacle 2", "x")


@pytest.mark.parametrize(
    ("function", "way_out"),
    [
        (lambda x, t, p: x[0] if x[0] > 0 else -x[0], "write a smooth formula"),
        (lambda x, t, p: np.clip(x[0], 0.0, 1.0), "write a smooth formula"),
        (lambda x, t, p: max(x[0], x[1]), "one barrier for each case"),
        (lambda x, t, p: np.maximum(x[0], 0.0), "write a smooth formula"),
        (lambda x, t, p: np.where(x[0] > 0, x[0], 0.0), "write a smooth formula"),
        (lambda x, t, p: math.sin(x[0]), r"write NumPy's \(np.cos\)"),
        (lambda x, t, p: float(x[0]), r"write NumPy's \(np.cos\)"),
        (lambda x, t, p: np.hypot(x[0], x[1]), r"write \(a\*\*2 \+ b\*\*2\)\*\*0.5"),
        (lambda x, t, p: np.log10(x[0]), "'log10' does not know symbols"),
    ],
)
def test_what_symbols_cannot_do_is_said_with_the_way_out(car, function, way_out):
    message = refusal(car, Barrier(function, GAINS, name="b"))
    assert message.startswith("barrier 'b': function(x, t, p) fails on symbols: ")
    assert "EqualToDict" not in message
    with pytest.raises(ModelError, match=way_out):
        BarrierSet(car, [Barrier(function, GAINS)])


def test_a_ball_joint_has_no_symbols_and_is_told_what_to_take_instead() -> None:
    plant = MultibodyPlant(time_step=0.0)
    body = plant.AddRigidBody("bob", INERTIA)
    plant.AddJoint(BallRpyJoint("ball", plant.world_frame(), body.body_frame()))
    plant.Finalize()
    port = "applied_generalized_force"
    assert ControlAffineModel.from_system(plant, port).num_states == 6
    with pytest.raises(ModelError, match="model the joint by revolute joints") as error:
        ControlAffineModel.from_system(plant, port, symbolic=True)
    assert "\n" not in str(error.value)


def test_a_frame_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(ModelError, match=r"no frame 'tip'; its frames are .*forearm"):
        point_position(_arm(), "tip")
