"""What is known about a disturbance, and about an estimate of it."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Literal

# What a bound of an estimate's error rests on: a ``proven`` inequality for exact
# measurements; nothing but |d| <= delta1, also proven (``worst case``); formulas that
# simulations ``calibrated``; or the ``published`` inequality, false in sampled time.
Basis = Literal["proven", "worst case", "calibrated", "published"]


@dataclass(frozen=True)
class DisturbanceBounds:
    """Upper bounds of a disturbance and its derivatives, Euclidean norms (E8).

    Attributes:
        delta1: Bound of |d| [m/s^2].
        delta2: Bound of |d'| [m/s^3].
        delta3: Bound of |d''| [m/s^4].

    Raises:
        ValueError: A bound is negative or not finite.
    """

    delta1: float
    delta2: float
    delta3: float

    def __post_init__(self) -> None:
        for name in ("delta1", "delta2", "delta3"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(
                    f"{name} is {value!r}; it must be finite and not below 0"
                )


@dataclass(frozen=True)
class ErrorBound:
    """A bound of an estimate's error, ``amplitude exp(-rate t) + floor``.

    Attributes:
        amplitude: What decays [m/s^2].
        rate: How fast [1/s].
        floor: What stays [m/s^2].
    """

    amplitude: float
    rate: float
    floor: float

    def value(self, t: float) -> float:
        """Returns the bound a time t [s] after the observer's start [m/s^2]."""
        return self.amplitude * math.exp(-self.rate * t) + self.floor

    def derivative(self, t: float) -> float:
        """Returns the bound's time derivative [m/s^3]."""
        return -self.rate * self.amplitude * math.exp(-self.rate * t)


@dataclass(frozen=True)
class Condition:
    """An inequality ``left > right`` that a guarantee rests on.

    Attributes:
        name: The inequality in symbols.
        left: Its greater side.
        right: Its lesser side.
        holds: Whether it is true.
    """

    name: str
    left: float
    right: float
    holds: bool


def check_positive(name: str, value: float) -> None:
    """Raises ValueError unless a number is finite and above 0."""
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value!r}; it must be finite and above 0")


def noise_peak(num_disturbances: int) -> float:
    """Returns how many deviations the norm of q normals exceeds once in 10^4 ticks."""
    # sqrt(q) + 3 is exceeded with probability 6e-5, whether q is 1, 2 or 3.
    return math.sqrt(num_disturbances) + 3.0
