"""Faults that a scenario puts into its loop, and the hypotheses they break."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from vcbf_drake.checks import check_share
from vcbf_drake.safety.assumptions import Assumption
from vcbf_drake.typed import (
    Checked,
    Finite,
    NotNegative,
    NotNegativeInt,
    Positive,
    Share,
)


@dataclass
class StepGust(Checked):
    """A gust that starts and ends with a jump: not C2, and not declared.

    Attributes:
        amplitude: One value per disturbed channel [m/s^2].
        start: Start time [s].
        duration: Duration [s].
    """

    amplitude: list[Finite]
    start: Finite = 0.0
    duration: Positive = 1.0


@dataclass
class Faults(Checked):
    """Faults of plant, sensors, actuators and solver; none by default.

    The filter and its observer know of none of it. Noise is no fault but `noise`.

    Attributes:
        seed: Seed of the random faults.
        measurement_bias: Bias of the measured state, in its units, (n,); empty for
            none.
        measurement_delay: Delay of the measurements [s].
        measurement_loss: Probability that a tick's measurement is lost; the last one is
            kept.
        sight: Distance to an obstacle's surface below which it is seen [m]; 0 for
            always.
        actuator_lag: Time constant of the actuators [s].
        actuator_limit: Ratio of the true input limits to the declared ones.
        mass: Ratio of the true mass (with inertia and added mass) to the model's.
        drag: Ratio of the true drag to the model's.
        disturbance: Ratio of the true disturbance to the declared one.
        gusts: Gusts added to the disturbance.
        solver_failure: Probability that a tick's solvers fail.
        outage: Probability that the process of filter and observer is killed at a tick.
        outage_duration: Time until it runs again, with a fresh observer [s].
    """

    seed: NotNegativeInt = 0
    measurement_bias: list[Finite] = field(default_factory=list)
    measurement_delay: NotNegative = 0.0
    measurement_loss: Share = 0.0
    sight: NotNegative = 0.0
    actuator_lag: NotNegative = 0.0
    actuator_limit: Annotated[Positive, check_share] = 1.0
    mass: Positive = 1.0
    drag: NotNegative = 1.0
    disturbance: Finite = 1.0
    gusts: list[StepGust] = field(default_factory=list)
    solver_failure: Share = 0.0
    outage: Share = 0.0
    outage_duration: NotNegative = 0.5


def fault_assumptions(faults: Faults, noise: Sequence[float]) -> Iterator[Assumption]:
    """Yields the hypotheses that faults and noise break; none without.

    Args:
        faults: The faults of the loop.
        noise: Standard deviations of the measured states; empty for none.
    """
    whole = _hypotheses(Faults(), [])
    for (name, statement), numbers in _hypotheses(faults, noise).items():
        if numbers != whole[name, statement]:
            yield Assumption(name, statement, False, numbers, "no theorem applies")


def _hypotheses(
    faults: Faults, noise: Sequence[float]
) -> dict[tuple[str, str], dict[str, float]]:
    """The numbers of the faults by the hypotheses, and their statements, they break."""
    return {
        ("true measurement", "the measured state is the state, now"): {
            "largest bias": max(map(abs, faults.measurement_bias), default=0.0),
            "delay": faults.measurement_delay,
            "largest deviation": max(noise, default=0.0),
        },
        ("measurement at every tick", "no measurement is lost"): {
            "probability of loss": faults.measurement_loss
        },
        ("known obstacles", "every obstacle is known from the start"): {
            "sight": faults.sight
        },
        (
            "held input",
            "the plant receives the filter's input, held over the period",
        ): {
            "time constant": faults.actuator_lag,
            "share of limits": faults.actuator_limit,
        },
        (
            "plant as modelled",
            "xdot = f(x) + g(x) u + E d with the model's f and g (R18)",
        ): {"mass ratio": faults.mass, "drag ratio": faults.drag},
        ("disturbance as declared", "|d|, |d'|, |d''| within their bounds (E16)"): {
            "ratio": faults.disturbance,
            "step gusts": float(len(faults.gusts)),
        },
        ("solvers at every tick", "no solver fails"): {
            "probability of failure": faults.solver_failure
        },
        ("process at every tick", "filter and observer run without a break"): {
            "probability of being killed": faults.outage,
            "outage": faults.outage_duration if faults.outage > 0.0 else 0.0,
        },
    }
