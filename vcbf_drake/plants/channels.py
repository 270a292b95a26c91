"""Channels: the names and units of a plant's states, inputs and disturbances."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint
from pydrake.systems.framework import System

from vcbf_drake.model.interface import actuators_of, find_input_port, state_port_of


@dataclass(frozen=True)
class Channels:
    """The names of a plant's channels, each with its unit if it has one.

    Attributes:
        states: The names of the n states.
        inputs: The names of the m inputs.
        disturbances: The names of the q disturbances.
    """

    states: dict[str, str]
    inputs: dict[str, str]
    disturbances: dict[str, str]

    @property
    def input_labels(self) -> tuple[str, ...]:
        """The inputs' names with their units, for axes."""
        return _labels(self.inputs)

    @property
    def disturbance_labels(self) -> tuple[str, ...]:
        """The disturbances' names with their units, for axes."""
        return _labels(self.disturbances)

    @property
    def angles(self) -> tuple[int, ...]:
        """The indices of the states that are angles [rad]."""
        units = self.states.values()
        return tuple(i for i, unit in enumerate(units) if unit == "rad")

    @property
    def quaternions(self) -> tuple[int, ...]:
        """The first indices of the quaternions in a MultibodyPlant's state."""
        return tuple(i for i, each in enumerate(self.states) if each.endswith("_qw"))


def channels_of(plant: System) -> Channels:
    """Returns a plant's channels.

    A `MultibodyPlant` knows those of its joints and actuators; any other system names
    them in its attributes ``state_names``, ``state_units``, and likewise for ``input``
    and ``disturbance``. Without names they are called x0, ..., u0, ... and d0, ...

    Args:
        plant: With ports ``input`` (or ``actuation``), ``state`` and, if anything
            disturbs it, ``disturbance``.
    """
    num_inputs, num_states = find_input_port(plant).size(), state_port_of(plant).size()
    if isinstance(plant, MultibodyPlant):
        return Channels(_joint_states(plant), _actuators(plant), {})
    disturbed = plant.HasInputPort("disturbance")
    size = plant.GetInputPort("disturbance").size() if disturbed else 0
    return Channels(
        _named(plant, "state", "x", num_states),
        _named(plant, "input", "u", num_inputs),
        _named(plant, "disturbance", "d", size),
    )


def _labels(channels: dict[str, str]) -> tuple[str, ...]:
    return tuple(
        name.replace("_", " ") + (f" [{unit}]" if unit else "")
        for name, unit in channels.items()
    )


def _named(plant: Any, kind: str, letter: str, size: int) -> dict[str, str]:
    names = getattr(plant, f"{kind}_names", None)
    units = getattr(plant, f"{kind}_units", ())
    names = names or [f"{letter}{i}" for i in range(size)]
    return dict(zip_longest(names, units, fillvalue=""))


def _joint_states(plant: MultibodyPlant) -> dict[str, str]:
    """The states with their units, by the endings that Drake gives their names."""
    names = plant.GetStateNames(add_model_instance_prefix=False)
    units = {"x": "m", "y": "m", "z": "m", "q": "rad", "v": "m/s", "w": "rad/s"}
    found = {}
    for name in names:
        joint, _, ending = name.rpartition("_")
        is_quaternion = ending[0] == "q" and f"{joint}_qw" in names
        found[name] = "" if is_quaternion else units[ending[0]]
    return found


def _actuators(plant: MultibodyPlant) -> dict[str, str]:
    return {
        each.name(): "N" if isinstance(each.joint(), PrismaticJoint) else "N m"
        for each in actuators_of(plant)
    }
