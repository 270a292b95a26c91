"""A scenario: everything that one run needs, as plain dataclasses.

They are read and written by ``pydrake.common.yaml``, which looks at the types of the
fields themselves.
"""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

from dataclasses import dataclass, field, fields
from typing import get_type_hints

import numpy as np

from vcbf_drake.disturbances.source import (
    BandLimitedNoise,
    Constant,
    Recorded,
    Sinusoid,
    SmoothStep,
)
from vcbf_drake.plants.blimp import BlimpParameters
from vcbf_drake.plants.blimp_controller import BlimpControllerParameters
from vcbf_drake.plants.car import CarParameters
from vcbf_drake.plants.car_controller import CarControllerParameters
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.settings import FilterSettings
from vcbf_drake.safety.volume_barrier import VolumeBarrier
from vcbf_drake.simulation.faults import Faults

# Its module postpones annotations, which makes them strings.
for _field in fields(VolumeBarrier):
    _field.type = get_type_hints(VolumeBarrier)[_field.name]

# A file has to give it: the default is there for pydrake.common.yaml only.
_REQUIRED = {"required": True}


@dataclass
class InputLimits:
    """The inputs that the actuators can deliver: a box, and further rows if any."""

    # Least value of each input, in its unit, (m,).
    lower: list[float] = field(default_factory=list, metadata=_REQUIRED)
    # Greatest value of each input, in its unit, (m,).
    upper: list[float] = field(default_factory=list, metadata=_REQUIRED)
    # Further limits A u <= b, (k, m): coupled actuators, for example.
    A: list[list[float]] = field(default_factory=list)
    # Their right-hand sides, (k,).
    b: list[float] = field(default_factory=list)

    def input_set(self) -> InputSet:
        """Returns the set of these inputs.

        Raises:
            VcbfError: No input meets all the limits.
        """
        if not self.A:
            return InputSet.box(np.array(self.lower), np.array(self.upper))
        identity = np.eye(len(self.lower))
        return InputSet(
            np.vstack([identity, -identity, self.A]),
            np.concatenate([self.upper, np.negative(self.lower), self.b]),
        )


@dataclass
class TurnLimit:
    """A car's steering: ``|omega| <= curvature sqrt(v^2 + smoothing_speed^2)``."""

    # Greatest curvature of the path [1/m].
    curvature: float = 2.0
    # Speed below which the limit stops shrinking [m/s]; makes it smooth at rest.
    smoothing_speed: float = 0.1


@dataclass
class Obstacle:
    """A sphere (for the car, a disc) to keep out of, standing or moving."""

    # Centre at time zero [m], one number a dimension.
    center: list[float] = field(default_factory=list, metadata=_REQUIRED)
    # Radius [m].
    radius: float = field(default=0.5, metadata=_REQUIRED)
    # Velocity of the centre [m/s]; empty for an obstacle that stands.
    velocity: list[float] = field(default_factory=list)
    # Distance to keep from the surface [m].
    margin: float = 0.0


@dataclass
class BarrierGains:
    """The barrier of each obstacle: its function and its gains."""

    # h: "distance" to the surface (E31), or "squared" distance difference (E35).
    form: str = "distance"
    # K = (k1, k2) of (E4); s^2 + k1 s + k2 has real negative roots.
    gains: list[float] = field(default_factory=lambda: [10.0, 3.55])


@dataclass
class Integrator:
    """How the plant is integrated, at fixed steps."""

    # One of Drake's integration schemes.
    scheme: str = "runge_kutta3"
    # Longest step [s]; 0 means the control period, at most 10 ms.
    max_step: float = 0.0


@dataclass
class MeasurementNoise:
    """White Gaussian noise on the measured state, drawn anew at each control tick."""

    # Standard deviation for each state, in its unit; empty for none.
    std: list[float] = field(default_factory=list)
    # Seed of the generator.
    seed: int = 0


@dataclass
class Hardware:
    """A vehicle on a bus: what both sides do when messages fail to come."""

    # What a vehicle without commands does: "zero" input, or "brake".
    fallback: str = "brake"
    # How fast a braking vehicle's speed decays [1/s].
    brake_rate: float = 2.0
    # Age at which the vehicle does not follow its last command any more [s].
    command_timeout: float = 0.1
    # Age at which the controller does not act on a state any more [s].
    max_state_age: float = 0.1
    # How long it then holds its command before it asks for the fallback [s].
    hold_time: float = 0.1
    # The longest interval between states that the observer bridges [s].
    longest_interval: float = 0.1
    # Whether controller and filter act on the state predicted over the link's delays.
    predict: bool = False


@dataclass
class Scenario(FilterSettings):
    """One run: plant, controller, disturbance, obstacles, start, target, and a filter.

    The filter's settings are those of `FilterSettings`.
    """

    # What results are called; in a file, its top-level key.
    name: str = ""
    # What the run shows; the first line is its title.
    description: str = ""
    # The plant and its physical parameters.
    plant: BlimpParameters | CarParameters = field(default_factory=BlimpParameters)
    # The reference controller, of the same kind as the plant.
    controller: BlimpControllerParameters | CarControllerParameters = field(
        default_factory=BlimpControllerParameters
    )
    # What the actuators can deliver.
    input_set: InputLimits = field(
        default_factory=lambda: InputLimits([-0.25, -0.25, -0.02], [0.25, 0.25, 0.02])
    )
    # The car's steering limit, if any.
    turn_limit: TurnLimit | None = None
    # The disturbance is the sum of these signals [m/s^2].
    disturbance: list[
        Constant | Sinusoid | SmoothStep | BandLimitedNoise | Recorded
    ] = field(default_factory=list)
    # What to keep out of.
    obstacles: list[Obstacle] = field(default_factory=list)
    # How: the barrier of each obstacle.
    barrier: BarrierGains = field(default_factory=BarrierGains)
    # State at time zero, in the plant's units, (n,).
    initial_state: list[float] = field(default_factory=lambda: [0.0] * 8)
    # Position to reach [m].
    target: list[float] = field(default_factory=lambda: [1.0, 0.0, 1.0])
    # Length of the run [s].
    duration: float = 20.0
    # Distance from the target that counts as arrival [m].
    arrival_tolerance: float = 0.3
    # The integrator.
    integrator: Integrator = field(default_factory=Integrator)
    # Noise on the measured state.
    noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    # What is wrong with the loop, unknown to the filter.
    faults: Faults = field(default_factory=Faults)
    # The same over LCM, with a vehicle in another process.
    hardware: Hardware = field(default_factory=Hardware)
