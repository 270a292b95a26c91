"""Faults that a scenario puts into its loop, and the hypotheses they break."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

from collections.abc import Iterator
from dataclasses import dataclass, field
import math

from vcbf_drake.safety.assumptions import Assumption


@dataclass
class StepGust:
    """A push that comes and goes at once: not C2, and not declared."""

    # One value a disturbed channel [m/s^2].
    amplitude: list[float] = field(default_factory=list, metadata={"required": True})
    # When it begins [s].
    start: float = 0.0
    # How long it lasts [s].
    duration: float = 1.0


@dataclass
class Faults:
    """What is wrong with plant, sensors, actuators and solver; by default nothing.

    The filter and its observer know of none of it. Noise is no fault but `noise`.
    """

    # Seed of what is random here.
    seed: int = 0
    # Added to the measured state, in its units, (n,); empty for none.
    measurement_bias: list[float] = field(default_factory=list)
    # How old a measurement is when it arrives [s].
    measurement_delay: float = 0.0
    # Probability that a tick's measurement is lost; the last one stays.
    measurement_loss: float = 0.0
    # Obstacles are seen when their surface is nearer than this [m]; 0 for always.
    sight: float = 0.0
    # Time constant of the actuators [s].
    actuator_lag: float = 0.0
    # Share of the declared input limits that the actuators reach.
    actuator_limit: float = 1.0
    # True mass (inertia and added mass with it) over the one in the model.
    mass: float = 1.0
    # True drag over the one in the model.
    drag: float = 1.0
    # True disturbance over the declared one.
    disturbance: float = 1.0
    # Pushes on top of it.
    gusts: list[StepGust] = field(default_factory=list)
    # Probability that a tick's solvers fail.
    solver_failure: float = 0.0
    # Probability that the process of filter and observer is killed at a tick.
    outage: float = 0.0
    # How long it then takes until it runs again, with a fresh observer [s].
    outage_duration: float = 0.5

    def validate(self) -> None:
        """Raises ValueError for a number that is not allowed."""
        for name in ("measurement_loss", "solver_failure", "outage"):
            _check(name, getattr(self, name), 0.0, 1.0, "from 0 to 1")
        for name in (
            *("seed", "measurement_delay", "sight", "actuator_lag", "drag"),
            "outage_duration",
        ):
            _check(name, getattr(self, name), 0.0, math.inf, "finite and not below 0")
        _check("disturbance", self.disturbance, -math.inf, math.inf, "finite")
        if not 0.0 < self.actuator_limit <= 1.0:
            raise ValueError(
                f"Faults.actuator_limit: {self.actuator_limit:g}; it must be above 0"
                " and at most 1"
            )
        if not 0.0 < self.mass < math.inf:
            raise ValueError(
                f"Faults.mass: {self.mass:g}; it must be finite and above 0"
            )
        for value in self.measurement_bias:
            _check("measurement_bias", value, -math.inf, math.inf, "finite")
        for gust in self.gusts:
            numbers = [*gust.amplitude, gust.start, gust.duration]
            if not (all(map(math.isfinite, numbers)) and gust.duration > 0.0):
                raise ValueError(
                    f"Faults.gusts: {gust}; its numbers must be finite and its duration"
                    " above 0"
                )

    @property
    def changes_plant(self) -> bool:
        """Whether the plant is another one than the filter's model."""
        return self.mass != 1.0 or self.drag != 1.0

    @property
    def changes_disturbance(self) -> bool:
        """Whether the disturbance is another one than declared."""
        return self.disturbance != 1.0 or bool(self.gusts)


def fault_assumptions(faults: Faults) -> Iterator[Assumption]:
    """Yields the hypotheses that the faults break; none without a fault."""
    found: list[tuple[bool, str, str, dict[str, float]]] = [
        (
            any(faults.measurement_bias) or faults.measurement_delay > 0.0,
            "true measurement",
            "the measured state is the state, now",
            {
                "largest bias": max(map(abs, faults.measurement_bias), default=0.0),
                "delay": faults.measurement_delay,
            },
        ),
        (
            faults.measurement_loss > 0.0,
            "measurement at every tick",
            "no measurement is lost",
            {"probability of loss": faults.measurement_loss},
        ),
        (
            faults.sight > 0.0,
            "known obstacles",
            "every obstacle is known from the start",
            {"sight": faults.sight},
        ),
        (
            faults.actuator_lag > 0.0 or faults.actuator_limit < 1.0,
            "held input",
            "the plant receives the filter's input, held over the period",
            {
                "time constant": faults.actuator_lag,
                "share of limits": faults.actuator_limit,
            },
        ),
        (
            faults.changes_plant,
            "plant as modelled",
            "xdot = f(x) + g(x) u + E d with the model's f and g (R18)",
            {"mass ratio": faults.mass, "drag ratio": faults.drag},
        ),
        (
            faults.changes_disturbance,
            "disturbance as declared",
            "|d|, |d'|, |d''| within their bounds (E8)",
            {"ratio": faults.disturbance, "step gusts": float(len(faults.gusts))},
        ),
        (
            faults.solver_failure > 0.0,
            "solvers at every tick",
            "no solver fails",
            {"probability of failure": faults.solver_failure},
        ),
        (
            faults.outage > 0.0,
            "process at every tick",
            "filter and observer run without a break",
            {
                "probability of being killed": faults.outage,
                "outage": faults.outage_duration,
            },
        ),
    ]
    for is_broken, name, statement, numbers in found:
        if is_broken:
            yield Assumption(name, statement, False, numbers, "no theorem applies")


def _check(name: str, value: float, least: float, most: float, rule: str) -> None:
    if not (math.isfinite(value) and least <= value <= most):
        raise ValueError(f"Faults.{name}: {value:g}; it must be {rule}")
