"""MultibodyPlants of several kinds, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    MultibodyPlant,
    Propeller,
    PropellerInfo,
)
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder

PLANAR = Path(__file__).parents[2] / "examples" / "models" / "planar_arm.urdf"
SEVEN = files("vcbf_drake") / "models" / "seven_joint_arm.urdf"


def load(path) -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(path))
    if plant.HasFrameNamed("base"):
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    return plant


def body(plant: MultibodyPlant, name: str, com=(0.0, 0.0, 0.0)):
    inertia = SpatialInertia.SolidBoxWithMass(1.5, 0.4, 0.3, 0.1).Shift(-np.array(com))
    return plant.AddRigidBody(name, inertia)


def free_body_with_arm(com=(0.01, 0.0, 0.02)) -> MultibodyPlant:
    """A free body, its centre of mass off the origin, with a link that turns on it."""
    plant = MultibodyPlant(0.0)
    base, link = body(plant, "base_body", com), body(plant, "link", (0.2, 0.0, 0.0))
    joint = RevoluteJoint("turn", base.body_frame(), link.body_frame(), [0, 1, 0])
    plant.AddJointActuator("turn", plant.AddJoint(joint))
    plant.Finalize()
    return plant


def quadrotor(com=(0.01, 0.0, 0.0)):
    """A free body with four propellers, its centre of mass 1 cm off the origin."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    index = body(plant, "frame", com).index()
    plant.Finalize()
    places = [(0.2, 0, 0), (0, 0.2, 0), (-0.2, 0, 0), (0, -0.2, 0)]
    propellers = builder.AddSystem(
        Propeller(
            [
                PropellerInfo(index, RigidTransform(np.array(p, float)), 1.0, 0.1 * s)
                for p, s in zip(places, (1, -1, 1, -1), strict=True)
            ]
        )
    )
    builder.Connect(
        propellers.get_spatial_forces_output_port(),
        plant.get_applied_spatial_force_input_port(),
    )
    builder.Connect(
        plant.get_body_poses_output_port(), propellers.get_body_poses_input_port()
    )
    builder.ExportInput(propellers.get_command_input_port(), "thrusts")
    diagram = builder.Build()
    diagram.set_name("quadrotor")
    return diagram, plant


def states(plant: MultibodyPlant, count: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Random states, a quaternion at their beginning of unit length."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        x = rng.normal(size=plant.num_multibody_states())
        if plant.num_positions() > plant.num_velocities():
            x[:4] /= np.linalg.norm(x[:4])
        yield x
