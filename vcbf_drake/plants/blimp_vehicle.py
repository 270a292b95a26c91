"""The blimp as a vehicle: its plant with its point-to-point controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from vcbf_drake.plants.blimp import Blimp, BlimpParameters
from vcbf_drake.plants.blimp_controller import (
    BlimpController,
    BlimpControllerParameters,
)
from vcbf_drake.plants.shapes import Part, painted_model
from vcbf_drake.plants.vehicle import Vehicle


@dataclass
class BlimpVehicle(BlimpParameters, Vehicle):
    """A `Blimp` that a `BlimpController` flies: the parameters of both.

    Attributes:
        controller: Gains and caps of the controller (E81, the blimp's controller).
    """

    controller: BlimpControllerParameters = field(
        default_factory=BlimpControllerParameters
    )

    position = Blimp.position_indices
    heading = 3
    length = 0.77  # Of its envelope, without the fins [m].

    def make_plant(self) -> Blimp:
        """Returns the blimp."""
        return Blimp(self)

    def geometry(self, color: str) -> list[Part]:
        """Returns an airship with its envelope in a colour."""
        return [Part("airship", painted_model("blimp", color))]

    def make_controller(self, target: Sequence[float]) -> BlimpController:
        """Returns the controller that flies the blimp to a target."""
        return BlimpController(target, self.controller, self)

    def altered(self, mass: float, drag: float) -> BlimpVehicle:
        """Returns a blimp of other mass, inertia and drag; see `Vehicle`."""
        return replace(
            self,
            mass=mass * self.mass,
            added_mass=[mass * each for each in self.added_mass],
            drag=[drag * each for each in self.drag],
            yaw_inertia=mass * self.yaw_inertia,
            yaw_drag=drag * self.yaw_drag,
        )
