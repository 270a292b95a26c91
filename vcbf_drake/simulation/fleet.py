"""Several vehicles in one scenario, each with a filter of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
import math
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
from vcbf_drake.errors import below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import Assumption
from vcbf_drake.safety.settings import METHODS
from vcbf_drake.simulation.audit import finding
from vcbf_drake.simulation.loop import make_loop
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.typed import check_fields, typed

OTHERS = "other vehicles"
# What all vehicles of a fleet have in common: they share the time.
_SHARED = ("period", "duration", "integrator", "ends_at_target")
_STEP = 1e-6  # Of the derivative along a velocity [s].


@dataclass(kw_only=True)
class Fleet:
    """Vehicles that share a time and a place: several, or a scenario's only one.

    Each has its own controller, filter, observer and disturbance. Where there are
    several, the filter of each is told where the others are and how fast, and keeps
    `Separation.distance` from them; a run ends for all where it ends for one.

    Attributes:
        name: What results are called; in a file, its top-level key.
        vehicles: Their scenarios; of several, each has a name of its own.
    """

    name: str = ""
    vehicles: list[Scenario]

    def __post_init__(self) -> None:
        check_fields(self)
        require(len(self.vehicles) > 0, "vehicles", "none", "one at least")
        self.name = self.name or self.vehicles[0].name
        first = self.vehicles[0]
        names = [each.name for each in self.vehicles]
        for i, each in enumerate(self.vehicles if len(names) > 1 else ()):
            with below("vehicles", i):
                rule = "a name that no other vehicle has"
                require(
                    each.name != "" and names.count(each.name) == 1,
                    "name",
                    each.name,
                    rule,
                )
                for key in _SHARED:
                    value, shared = getattr(each, key), getattr(first, key)
                    rule = f"{shared}, as of the first vehicle: they share the time"
                    require(value == shared, key, value, rule)
                rule = f"of {len(first.target)} numbers, like the first vehicle's"
                is_like = len(each.target) == len(first.target)
                require(is_like, "target", each.target, rule)
                distance, sight = each.separation.distance, each.faults.sight
                rule = "above 0 where there are other vehicles"
                require(distance > 0.0, ("separation", "distance"), distance, rule)
                rule = "0 where there are other vehicles"
                require(sight == 0.0, ("faults", "sight"), sight, rule)
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

    @property
    def duration(self) -> float:
        """Length of the run [s]."""
        return self.vehicles[0].duration


@typed
def make_fleet_loop(fleet: Fleet, controller: System | None = None) -> Diagram:
    """Returns the closed loops of a fleet: `make_loop` of a scenario's only vehicle.

    Of several each is a diagram with its vehicle's name, and a system
    ``seen_by_NAME`` tells its filter of the others.

    Args:
        fleet: The vehicles.
        controller: In the place of an only vehicle's own, with its ports.
    """
    if len(fleet.vehicles) == 1:
        return make_loop(fleet.vehicles[0], controller)
    builder, loops = DiagramBuilder(), []
    for each in fleet.vehicles:
        spheres = PerceivedSpheres(
            len(fleet.vehicles) - 1, len(each.target), each.separation.form
        )
        loops.append(builder.AddNamedSystem(each.name, make_loop(each, None, spheres)))
    for own, loop in zip(fleet.vehicles, loops, strict=True):
        others = [
            (each, other)
            for each, other in zip(fleet.vehicles, loops, strict=True)
            if each is not own
        ]
        models = [other.GetSubsystemByName("filter").model for _, other in others]
        seeing = builder.AddNamedSystem(
            f"seen_by_{own.name}",
            OtherVehicles(
                [each for each, _ in others], models, own.separation.distance
            ),
        )
        for each, other in others:
            builder.Connect(
                other.GetOutputPort("state"), seeing.GetInputPort(each.name)
            )
        builder.Connect(seeing.get_output_port(), loop.GetInputPort("others"))
    diagram = builder.Build()
    diagram.set_name(fleet.name)
    return diagram


def loops_of(diagram: Diagram, fleet: Fleet) -> list[Diagram]:
    """Returns the diagram of each vehicle's loop.

    Args:
        diagram: What `make_fleet_loop` made.
        fleet: Of what.
    """
    if len(fleet.vehicles) == 1:
        return [diagram]
    return [diagram.GetSubsystemByName(each.name) for each in fleet.vehicles]


class OtherVehicles(LeafSystem):
    """Tells one vehicle's filter where the others are, and how fast.

    The input ports are the others' states, by their names; the output ``obstacles`` is
    what `PerceivedSpheres` describes, one slot a vehicle. A velocity is what the model
    of the other says without its inputs and disturbance, which reach no position's
    first derivative.
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
            models: Of their plants.
            distance: The distance to keep from each [m].
        """
        super().__init__()
        self._others, self._models, self._distance = others, models, distance
        self._spheres = PerceivedSpheres(len(others), len(others[0].target))
        self._states = [
            self.DeclareVectorInputPort(each.name, model.num_states)
            for each, model in zip(others, models, strict=True)
        ]
        self.DeclareVectorOutputPort("obstacles", self._spheres.size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        places, velocities = [], []
        for each, model, port in zip(
            self._others, self._models, self._states, strict=True
        ):
            x = port.Eval(context)
            step = _STEP * model.drift(x)
            place, before, after = each.vehicle.positions(
                np.array([x, x - step, x + step])
            )
            places.append(place)
            velocities.append((after - before) / (2.0 * _STEP))
        radii = np.full(len(places), self._distance)
        output.SetFromVector(self._spheres.pack(places, velocities, radii))


def others_assumption(scenario: Scenario) -> Assumption:
    """Returns the hypothesis on how the other vehicles accelerate.

    Args:
        scenario: Of the vehicle that keeps apart.
    """
    bound = scenario.separation.acceleration
    has_volume_row = METHODS[scenario.method].has_volume_row
    return Assumption(
        OTHERS,
        "no other vehicle accelerates by more than separation.acceleration, and no"
        " volume row takes them to keep their velocity",
        bound > 0.0 and not has_volume_row,
        {"separation.acceleration": bound},
        "the others may come closer than the rows and the volume row allow for; give"
        " separation.acceleration, and a method without a volume barrier",
    )


def others_finding(log: Mapping[str, Array], scenario: Scenario) -> dict[str, Any]:
    """Returns the finding of how the other vehicles accelerated, from tick to tick.

    Args:
        log: The arrays of the log, one row a control tick.
        scenario: Of the vehicle that keeps apart.
    """
    k, time = len(scenario.target), log["time"]
    seen = log["obstacles"].reshape(len(time), -1, 2 * k + 2)
    change = np.linalg.norm(np.diff(seen[:, :, k : 2 * k], axis=0), axis=2)
    most = np.max(change, axis=1, initial=0.0) / np.diff(time)
    bound = scenario.separation.acceleration
    statement = "the others' accelerations <= separation.acceleration [m/s^2]"
    found = finding(statement, time[1:], bound - most)
    return found if bound > 0.0 else found | {"held": None}


def least_separation(places: Sequence[Array], own: int) -> float:
    """Returns the least distance of a vehicle from the others [m].

    Args:
        places: Where each vehicle was at the integrator's steps, (S, k) [m].
        own: Which vehicle.
    """
    others = [each for i, each in enumerate(places) if i != own]
    away = [np.linalg.norm(each - places[own], axis=1).min() for each in others]
    return float(min(away))
