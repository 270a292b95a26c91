"""Bounds of a disturbance, and its estimate with an error bound."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Literal, NamedTuple

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.typed import Checked, NotNegative

# The basis of an error bound: a ``proven`` inequality for exact measurements; only |d|
# <= delta1, also proven (``worst case``); formulas that simulations ``calibrated``; or
# the ``published`` inequality, false in sampled time.
Basis = Literal["proven", "worst case", "calibrated", "published"]


@dataclass(frozen=True)
class DisturbanceBounds(Checked):
    """Upper bounds of a disturbance and its derivatives, Euclidean norms (E16).

    Attributes:
        delta1: Bound of |d| [m/s^2].
        delta2: Bound of |d'| [m/s^3].
        delta3: Bound of |d''| [m/s^4].
    """

    delta1: NotNegative
    delta2: NotNegative
    delta3: NotNegative


@dataclass(frozen=True)
class ErrorBound:
    """A bound of an estimate's error, ``amplitude exp(-rate t) + floor``.

    Attributes:
        amplitude: The decaying part [m/s^2].
        rate: Its rate of decay [1/s].
        floor: The constant part [m/s^2].
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
    """

    name: str
    left: float
    right: float

    @property
    def holds(self) -> bool:
        """Whether it is true."""
        return self.left > self.right


class DisturbanceEstimate(NamedTuple):
    """An estimate of the disturbance and a bound of its error, at one tick or many.

    Attributes:
        disturbance: dhat, shape (..., q) [m/s^2].
        rate: The known part of d(dhat)/dt, shape (..., q) [m/s^3].
        error_bound: A bound of abs(d - dhat), Euclidean, shape (...) [m/s^2].
        error_bound_rate: Its time derivative, shape (...) [m/s^3].
        refused_intervals: The number of intervals refused so far, because the measured
            state jumped or was missing (E43, a jump of the state), shape (...).
        quadrature_error: The largest error of an interval's mean so far (E42), shape
            (...) [m/s^2].
    """

    disturbance: Array
    rate: Array
    error_bound: Array
    error_bound_rate: Array
    refused_intervals: Array
    quadrature_error: Array

    @staticmethod
    def packed_size(num_disturbances: int) -> int:
        """Returns the size of the port, 2 q + 4."""
        return 2 * num_disturbances + 4

    @staticmethod
    def unpack(packed: Array) -> DisturbanceEstimate:
        """Returns the parts of a port's value.

        Args:
            packed: One value or many, shape (..., 2 q + 4).
        """
        q = packed.shape[-1] // 2 - 2
        numbers = [packed[..., i] for i in range(2 * q, 2 * q + 4)]
        return DisturbanceEstimate(packed[..., :q], packed[..., q : 2 * q], *numbers)

    def pack(self) -> Array:
        """Returns the value of the port, shape (..., 2 q + 4)."""
        numbers = np.stack(self[2:], axis=-1)
        return np.concatenate((self.disturbance, self.rate, numbers), axis=-1)

    def log_arrays(self) -> dict[str, Array]:
        """Returns the parts by their names in a log."""
        return {
            "disturbance_estimate": self.disturbance,
            "estimate_rate": self.rate,
            "error_bound": self.error_bound,
            "error_bound_rate": self.error_bound_rate,
            "refused_intervals": self.refused_intervals,
            "quadrature_error": self.quadrature_error,
        }


def noise_peak(num_disturbances: int) -> float:
    """Returns the deviations that the norm of q normals exceeds once in 10^4 ticks."""
    # sqrt(q) + 3 is exceeded with probability 6e-5, whether q is 1, 2 or 3.
    return math.sqrt(num_disturbances) + 3.0
