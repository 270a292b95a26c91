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
        lower: Lower limit of each input, in its unit, (m,); -.inf for none, with
            methods without a volume barrier; empty for the vehicle's own limits, if it
            has some.
        upper: Upper limit of each input, in its unit, (m,); .inf for none. An input
            with equal limits is fixed, like a dead actuator.
        A: Further limits A u <= b, (k, m), for example of coupled actuators.
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
        gains: K = (k1, k2) of (E4), one per derivative of h until the input appears;
            the roots of s^2 + k1 s + k2 are real and negative.
        robust: Whether the chain is robust at every level against a disturbance that
            enters before the input (E8, the robust chain).
    """

    form: SphereForm = "distance"
    gains: list[Positive] = field(default_factory=lambda: [10.0, 3.55])
    robust: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        rule = "of a polynomial (E4) with real and negative roots"
        if len(self.gains) <= 2:
            rule = "[k1] or [k1, k2], with k1 > 0 and 0 < k2 <= k1^2 / 4"
        try:
            decay_rates(np.array(self.gains), "gains")
        except ValueError:
            require(False, "gains", self.gains, rule)


@dataclass(kw_only=True)
class Separation(BarrierGains):
    """The barrier that keeps a vehicle apart from the others of its scenario.

    At every tick, its filter receives the position and the velocity of each of them,
    and assumes that the velocity stays constant. A row that allows for any acceleration
    of a bounded norm is that of a distance which is `margin` greater (theory.md, "Other
    vehicles").

    Attributes:
        distance: Least distance between the positions [m]; 0 for a single vehicle.
        acceleration: Bound on the acceleration of every other vehicle [m/s^2]; with 0
            the filter assumes constant velocities, and nothing is guaranteed.
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
    """The fixed-step integration of the plant.

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
        std: Standard deviation of each state, in its unit; empty for no noise.
        seed: Seed of the generator.
    """

    std: list[NotNegative] = field(default_factory=list)
    seed: NotNegativeInt = 0


@dataclass
class Hardware(Checked):
    """Hardware in the loop: how both sides respond to missing messages.

    Attributes:
        fallback: The action of a vehicle without commands: "zero" input, or "brake".
        brake_rate: Decay rate of a braking vehicle's speed [1/s].
        command_timeout: Age of a command at which the vehicle falls back [s].
        max_state_age: Age of a state at which the controller no longer acts on it [s].
        hold_time: Time for which the controller then holds its command, before it
            requests the fallback [s].
        longest_interval: Longest interval between states that the observer bridges [s].
        predict: Whether controller and filter act on the state predicted over the
            link's delays.
        audit: The response to measurements that refute the filter's hypotheses: the
            vehicle's "fallback", or a "report" alone.
        obstacles: Whether the obstacles on the bus are compared with the "known" ones
            of the scenario, or are the "perceived" ones that the filter avoids.
        most_obstacles: Greatest number of perceived obstacles.
        max_obstacle_age: Age at which perceived obstacles are no longer used [s].
        max_clock_offset: Greatest offset between the clocks of vehicle and controller
            [s].
        key_file: File with the key that signs the messages; empty for none.
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
