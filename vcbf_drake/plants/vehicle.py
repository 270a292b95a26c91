"""Vehicle: the interface of a robot for scenarios, studies, replays and hardware."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform, RotationMatrix, cos, sin
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint
from pydrake.systems.framework import System

from vcbf_drake.barriers import Barrier, StateInputLimit
from vcbf_drake.checks import Array, require
from vcbf_drake.model.interface import find_input_port, state_port_of
from vcbf_drake.model.multibody_parts import actuators_of
from vcbf_drake.model.position import Position
from vcbf_drake.plants.shapes import Part, bounding_box, of_body
from vcbf_drake.typed import tag_of


class Vehicle(ABC):
    """A robot: its plant, controller, position and own limits.

    A subclass is a dataclass: its fields are the robot's parameters, in a scenario file
    too, where ``vehicle: !Name {...}`` makes a `Name` (or `NameVehicle`).

    Attributes:
        position: The indices of the vehicle's position, or a function from the state
            (n,) to it, in operations of pydrake and ``pydrake.math``.
        heading: The index of the state that turns the body about the vertical, for
            pictures.
    """

    position: Position
    heading: int | None = None

    @abstractmethod
    def make_plant(self) -> System:
        """Returns the plant, a control-affine system.

        Its ports are ``input``, ``state`` and, if anything disturbs it,
        ``disturbance``. The names and units of its channels are its attributes
        ``state_names``, ``state_units``, ``input_names``, ``input_units``.
        """

    @abstractmethod
    def make_controller(self, target: Sequence[float]) -> System:
        """Returns a controller that steers to a target, regardless of obstacles.

        Its ports are ``state``, ``reference`` (the reference input) and, if it
        compensates the disturbance, ``disturbance_estimate``.

        Args:
            target: The position to reach [m].
        """

    def input_limits(self) -> tuple[list[float], list[float]] | None:
        """Returns the least and greatest inputs; None if a scenario gives them."""
        return None

    def barriers(self) -> list[Barrier | StateInputLimit]:
        """Returns the robot's own limits, obstacles apart: none by default."""
        return []

    def body_position(self, point: Sequence[float], frame: str = "") -> Position:
        """Returns the position of a point of the body, a function as `position` is.

        Args:
            point: The offset from the position, turned by the heading if there is one;
                empty for the position itself [m].
            frame: The frame that it moves with; empty for the body.

        Raises:
            InvalidValueError: There is no such frame, or not one number per dimension.
        """
        rule = f"empty, for {tag_of(type(self))} is one body"
        require(not frame, "frame", frame, rule)
        if not len(point):
            return self.position
        at, turn = self.position, self.heading

        def position(x: Any) -> Any:
            place = at(x) if callable(at) else x[list(at)]
            rule = f"{len(place)} numbers"
            require(len(point) == len(place), "point", [*point], rule)
            offset = [*point]
            if turn is not None:
                ahead, left, *up = point
                c, s = cos(x[turn]), sin(x[turn])
                offset = [c * ahead - s * left, s * ahead + c * left, *up]
            return np.array([p + o for p, o in zip(place, offset, strict=True)])

        return position

    def altered(self, mass: float, drag: float) -> Vehicle:
        """Returns the true vehicle, where it differs from the modelled one.

        Args:
            mass: The ratio of its true mass to the modelled one, the field ``mass``.
            drag: The ratio of its true drag to the modelled one, the field ``drag``.

        Raises:
            InvalidValueError: The vehicle has no such field.
        """
        changes = {}
        for name, ratio in (("mass", mass), ("drag", drag)):
            if ratio != 1.0:
                rule = f"1, for {tag_of(type(self))} has no {name}"
                require(hasattr(self, name), name, ratio, rule)
                changes[name] = (ratio * np.array(getattr(self, name))).tolist()
        return replace(self, **changes)  # type: ignore[type-var]

    def geometry(self, color: str) -> list[Part]:
        """Returns the parts that show the vehicle in its body frame: by default a ball.

        A part is one of Drake's shapes, such as a `Mesh` of a glTF or Wavefront file.
        For a robot of several bodies, each part names its body.

        Args:
            color: A hexadecimal colour that identifies the vehicle.
        """
        return [Part("ball", Sphere(0.1), color)]

    @property
    def length(self) -> float:
        """The length of the vehicle, seen from above [m]."""
        low, high = bounding_box(of_body(self.geometry("#000000")))
        return float((high - low)[:2].max())

    def pose(self, state: Array) -> RigidTransform:
        """Returns the pose of the body frame at the vehicle's state (n,)."""
        place = np.zeros(3)
        found = self.positions(np.atleast_2d(state))[0]
        place[: len(found)] = found
        turn = 0.0 if self.heading is None else float(state[self.heading])
        return RigidTransform(RotationMatrix.MakeZRotation(turn), place)

    def poses(self, state: Array) -> dict[str, RigidTransform]:
        """Returns the pose of each body's frame, by its name, at the state (n,).

        The body frame of `pose` has the name "", for parts that name no body.
        """
        return {"": self.pose(state)}

    def moved(self, state: Array, offset: Array) -> Array:
        """Returns a state with its position moved by an offset (k,), to first order.

        The change of the state (n,) is the smallest possible.
        """
        steps = 1e-6 * np.eye(len(state))
        away = self.positions(state + steps) - self.positions(state - steps)
        found: Array = state + np.linalg.pinv(away.T / 2e-6, rcond=1e-6) @ offset
        return found

    def positions(self, states: Array) -> Array:
        """Returns the vehicle's positions, (T, k) [m], at its states (T, n)."""
        if callable(self.position):
            return np.array([self.position(x) for x in states], dtype=float)
        found: Array = states[:, list(self.position)]
        return found


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
    """The names and units of one kind, one each or none."""
    found = []
    for what, alike in (("names", "different "), ("units", "")):
        given = getattr(plant, f"{kind}_{what}", None) or ()
        known = len(given) in (0, size) and all(isinstance(w, str) for w in given)
        known = known and (not alike or len({*given}) == len(given))
        rule = f"{size} {alike}texts, or none"
        require(known, f"make_plant().{kind}_{what}", given, rule)
        found.append(given)
    names, units = found
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
