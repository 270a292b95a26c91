"""DisturbanceSource: a disturbance that is a sum of C2 signals, with its bounds.

The signals are plain dataclasses that ``pydrake.common.yaml`` reads and writes. It
looks at the types of the fields themselves; so this module does not postpone its
annotations. A field that has only the empty list as default has to be given.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import TypeAlias

import numpy as np
from pydrake.polynomial import Polynomial
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    MatrixGain,
    Sine,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.checks import (
    Array,
    check_finite,
    check_parameter,
    finite_array,
    require,
)
from vcbf_drake.disturbances.bounds import DisturbanceBounds
from vcbf_drake.errors import InvalidValueError, ModelError
from vcbf_drake.typed import Positive, check_fields, typed

_MAX_INTERVALS = 2**17
# Between two samples [s]; a spline's third derivative goes with its inverse cube.
_SHORTEST_INTERVAL = 1e-9


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
    def through(times: Array, values: Array) -> "Pieces":
        """Returns the cubic spline through samples (T, q), its ends not-a-knot."""
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


@dataclass
class Constant:
    """A disturbance that never changes.

    Attributes:
        value: One value per disturbed channel [m/s^2].
    """

    value: list[float] = field(default_factory=list)

    def curve(self, horizon: float) -> Tones:
        """Returns the signal as a curve, C2 on [0, horizon]."""
        check_fields(self)
        value = _vector("value", self.value)
        return Tones(value[None], np.zeros(1), np.full(1, np.pi / 2))


@dataclass
class Sinusoid:
    """A tone, ``amplitude sin(frequency t + phase)``.

    Attributes:
        amplitude: One amplitude per disturbed channel [m/s^2].
        frequency: Angular frequency [rad/s].
        phase: Phase at time zero [rad].
    """

    amplitude: list[float] = field(default_factory=list)
    frequency: float = 1.0
    phase: float = 0.0

    def curve(self, horizon: float) -> Tones:
        """Returns the signal as a curve, C2 on [0, horizon]."""
        check_fields(self)
        amplitude = _vector("amplitude", self.amplitude)
        check_finite("frequency", self.frequency)
        check_finite("phase", self.phase)
        return Tones(
            amplitude[None], np.array([self.frequency]), np.array([self.phase])
        )


# 10 s^3 - 15 s^4 + 6 s^5, lowest power first, and the maxima of it and its derivatives
# on [0, 1], at s = 1, 1/2, 1/2 -+ 1/sqrt(12), 0.
_QUINTIC = np.array((0.0, 0.0, 0.0, 10.0, -15.0, 6.0))
_QUINTIC_MAXIMA = np.array((1.0, 15 / 8, 10 / math.sqrt(3), 60.0))


@dataclass
class SmoothStep:
    """A lasting gust: a quintic rise from 0 to its amplitude.

    ``10 s^3 - 15 s^4 + 6 s^5`` has no slope and no bend at both ends, so it is C2.

    Attributes:
        amplitude: One final value per disturbed channel [m/s^2].
        start: Time at which the rise begins [s].
        duration: Duration of the rise [s]; s = (t - start) / duration. A sudden step is
            not C2.
    """

    amplitude: list[float] = field(default_factory=list)
    start: float = 0.0
    duration: float = 1.0

    def curve(self, horizon: float) -> Pieces:
        """Returns the signal as a curve, C2 on [0, horizon]."""
        check_fields(self)
        amplitude = _vector("amplitude", self.amplitude)
        check_finite("start", self.start)
        check_parameter("duration", self.duration)
        powers = self.duration ** -np.arange(6.0)
        rise = [[Polynomial(powers * each * _QUINTIC)] for each in amplitude]
        times = [self.start, self.start + self.duration]
        bounds = np.linalg.norm(amplitude) * powers[:4] * _QUINTIC_MAXIMA
        return Pieces(PiecewisePolynomial([rise], times), bounds.tolist())


@dataclass
class BandLimitedNoise:
    """Noise below a bandwidth: tones of random frequency and phase, from a seed.

    Attributes:
        std: One standard deviation (over time) per disturbed channel [m/s^2].
        bandwidth: Highest frequency of a tone [rad/s].
        seed: Seed of the frequencies and phases.
        tones: Number of tones per channel.
    """

    std: list[float] = field(default_factory=list)
    bandwidth: float = 1.0
    seed: int = 0
    tones: int = 16

    def curve(self, horizon: float) -> Tones:
        """Returns the signal as a curve, C2 on [0, horizon]."""
        check_fields(self)
        std = _vector("std", self.std)
        require(bool(np.all(std >= 0.0)), "std", self.std, "not below 0")
        check_parameter("bandwidth", self.bandwidth)
        require(self.seed >= 0, "seed", self.seed, "not below 0")
        require(1 <= self.tones <= 1000, "tones", self.tones, "from 1 to 1000")
        generator = np.random.default_rng(self.seed)
        count = len(std) * self.tones
        # The mean square of a tone is half its squared amplitude.
        amplitude = np.repeat(np.diag(std), self.tones, axis=0)
        return Tones(
            math.sqrt(2.0 / self.tones) * amplitude,
            generator.uniform(0.0, self.bandwidth, count),
            generator.uniform(0.0, 2.0 * np.pi, count),
        )


@dataclass
class Recorded:
    """Samples of a measured disturbance, joined by a C2 cubic spline.

    They have to span the whole simulation: a recording that stops is not C2 there.

    Attributes:
        times: Increasing sample times, at least three [s].
        values: One row per time, one number per disturbed channel [m/s^2].
    """

    times: list[float] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)

    def curve(self, horizon: float) -> Pieces:
        """Returns the signal as a curve, C2 on [0, horizon]."""
        check_fields(self)
        times = _vector("times", self.times)
        require(len(times) >= 3, "times", self.times, "three at least")
        apart = bool(np.all(np.diff(times) >= _SHORTEST_INTERVAL))
        rule = f"increasing, by at least {_SHORTEST_INTERVAL:g} s"
        require(apart, "times", self.times, rule)
        if times[0] > 0.0 or times[-1] < horizon:
            raise InvalidValueError(
                "times",
                f"from {times[0]:g} to {times[-1]:g} s; it must span"
                f" [0, {horizon:g}] s, for where a recording ends it is not C2",
            )
        rule = f"{len(times)} rows, one a time, of equally many finite numbers"
        values = finite_array(self.values, "values", 2, rule)
        require(len(values) == len(times), "values", self.values, rule)
        return Pieces.through(times, values)


Signal: TypeAlias = Constant | Sinusoid | SmoothStep | BandLimitedNoise | Recorded


class DisturbanceSource(Diagram):
    """A disturbance known as a function of time: the sum of C2 signals.

    Its port ``disturbance`` (q) is d(t), on the disturbed channels [m/s^2].

    Attributes:
        bounds: Bounds of |d|, |d'| and |d''| over the horizon (E16), from above and
            within 1 % unless a signal is a thousand times faster than the horizon.
    """

    bounds: DisturbanceBounds

    @typed
    def __init__(
        self,
        signals: Sequence[Signal],
        horizon: Positive = 60.0,
        num_disturbances: int | None = None,
    ) -> None:
        """Initialises the source.

        Args:
            signals: All for the same number of channels.
            horizon: The longest duration of the simulation [s].
            num_disturbances: q; needed only where `signals` is empty, for d = 0.

        Raises:
            ModelError: A signal is not C2, or signals differ in size.
        """
        super().__init__()
        self._curves = _curves(signals, horizon, num_disturbances)
        self.bounds = DisturbanceBounds(
            *(supremum(self._curves, order, horizon) for order in range(3))
        )
        builder = DiagramBuilder()
        # Drake's own systems compute it, since integrators evaluate it at every stage.
        total = builder.AddNamedSystem(
            "sum", Adder(len(self._curves), self._curves[0].size)
        )
        for i, curve in enumerate(self._curves):
            signal = builder.AddNamedSystem(f"signal {i}", curve.system())
            builder.Connect(signal.get_output_port(0), total.get_input_port(i))
        builder.ExportOutput(total.get_output_port(), "disturbance")
        builder.BuildInto(self)

    def value(self, t: float | Array) -> Array:
        """Returns d at times t [s]: shape of `t` + (q,) [m/s^2]."""
        first, *others = (curve.derivative(t) for curve in self._curves)
        return sum(others, start=first)


def _curves(
    signals: Sequence[Signal], horizon: float, num_disturbances: int | None
) -> list[Curve]:
    """Returns the signals as functions of time, one at least, of one size."""
    if not signals:
        if num_disturbances is None:
            raise ModelError("a disturbance needs one signal at least; none was given")
        return [Tones(np.zeros((1, num_disturbances)), np.zeros(1), np.zeros(1))]
    curves: list[Curve] = []
    for i, signal in enumerate(signals):
        try:
            curves.append(signal.curve(horizon))
        except ModelError as error:
            name = type(signal).__name__
            raise ModelError(f"disturbance signal {i} ({name}): {error}") from error
    size = num_disturbances or curves[0].size
    for i, curve in enumerate(curves):
        if curve.size != size:
            raise ModelError(
                f"disturbance signal {i} has {curve.size} channels; it must have {size}"
            )
    return curves


def _vector(name: str, numbers: Sequence[float]) -> Array:
    vector = finite_array(numbers, name, 1, "a list of finite numbers")
    require(vector.size > 0, name, numbers, "a list of finite numbers")
    return vector
