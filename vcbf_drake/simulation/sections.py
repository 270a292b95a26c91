"""The sections of a scenario: limits, gains, integrator, noise and hardware."""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import Literal

import numpy as np
from pydrake.systems.analysis import GetIntegrationSchemes

from vcbf_drake.barriers.barrier import decay_rates
from vcbf_drake.barriers.obstacles import SphereForm
from vcbf_drake.checks import check_finite, require, require_choice
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.files import IS_FILE
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.typed import (
    Checked,
    NotNegative,
    NotNegativeInt,
    Positive,
    PositiveInt,
    check_fields,
)

Fallback = Literal["zero", "brake"]
AuditPolicy = Literal["fallback", "report"]
ObstacleSource = Literal["known", "perceived"]


@dataclass
class InputLimits:
    """The inputs that the actuators can deliver: a box, and further rows if any.

    Attributes:
        lower: Least value of each input, in its unit, (m,); -.inf for none, where the
            method has no volume barrier; empty for the vehicle's own limits, where it
            has some.
        upper: Greatest value of each input, in its unit, (m,); .inf for none. An input
            whose limits are equal is fixed, as of a dead actuator.
        A: Further limits A u <= b, (k, m): coupled actuators, for example.
        b: Their right-hand sides, (k,).
    """

    lower: list[float] = field(default_factory=list)
    upper: list[float] = field(default_factory=list)
    A: list[list[float]] = field(default_factory=list)
    b: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_fields(self)
        for name, limits in (("lower", self.lower), ("upper", self.upper)):
            check_finite(name, limits, size=len(limits), infinity_allowed=True)
        if len(self.lower) != len(self.upper):
            raise InvalidValueError(
                (),
                f"{len(self.lower)} numbers in lower and {len(self.upper)} in upper;"
                " it must be one an input in each",
            )
        for j, (least, most) in enumerate(zip(self.lower, self.upper, strict=True)):
            require(least < math.inf, ("lower", j), least, "below infinity")
            require(most > -math.inf, ("upper", j), most, "above minus infinity")
            require(least <= most, ("lower", j), least, f"at most upper, {most:g}")
        for i, row in enumerate(self.A):
            check_finite(("A", i), row, size=len(self.lower))
        check_finite("b", self.b, size=len(self.A))
        if len(self.lower):
            self.input_set()

    def input_set(self) -> InputSet:
        """Returns the set of these inputs.

        Raises:
            VcbfError: No input meets all the limits.
        """
        if not self.A:
            return InputSet.box(np.array(self.lower), np.array(self.upper))
        identity = np.eye(len(self.lower))
        A = np.vstack([identity, -identity, self.A])
        b = np.concatenate([self.upper, np.negative(self.lower), self.b])
        return InputSet(A[b < math.inf], b[b < math.inf])


@dataclass
class BarrierGains:
    """The barrier of each obstacle: its function and its gains.

    Attributes:
        form: h: "distance" to the surface (E77), or "squared" distance difference
            (E80, the car's barrier).
        gains: K = (k1, k2) of (E4), one a derivative of h until the input appears; the
            roots of s^2 + k1 s + k2 are real and negative.
        robust: Whether the worst of a disturbance that reaches h before the input does
            is taken off at every level of its chain (E8, the robust chain).
    """

    form: SphereForm = "distance"
    gains: list[Positive] = field(default_factory=lambda: [10.0, 3.55])
    robust: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        try:
            decay_rates(np.array(self.gains), "obstacles")
        except ValueError as error:
            raise InvalidValueError("gains", f"{self.gains}; {error}") from None


@dataclass(kw_only=True)
class Separation(BarrierGains):
    """How a vehicle keeps apart from the others of its scenario.

    Its filter is told, at every tick, where each of them is and how fast, and takes it
    to keep that velocity. A row that allows for any acceleration of a bounded norm is
    that of a distance which is `margin` greater (theory.md, "Other vehicles").

    Attributes:
        distance: Least distance between the positions [m]; 0 where there is no other.
        acceleration: The most that any other vehicle accelerates [m/s^2]; with 0 the
            filter takes it to keep its velocity, and nothing is guaranteed.
    """

    distance: NotNegative = 0.0
    acceleration: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        is_second = self.acceleration == 0.0 or (
            self.form == "distance" and len(self.gains) == 2
        )
        rule = "0 but for two gains and the form distance"
        require(is_second, "acceleration", self.acceleration, rule)

    @property
    def margin(self) -> float:
        """The distance that is kept for what the others' accelerations do [m]."""
        return self.acceleration / self.gains[-1]


@dataclass
class Integrator:
    """How the plant is integrated, at fixed steps.

    Attributes:
        scheme: One of Drake's integration schemes.
        max_step: Longest step [s]; 0 means the control period, at most 10 ms.
    """

    scheme: str = "runge_kutta3"
    max_step: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        require_choice("scheme", self.scheme, GetIntegrationSchemes())


@dataclass
class MeasurementNoise(Checked):
    """White Gaussian noise on the measured state, drawn anew at each control tick.

    Attributes:
        std: Standard deviation for each state, in its unit; empty for none.
        seed: Seed of the generator.
    """

    std: list[NotNegative] = field(default_factory=list)
    seed: NotNegativeInt = 0


@dataclass
class Hardware(Checked):
    """A vehicle on a bus: what both sides do when messages fail to come.

    Attributes:
        fallback: What a vehicle without commands does: "zero" input, or "brake".
        brake_rate: How fast a braking vehicle's speed decays [1/s].
        command_timeout: Age at which the vehicle does not follow its last command any
            more [s].
        max_state_age: Age at which the controller does not act on a state any more [s].
        hold_time: How long it then holds its command before it asks for the fallback
            [s].
        longest_interval: The longest interval between states that the observer bridges
            [s].
        predict: Whether controller and filter act on the state predicted over the
            link's delays.
        audit: What a measurement leads to that refutes the filter's hypotheses: the
            vehicle's "fallback", or a "report" alone.
        obstacles: "known" ones are compared with those on the bus; "perceived" ones are
            those on the bus.
        most_obstacles: How many may be perceived at once.
        max_obstacle_age: Age at which they are not acted on any more [s].
        max_clock_offset: How far the clocks of vehicle and controller may be apart [s].
        key_file: A file whose bytes are the key that messages are signed with; empty
            for none.
    """

    fallback: Fallback = "brake"
    brake_rate: Positive = 2.0
    command_timeout: Positive = 0.1
    max_state_age: Positive = 0.1
    hold_time: NotNegative = 0.1
    longest_interval: Positive = 0.1
    predict: bool = False
    audit: AuditPolicy = "fallback"
    obstacles: ObstacleSource = "known"
    most_obstacles: PositiveInt = 16
    max_obstacle_age: Positive = 1.0
    max_clock_offset: Positive = 60.0
    key_file: str = field(default="", metadata=IS_FILE)
