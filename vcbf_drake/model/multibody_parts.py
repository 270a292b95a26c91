"""The parts of a MultibodyPlant: its frames, bodies, joints and actuators."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import System

from vcbf_drake.checks import Array


def plant_of(system: Any) -> Any:
    """Returns the MultibodyPlant that a System is, or that contains all its state."""
    if isinstance(system, MultibodyPlant):
        return system
    inside: Sequence[Any] = getattr(system, "GetSystems", lambda: ())()
    plants = [each for each in inside if isinstance(each, MultibodyPlant)]
    if len(plants) != 1:
        return None
    states = system.num_continuous_states()
    return plants[0] if plants[0].num_multibody_states() == states else None


def _instances(plant: MultibodyPlant) -> list[ModelInstanceIndex]:
    """All model instances except the world's."""
    return [ModelInstanceIndex(i) for i in range(1, plant.num_model_instances())]


def frames_of(plant: MultibodyPlant) -> list[str]:
    """Returns the names of all frames except the world's."""
    indices = chain.from_iterable(map(plant.GetFrameIndices, _instances(plant)))
    return [*filter(None, (plant.get_frame(i).name() for i in indices))]


def bodies_of(plant: MultibodyPlant) -> list[RigidBody]:
    """Returns all bodies except the world."""
    indices = chain.from_iterable(map(plant.GetBodyIndices, _instances(plant)))
    return [*map(plant.get_body, indices)]


def joints_of(plant: MultibodyPlant) -> list[Joint]:
    """Returns all joints."""
    return [*map(plant.get_joint, plant.GetJointIndices())]


def floating_bodies_of(plant: MultibodyPlant) -> list[RigidBody]:
    """Returns the bodies that float."""
    return [*map(plant.get_body, plant.GetFloatingBaseBodies())]


def how_to_fix(plant: MultibodyPlant) -> str:
    """Returns a message's advice on how to fix each floating base."""
    names = (each.name() for each in floating_bodies_of(plant))
    return "".join(f"; weld: {name} fixes the floating base" for name in names)


def actuators_of(system: System, port: Any = None) -> list[Any]:
    """Returns the joint actuators of a MultibodyPlant, or those that a port drives.

    There are none of any other System, and none behind a port of another kind.
    """
    if not hasattr(system, "GetJointActuatorIndices"):
        return []
    found = [system.get_joint_actuator(i) for i in system.GetJointActuatorIndices()]
    if port is None or not found or port is system.get_actuation_input_port():
        return found
    of_instance = system.get_actuation_input_port
    return [each for each in found if port is of_instance(each.model_instance())]


def effort_limits_of(system: System, port: Any) -> Array:
    """Returns the effort limits at which a MultibodyPlant clamps inputs, (m,)."""
    limits = [each.effort_limit() for each in actuators_of(system, port)]
    return np.array(limits or [np.inf] * port.size())
