"""A scenario: everything that one vehicle's run needs, as plain dataclasses.

Each class checks itself when it is made. A value that is not allowed is answered by an
`InvalidValueError` that names the field, the value and what is allowed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
import math
import re
from typing import Any, ClassVar

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from vcbf_drake.barriers.obstacles import SphereObstacle
from vcbf_drake.checks import check_finite, require
from vcbf_drake.disturbances.source import (
    BandLimitedNoise,
    Constant,
    DisturbanceSource,
    Recorded,
    Sinusoid,
    SmoothStep,
)
from vcbf_drake.errors import InvalidValueError, Path, below
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Vehicle
from vcbf_drake.plants.contract import check_returns, checked_plant, num_coordinates
from vcbf_drake.plants.vehicle import Channels, channels_of
from vcbf_drake.safety.settings import METHODS, FilterSettings
from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.obstacles import (
    AnyObstacle,
    BodyPoint,
    check_fits,
    check_limits,
    check_places,
    with_files_read,
)
from vcbf_drake.simulation.sections import (
    BarrierGains,
    Hardware,
    InputLimits,
    Integrator,
    MeasurementNoise,
    Separation,
)
from vcbf_drake.typed import Positive, check_fields

# Results are written into a directory of that name.
_NAME = re.compile(r"\w[\w .+-]{0,99}")
# Control periods in a run; its log must fit into a computer.
_MOST_TICKS = 1e7
# Velocities of a MultibodyPlant whose barriers are derived in symbols within seconds.
_MOST_SYMBOLIC = 3
# The arrival tolerance of a long way [m].
_ARRIVAL = 0.3
# A run that is longer than this is blamed for its ticks; of a shorter one, the period.
_LONG = 3600.0


@dataclass(kw_only=True)
class Scenario(FilterSettings):
    """One run: a plant, its disturbance and obstacles, its task, and a safety filter.

    Attributes:
        name: Name of the results; in a file, the top-level key.
        description: Description of the run; its first line is the title.
        vehicle: The robot: its plant, its controller, and its own limits.
        input_set: The inputs that the actuators can deliver.
        disturbance: The signals whose sum is the disturbance [m/s^2].
        obstacles: The obstacles to avoid; those of files are read when the scenario is
            made.
        body: The points of the robot that keep clear of the obstacles, each with a ball
            around it; empty for its position.
        barrier: Form and gains of the obstacles' barriers.
        separation: The barrier between this vehicle and each other vehicle.
        initial_state: State at time zero, in the plant's units, (n,).
        target: Position to reach [m].
        duration: Length of the run [s].
        arrival_tolerance: Distance from the target that counts as arrival [m]; null for
            a tenth of the distance from start to target, at most 0.3.
        ends_at_target: Whether a simulation ends on arrival.
        integrator: The integrator.
        noise: Noise on the measured state.
        faults: Faults of the loop, unknown to the filter.
        hardware: Settings of hardware in the loop over LCM.
    """

    # The new keys of values in older files.
    MOVED: ClassVar[dict[str, str]] = {
        "plant": "part of vehicle",
        "controller": "vehicle.controller",
        "turn_limit": "vehicle.turn_limit",
        "corrections": "fidelity",
    }

    name: str = ""
    description: str = ""
    # A run's summary says it.
    warn: bool = False
    vehicle: Vehicle
    input_set: InputLimits = field(default_factory=InputLimits)
    disturbance: list[
        Constant | Sinusoid | SmoothStep | BandLimitedNoise | Recorded
    ] = field(default_factory=list)
    obstacles: list[AnyObstacle] = field(default_factory=list)
    body: list[BodyPoint] = field(default_factory=list)
    barrier: BarrierGains = field(default_factory=BarrierGains)
    separation: Separation = field(default_factory=Separation)
    initial_state: list[float]
    target: list[float]
    duration: Positive = 20.0
    arrival_tolerance: Positive | None = None
    ends_at_target: bool = False
    integrator: Integrator = field(default_factory=Integrator)
    noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    faults: Faults = field(default_factory=Faults)
    hardware: Hardware = field(default_factory=Hardware)

    def __post_init__(self) -> None:
        check_fields(self)
        numbered = [*with_files_read(self.obstacles)]
        require(
            not self.name or _NAME.fullmatch(self.name) is not None,
            "name",
            self.name,
            "at most 100 letters, digits, spaces and _ . + -, a letter or digit first",
        )
        self._check_times()
        super().__post_init__()
        if not len(self.input_set.lower):
            own = self.vehicle.input_limits() or ([], [])
            self.input_set = InputLimits(*own, self.input_set.A, self.input_set.b)
        self._check_sizes(numbered)
        require(
            not METHODS[self.method].has_volume_row
            or self.input_set.input_set().is_bounded,
            "input_set",
            [*self.input_set.lower, *self.input_set.upper],
            f"finite for the volume barrier of {self.method}; dob-cbf-qp has none",
        )
        self._check_places(numbered)
        self.obstacles = [obstacle for _, obstacle in numbered]

    def _check_times(self) -> None:
        duration, period = self.duration, self.period
        most = _MOST_TICKS * period
        rule = f"at most {most:g} s, {_MOST_TICKS:g} ticks of {period:g} s"
        require(duration <= max(most, _LONG), "duration", duration, rule)
        least = duration / _MOST_TICKS
        rule = f"at least {least:g} s, for {_MOST_TICKS:g} ticks"
        require(period >= least, "period", period, rule)
        rule = f"at most the duration, {duration:g} s"
        require(period <= duration, "period", period, rule)
        delay = self.faults.measurement_delay
        require(delay <= duration, ("faults", "measurement_delay"), delay, rule)
        # A simulation at a low rate need not satisfy the limits of a bus.
        if self.hardware != Hardware():
            self.check_hardware_times()

    def check_hardware_times(self) -> None:
        """Checks that no watchdog responds between one message and the next.

        Raises:
            InvalidValueError: A time limit is not above the control period.
        """
        rule = f"above the control period, {self.period:g} s"
        for name in ("command_timeout", "max_state_age"):
            limit = getattr(self.hardware, name)
            require(limit > self.period, ("hardware", name), limit, rule)

    def _check_sizes(self, numbered: Sequence[tuple[int, AnyObstacle]]) -> None:
        plant = checked_plant(self.vehicle)
        channels = channels_of(plant)
        states, inputs = channels.states, channels.inputs
        if isinstance(plant, MultibodyPlant) and self.between_ticks == "certified":
            joints, rule = plant.num_velocities(), f"none for over {_MOST_SYMBOLIC}"
            is_small = joints <= _MOST_SYMBOLIC
            require(is_small, "between_ticks", f"certified, {joints} velocities", rule)
        check_finite("initial_state", self.initial_state, names=[*states])
        require(
            len(self.input_set.lower) == len(inputs),
            ("input_set", "lower"),
            self.input_set.lower,
            f"{len(inputs)} numbers, one each of {', '.join(inputs)}",
        )
        size = num_coordinates(self.vehicle, self.initial_state)
        at = self.vehicle.position
        axes = [*"xyz"][:size] if callable(at) else [[*states][i] for i in at]
        check_finite("target", self.target, names=axes)
        for i, obstacle in numbered:
            check_fits(obstacle, ("obstacles", i), [*states], size)
        for path, numbers in (
            (("noise", "std"), self.noise.std),
            (("faults", "measurement_bias"), self.faults.measurement_bias),
        ):
            check_finite(path, numbers, names=[*states] if len(numbers) else ())
        for i, gust in enumerate(self.faults.gusts):
            where = ("faults", "gusts", i, "amplitude")
            check_finite(where, gust.amplitude, size=len(channels.disturbances))
        self._check_turns(channels)
        size = len(channels.disturbances)
        for i, signal in enumerate(self.disturbance):
            with below("disturbance", i):
                found = signal.curve(self.duration).size
                if found != size:
                    raise InvalidValueError(
                        (),
                        f"has {found} channels; it must have {size},"
                        " one per disturbed state",
                    )

    def _check_turns(self, channels: Channels) -> None:
        names = [*channels.states]
        for i in channels.angles:
            angle = self.initial_state[i]
            rule = f"radians, from -2 pi to 2 pi; was {names[i]} meant in degrees?"
            require(abs(angle) <= 2.0 * math.pi, ("initial_state", i), angle, rule)
        for i in channels.quaternions:
            four = self.initial_state[i : i + 4]
            is_turn = abs(np.linalg.norm(four) - 1.0) < 1e-3
            rule = f"{', '.join(names[i : i + 4])} of length 1, 1, 0, 0, 0 for no turn"
            require(bool(is_turn), ("initial_state", i), four, rule)

    def make_model(self) -> ControlAffineModel:
        """Returns the vehicle's model: what holds between ticks needs it in symbols."""
        symbolic = self.between_ticks == "certified"
        plant = self.vehicle.make_plant()
        return ControlAffineModel.from_system(plant, symbolic=symbolic)

    def make_source(self) -> DisturbanceSource:
        """Returns the disturbance."""
        channels = channels_of(self.vehicle.make_plant())
        size = len(channels.disturbances)
        return DisturbanceSource(self.disturbance, self.duration, size)

    @property
    def start(self) -> list[float]:
        """The position of the vehicle at time zero [m]."""
        states = np.array([self.initial_state])
        return [*map(float, self.vehicle.positions(states)[0])]

    @property
    def arrival_distance(self) -> float:
        """The distance from the target that counts as arrival [m]."""
        if self.arrival_tolerance is not None:
            return self.arrival_tolerance
        way = math.dist(self.start, self.target)
        return min(0.1 * way, _ARRIVAL) if way > 0.0 else _ARRIVAL

    def _check_places(self, numbered: Sequence[tuple[int, AnyObstacle]]) -> None:
        with below("faults"):
            self.vehicle.altered(self.faults.mass, self.faults.drag)
        state = np.array(self.initial_state)
        limits = np.array(self.input_set.lower), np.array(self.input_set.upper)
        check_returns(self.vehicle, state, self.target, limits)
        check_places(self, numbered)
        check_limits(self)

    @property
    def spheres(self) -> list[SphereObstacle]:
        """The obstacles that are spheres: these can be seen and sent over the bus."""
        return [each for each in self.obstacles if isinstance(each, SphereObstacle)]

    @property
    def state_names(self) -> list[str]:
        """The names of the vehicle's states."""
        return [*channels_of(self.vehicle.make_plant()).states]


def validate(value: Any, path: Path = ()) -> None:
    """Checks a scenario, or a part of one, again: its fields may have been assigned.

    Raises:
        InvalidValueError: A field has a value that is not allowed.
    """
    if isinstance(value, list | tuple):
        for index, item in enumerate(value):
            validate(item, (*path, index))
    elif is_dataclass(value):
        for each in fields(value):
            validate(getattr(value, each.name), (*path, each.name))
        if hasattr(value, "__post_init__"):
            with below(*path):
                value.__post_init__()
