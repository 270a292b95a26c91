"""Twice continuously differentiable functions of time, with bounds of derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Protocol

import numpy as np
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    MatrixGain,
    Sine,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.checks import Array


class Curve(Protocol):
    """A C2 function of time with q channels and a bounded third derivative."""

    @property
    def size(self) -> int:
        """How many channels it has, q."""

    def derivative(self, t: float | Array, order: int = 0) -> Array:
        """Returns the derivative of an order from 0 (the value) to 3.

        Args:
            t: Times [s], of any shape.
            order: The order.

        Returns:
            Shape of `t` + (q,), [unit / s^order].
        """

    def derivative_bound(self, order: int) -> float:
        """Returns an upper bound of the derivative's Euclidean norm over all time."""

    def system(self) -> System:
        """Returns a system of Drake's own whose only output is the function, (q,)."""


@dataclass(frozen=True)
class Tones:
    """A sum of K tones, ``sum_k a_k sin(w_k t + p_k)``.

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
        """How many channels it has, q."""
        return len(self.amplitude[0])

    def derivative(self, t: float | Array, order: int = 0) -> Array:
        """Returns ``sum_k a_k w_k^order sin(w_k t + p_k + order pi / 2)``."""
        angle = np.multiply.outer(t, self.frequency) + self.phase
        quarter_turns = order * np.pi / 2
        scaled = self.amplitude * self.frequency[:, None] ** order
        value: Array = np.sin(angle + quarter_turns) @ scaled
        return value

    def derivative_bound(self, order: int) -> float:
        """Returns ``sum_k |a_k| |w_k|^order``."""
        size = np.linalg.norm(self.amplitude, axis=1)
        return float(size @ np.abs(self.frequency) ** order)

    def system(self) -> System:
        """Returns unit sines behind the matrix of amplitudes; see `Curve`."""
        if self.size == 0:
            return ConstantVectorSource([])
        builder = DiagramBuilder()
        unit = np.ones_like(self.phase)
        tones = builder.AddSystem(Sine(unit, self.frequency, self.phase, True))
        mixed = builder.AddSystem(MatrixGain(self.amplitude.T))
        builder.Connect(tones.get_output_port(0), mixed.get_input_port())
        builder.ExportOutput(mixed.get_output_port())
        return builder.Build()

    def __add__(self, other: Tones) -> Tones:
        return Tones(
            np.concatenate([self.amplitude, other.amplitude]),
            np.concatenate([self.frequency, other.frequency]),
            np.concatenate([self.phase, other.phase]),
        )


class Spline:
    """The C2 cubic spline through samples, its ends not-a-knot.

    It is C2 between the first and the last sample time only; outside it is held.

    Args:
        times: Increasing, shape (T,) with T >= 3 [s].
        values: One row a time, shape (T, q).
    """

    def __init__(self, times: Array, values: Array) -> None:
        spline = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            times, values.T, False
        )
        self._times = times
        self._size = len(values[0])
        self._derivatives = [spline, *map(spline.derivative, (1, 2, 3))]

    @property
    def size(self) -> int:
        """How many channels it has, q."""
        return self._size

    def derivative(self, t: float | Array, order: int = 0) -> Array:
        """Returns the derivative of an order from 0 to 3; see `Curve`."""
        times = np.asarray(t, dtype=float)
        values = self._derivatives[order].vector_values(times.ravel())
        return np.reshape(values.T, (*times.shape, self._size))

    def derivative_bound(self, order: int) -> float:
        """Returns the largest norm at mid-piece plus what half a piece can add to it.

        The third derivative is constant on each piece, so there this is exact.
        """
        if order > 3:
            return 0.0
        middle = (self._times[1:] + self._times[:-1]) / 2
        half = np.diff(self._times) / 2
        size = np.linalg.norm(self.derivative(middle, order), axis=1)
        return float(np.max(size + half * self.derivative_bound(order + 1)))

    def system(self) -> System:
        """Returns the spline as a trajectory; see `Curve`."""
        return TrajectorySource(self._derivatives[0])


@dataclass(frozen=True)
class Sum:
    """The sum of several curves of the same size.

    Attributes:
        parts: The curves, one at least.
    """

    parts: tuple[Curve, ...]

    @staticmethod
    def of(curves: Sequence[Curve]) -> Curve:
        """Returns the sum of curves; all tones become one curve, which is faster."""
        tones = [curve for curve in curves if isinstance(curve, Tones)]
        others = [curve for curve in curves if not isinstance(curve, Tones)]
        parts = (*([reduce(add, tones)] if tones else []), *others)
        return parts[0] if len(parts) == 1 else Sum(parts)

    @property
    def size(self) -> int:
        """How many channels it has, q."""
        return self.parts[0].size

    def derivative(self, t: float | Array, order: int = 0) -> Array:
        """Returns the derivative of an order from 0 to 3; see `Curve`."""
        first, *others = (part.derivative(t, order) for part in self.parts)
        return sum(others, start=first)

    def derivative_bound(self, order: int) -> float:
        """Returns the sum of the parts' bounds."""
        return sum(part.derivative_bound(order) for part in self.parts)

    def system(self) -> System:
        """Returns the sum of the parts' systems; see `Curve`."""
        builder = DiagramBuilder()
        total = builder.AddSystem(Adder(len(self.parts), self.size))
        for i, part in enumerate(self.parts):
            system = builder.AddSystem(part.system())
            builder.Connect(system.get_output_port(0), total.get_input_port(i))
        builder.ExportOutput(total.get_output_port())
        return builder.Build()


def supremum(curve: Curve, order: int, horizon: float) -> float:
    """Returns an upper bound of a derivative's norm over [0, horizon].

    On an interval of half-width h the norm is at most its value at mid-interval plus
    h times the bound of the next derivative. Intervals where this exceeds the largest
    value found by more than 1 % are halved. The result is an upper bound even where
    this ends early, because a signal is a thousand times faster than its horizon.

    Args:
        curve: The function.
        order: 0 (its value) to 2.
        horizon: End of the time interval [s].
    """
    slope, ceiling = curve.derivative_bound(order + 1), curve.derivative_bound(order)
    half = horizon / 512
    middle: Array = half * np.arange(1.0, 512.0, 2.0)
    largest = bound = 0.0
    while middle.size:
        size = np.linalg.norm(curve.derivative(middle, order), axis=1)
        upper = size + half * slope
        largest = max(largest, float(size.max()))
        # Signals that cancel have no largest value to be relative to.
        wide = upper > largest + 0.01 * max(largest, 0.001 * ceiling)
        if middle.size > _MAX_INTERVALS:
            wide[:] = False
        bound = max(bound, float(upper[~wide].max(initial=0.0)))
        half /= 2
        middle = np.concatenate([middle[wide] - half, middle[wide] + half])
    return min(bound, ceiling)


_MAX_INTERVALS = 2**17
