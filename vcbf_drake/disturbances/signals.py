"""Twice continuously differentiable functions of time, with bounds of derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import (
    ConstantVectorSource,
    MatrixGain,
    Sine,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.checks import Array


@dataclass(frozen=True)
class Tones:
    """A sum of K tones in q channels, ``sum_k a_k sin(w_k t + p_k)``.

    Attributes:
        amplitude: The vectors a_k, shape (K, q).
        frequency: w_k, shape (K,) [rad/s]; 0 makes the tone a constant.
        phase: p_k, shape (K,) [rad].
    """

    amplitude: Array
    frequency: Array
    phase: Array

    @property
    def size(self) -> int:
        """The number q of channels."""
        return self.amplitude.shape[1]

    def derivative(self, t: float | Array, order: int = 0) -> Array:
        """Returns a derivative of any order at times t [s]: shape of `t` + (q,)."""
        angle = np.multiply.outer(t, self.frequency) + self.phase
        quarter_turns = order * np.pi / 2
        scaled = self.amplitude * self.frequency[:, None] ** order
        value: Array = np.sin(angle + quarter_turns) @ scaled
        return value

    def derivative_bound(self, order: int) -> float:
        """Returns a bound of a derivative's norm, ``sum_k |a_k| |w_k|^order``."""
        size = np.linalg.norm(self.amplitude, axis=1)
        return float(size @ np.abs(self.frequency) ** order)

    def system(self) -> System:
        """Returns Drake's unit sines, followed by the matrix of amplitudes."""
        if self.size == 0:
            return ConstantVectorSource([])
        builder = DiagramBuilder()
        unit = np.ones_like(self.phase)
        tones = builder.AddSystem(Sine(unit, self.frequency, self.phase, True))
        mixed = builder.AddSystem(MatrixGain(self.amplitude.T))
        builder.Connect(tones.get_output_port(0), mixed.get_input_port())
        builder.ExportOutput(mixed.get_output_port())
        return builder.Build()


class Pieces:
    """A piecewise polynomial in q channels, held before its start and after its end.

    Args:
        path: The polynomial, shape (q, 1), C2 on its interval.
        bounds: Upper bounds of the norms of its value and first three derivatives.
    """

    def __init__(self, path: PiecewisePolynomial, bounds: Sequence[float]) -> None:
        self._derivatives = [path, *map(path.derivative, (1, 2, 3))]
        self._bounds = bounds

    @staticmethod
    def through(times: Array, values: Array) -> Pieces:
        """Returns the cubic spline through samples, its ends not-a-knot.

        Args:
            times: Increasing, shape (T,) with T >= 3 [s].
            values: One row a time, shape (T, q).
        """
        path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            times, values.T, False
        )
        middle, half = (times[1:] + times[:-1]) / 2, np.diff(times) / 2
        bounds = [0.0]
        # The value at mid-piece plus the most that half a piece can add; exact for the
        # third derivative, which is constant.
        for order in (3, 2, 1, 0):
            at_middle = path.derivative(order).vector_values(middle)
            size = np.linalg.norm(at_middle, axis=0) + half * bounds[0]
            bounds.insert(0, float(size.max()))
        return Pieces(path, bounds)

    @property
    def size(self) -> int:
        """The number q of channels."""
        return int(self._derivatives[0].rows())

    def derivative(self, t: float | Array, order: int = 0) -> Array:
        """Returns a derivative, order 0 to 3, at times t [s]: shape of `t` + (q,)."""
        path, times = self._derivatives[order], np.asarray(t, dtype=float)
        values = path.vector_values(times.ravel()).T.reshape(*times.shape, self.size)
        if order == 0:
            return values
        within = (path.start_time() <= times) & (times <= path.end_time())
        return np.where(within[..., None], values, 0.0)

    def derivative_bound(self, order: int) -> float:
        """Returns an upper bound of a derivative's norm."""
        return self._bounds[order]

    def system(self) -> System:
        """Returns Drake's source of the polynomial."""
        return TrajectorySource(self._derivatives[0])


Curve: TypeAlias = Tones | Pieces


def supremum(curves: Sequence[Curve], order: int, horizon: float) -> float:
    """Returns an upper bound of the norm of a sum's derivative over [0, horizon].

    On an interval of half-width h the norm is at most its value at mid-interval plus
    h times the bound of the next derivative. Intervals where this exceeds the largest
    value found by more than 1 % are halved. The result is an upper bound even where
    this ends early, because a signal is a thousand times faster than its horizon.

    Args:
        curves: The curves to add up.
        order: 0 (the value) to 2.
        horizon: End of the time interval [s].
    """
    slope = sum(each.derivative_bound(order + 1) for each in curves)
    ceiling = sum(each.derivative_bound(order) for each in curves)
    half = horizon / 512
    middle: Array = half * np.arange(1.0, 512.0, 2.0)
    largest = bound = 0.0
    while middle.size:
        values = sum(each.derivative(middle, order) for each in curves)
        size = np.linalg.norm(values, axis=1)
        upper = size + half * slope
        largest = max(largest, float(size.max()))
        # Signals that cancel have no largest value for a relative tolerance.
        wide = upper > largest + 0.01 * max(largest, 0.001 * ceiling)
        if middle.size > _MAX_INTERVALS:
            wide[:] = False
        bound = max(bound, float(upper[~wide].max(initial=0.0)))
        half /= 2
        middle = np.concatenate([middle[wide] - half, middle[wide] + half])
    return min(bound, ceiling)


_MAX_INTERVALS = 2**17
