"""Several vehicles in one scenario, each with a filter of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
import math
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    System,
)

from vcbf_drake.barriers import PerceivedSpheres
from vcbf_drake.checks import Array, require
from vcbf_drake.errors import ModelError, Path as KeyPath, ScenarioError, below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import Assumption
from vcbf_drake.safety.settings import METHODS
from vcbf_drake.simulation.audit import finding
from vcbf_drake.simulation.loop import make_loop
from vcbf_drake.simulation.scenario import Scenario, validate
from vcbf_drake.typed import check_fields, typed

OTHERS = "other vehicles"
# The settings that all vehicles of a fleet share, since they share the time.
_SHARED = ("period", "duration", "integrator", "ends_at_target")
_STEP = 1e-6  # Of the derivative along a velocity [s].
_TOLD = 1e-5  # The tolerance of an acceleration for rounding, relative to its bound.


@dataclass(kw_only=True)
class Fleet:
    """Vehicles that share a time and a place: several, or a scenario's only one.

    Each has its own controller, filter, observer and disturbance. Where there are
    several, the filter of each receives positions and velocities of the others, and
    keeps `Separation.distance` from them; a run ends for all where it ends for one.

    Attributes:
        name: The name of the results; in a file, its top-level key.
        vehicles: Their scenarios; of several, each has a name of its own.
        locate: Returns where a value was written, from its path; None if nowhere.
    """

    name: str = ""
    vehicles: list[Scenario]

    def __post_init__(self) -> None:
        check_fields(self)
        self.locate: Callable[[KeyPath], str] | None = None
        require(len(self.vehicles) > 0, "vehicles", "none", "one at least")
        self.name = self.name or self.vehicles[0].name
        first = self.vehicles[0]
        names = [each.name for each in self.vehicles]
        for i, each in enumerate(self.vehicles if len(names) > 1 else ()):
            with below("vehicles", i):
                is_own = each.name != "" and names.count(each.name) == 1
                rule = "a name that no other vehicle has"
                require(is_own, "name", each.name, rule)
                for key in _SHARED:
                    value, shared = getattr(each, key), getattr(first, key)
                    rule = f"{shared}, as of the first vehicle: they share the time"
                    require(value == shared, key, value, rule)
                rule = f"of {len(first.target)} numbers, like the first vehicle's:"
                rule += " all are in the plane, or all in space"
                is_like = len(each.target) == len(first.target)
                require(is_like, "target", each.target, rule)
                distance, sight = each.separation.distance, each.faults.sight
                rule = "above 0 where there are other vehicles"
                require(distance > 0.0, ("separation", "distance"), distance, rule)
                rule = "0 where there are other vehicles"
                require(sight == 0.0, ("faults", "sight"), sight, rule)
                rule = "none where there are other vehicles, whose motion nobody knows"
                is_none = each.between_ticks == "none"
                require(is_none, "between_ticks", each.between_ticks, rule)
        for i, j in combinations(range(len(names)), 2):
            one, other = self.vehicles[i], self.vehicles[j]
            least = max(each.separation.distance for each in (one, other))
            away = math.dist(one.start, other.start)
            rule = f"over {least:g} m from vehicle {one.name}; it is {away:.3g} m away"
            place = ("vehicles", j, "initial_state")
            require(away > least, place, other.initial_state, rule)

    @staticmethod
    def of(scenario: Scenario) -> Fleet:
        """Returns a scenario's only vehicle as a fleet."""
        return Fleet(name=scenario.name, vehicles=[scenario])

    def only(self, source: str | Path) -> Scenario:
        """Returns the scenario of the only vehicle.

        Args:
            source: Where the fleet is from, for the message.

        Raises:
            ScenarioError: There are several.
        """
        if len(self.vehicles) > 1:
            names = ", ".join(each.name for each in self.vehicles)
            found = f"{len(self.vehicles)} vehicles ({names})"
            raise ScenarioError(f"{source}: {found}, where one is needed")
        return self.vehicles[0]

    def set_method(self, method: str) -> None:
        """Gives each vehicle the filter of a method.

        Raises:
            InvalidValueError: There is no such method, or a vehicle cannot have it.
        """
        for each in self.vehicles:
            each.method = method
            validate(each)

    @contextmanager
    def located(self) -> Iterator[None]:
        """Adds its place to what only the loop finds wrong with a value.

        Raises:
            ScenarioError: From a `ModelError`, if the fleet is from a file.
        """
        try:
            yield
        except ModelError as error:
            if self.locate is None:
                raise
            place = self.locate(getattr(error, "path", ()))
            raise ScenarioError(f"{place}: {error}") from error

    @property
    def duration(self) -> float:
        """Length of the run [s]."""
        return self.vehicles[0].duration


@typed
def make_fleet_loop(fleet: Fleet, controller: System | None = None) -> Diagram:
    """Returns the closed loops of a fleet: `make_loop` of a scenario's only vehicle.

    For several vehicles, each loop is a diagram with its vehicle's name, and a system
    ``seen by: NAME`` reports the others to its filter.

    Args:
        fleet: The vehicles.
        controller: In the place of an only vehicle's own, with its ports.
    """
    if len(fleet.vehicles) == 1:
        with fleet.located():
            return make_loop(fleet.vehicles[0], controller)
    builder, loops = DiagramBuilder(), dict[str, Diagram]()
    for i, own in enumerate(fleet.vehicles):
        names = [each.name for each in fleet.vehicles if each is not own]
        with fleet.located(), below("vehicles", i):
            loop = make_loop(own, None, names)
        loops[own.name] = builder.AddNamedSystem(own.name, loop)
    for own in fleet.vehicles:
        others = [each for each in fleet.vehicles if each is not own]
        models = [loops[e.name].GetSubsystemByName("filter").model for e in others]
        seeing = OtherVehicles(others, models, own.separation.distance)
        # No vehicle's name has a colon.
        builder.AddNamedSystem(f"seen by: {own.name}", seeing)
        for each in others:
            for port in ("state", "held_input"):
                told = seeing.GetInputPort(f"{each.name}: {port}")
                builder.Connect(loops[each.name].GetOutputPort(port), told)
        asking = loops[own.name].GetInputPort("others")
        builder.Connect(seeing.get_output_port(), asking)
    diagram = builder.Build()
    diagram.set_name(fleet.name)
    return diagram


def loops_of(diagram: Diagram, fleet: Fleet) -> list[Diagram]:
    """Returns the diagram of each vehicle's loop in that of `make_fleet_loop`."""
    if len(fleet.vehicles) == 1:
        return [diagram]
    return [diagram.GetSubsystemByName(each.name) for each in fleet.vehicles]


class OtherVehicles(LeafSystem):
    """Reports the positions and velocities of the others to one vehicle's filter.

    The input ports ``NAME: state`` and ``NAME: held_input`` are the others'; the output
    ``obstacles`` is what `PerceivedSpheres` describes, one slot a vehicle. A velocity
    is that of the other's model under its held input, which at a tick is still the
    input of the last period: if the input is the velocity, it is one period old.
    """

    def __init__(
        self,
        others: Sequence[Scenario],
        models: Sequence[ControlAffineModel],
        distance: float,
    ) -> None:
        """Declares the ports.

        Args:
            others: The other vehicles.
            models: The models of their plants.
            distance: The distance to keep from each [m].
        """
        super().__init__()
        self._others, self._models, self._distance = others, models, distance
        self._spheres = PerceivedSpheres(len(others), len(others[0].target))
        self._ports = [
            (
                self.DeclareVectorInputPort(f"{each.name}: state", model.num_states),
                self.DeclareVectorInputPort(
                    f"{each.name}: held_input", model.num_inputs
                ),
            )
            for each, model in zip(others, models, strict=True)
        ]
        self.DeclareVectorOutputPort("obstacles", self._spheres.size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        places, velocities = [], []
        for each, model, ports in zip(
            self._others, self._models, self._ports, strict=True
        ):
            x, u = (port.Eval(context) for port in ports)
            step = _STEP * model.nominal_rate(x, u)
            place, before, after = each.vehicle.positions(
                np.array([x, x - step, x + step])
            )
            places.append(place)
            velocities.append((after - before) / (2.0 * _STEP))
        radii = np.full(len(places), self._distance)
        output.SetFromVector(self._spheres.pack(places, velocities, radii))


def others_assumption(scenario: Scenario) -> Assumption:
    """Returns the hypothesis on how the others of a scenario's vehicle accelerate."""
    bound, method = scenario.separation.acceleration, METHODS[scenario.method]
    return Assumption(
        OTHERS,
        "no other vehicle accelerates by more than separation.acceleration, and no"
        " volume row takes them to keep their velocity",
        bound > 0.0 and not method.has_volume_row,
        {"separation.acceleration": bound},
        "the others may come closer than is allowed for; give separation.acceleration,"
        " and a method without a volume barrier",
    )


def others_finding(log: Mapping[str, Array], scenario: Scenario) -> dict[str, Any]:
    """Returns the finding of how the other vehicles accelerated, from tick to tick.

    In a motion within the bound, velocity and position deviate from the last tick's
    message by no more than that acceleration allows.
    """
    k, time = len(scenario.target), log["time"]
    seen = log["obstacles"].reshape(len(time), -1, 2 * k + 2)
    places, velocities = seen[:, :, :k], seen[:, :, k : 2 * k]
    elapsed = np.diff(time)[:, None]
    strayed = np.diff(places, axis=0) - velocities[:-1] * elapsed[..., None]
    most = np.zeros(len(time))
    most[1:] = np.maximum(
        np.linalg.norm(np.diff(velocities, axis=0), axis=2) / elapsed,
        np.linalg.norm(strayed, axis=2) * 2.0 / elapsed**2,
    ).max(axis=1)
    bound = scenario.separation.acceleration
    statement = "the others' accelerations <= separation.acceleration [m/s^2]"
    found = finding(statement, time, bound - most, _TOLD * bound)
    return found if bound > 0.0 else found | {"held": None}


def least_separation(places: Sequence[Array], own: int) -> float:
    """Returns the least distance of a vehicle from the others [m].

    Args:
        places: Each vehicle's positions at the integrator's steps, (S, k) [m].
        own: Which vehicle.
    """
    others = [each for i, each in enumerate(places) if i != own]
    away = [np.linalg.norm(each - places[own], axis=1).min() for each in others]
    return float(min(away))
