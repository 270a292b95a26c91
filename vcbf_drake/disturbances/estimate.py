"""DisturbanceEstimate: the value of an observer's port ``estimate``, by name."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vcbf_drake.checks import Array


class DisturbanceEstimate(NamedTuple):
    """An estimate of the disturbance and a bound of its error, at one tick or many.

    Attributes:
        disturbance: dhat, shape (..., q) [m/s^2].
        rate: The known part of d(dhat)/dt, shape (..., q) [m/s^3].
        error_bound: A bound of abs(d - dhat), Euclidean, shape (...) [m/s^2].
        error_bound_rate: Its time derivative, shape (...) [m/s^3].
        refused_intervals: How many intervals were refused so far, for the measured
            state jumped or was missing (E96), shape (...).
        quadrature_error: The largest error of an interval's mean so far (E97), shape
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
        numbers = np.moveaxis(packed[..., 2 * q :], -1, 0)
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
