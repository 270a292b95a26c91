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
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.checks import (
    Array,
    check_finite,
    check_parameter,
    finite_array,
    require,
)
from vcbf_drake.disturbances.bounds import DisturbanceBounds
from vcbf_drake.disturbances.signals import (
    Curve,
    Pieces,
    Tones,
    supremum,
)
from vcbf_drake.errors import InvalidValueError, ModelError
from vcbf_drake.typed import Positive, check_fields, typed

# Between two samples [s]; a spline's third derivative goes with its inverse cube.
_SHORTEST_INTERVAL = 1e-9


@dataclass
class Constant:
    """A disturbance that never changes.

    Attributes:
        value: One value per disturbed channel [m/s^2].
    """

    value: list[float] = field(default_factory=list)

    def curve(self, horizon: float) -> Tones:
        """Returns the signal as a function of time, C2 on [0, horizon]."""
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
        """Returns the signal as a function of time, C2 on [0, horizon]."""
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
        """Returns the signal as a function of time, C2 on [0, horizon]."""
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
        """Returns the signal as a function of time, C2 on [0, horizon]."""
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
        """Returns the signal as a function of time, C2 on [0, horizon]."""
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

    .. pydrake_system::

        name: DisturbanceSource
        output_ports:
        - disturbance

    | port | size | |
    | --- | --- | --- |
    | ``disturbance`` | q | d(t), on the disturbed channels [m/s^2] |

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
            signals: Any of `Constant`, `Sinusoid`, `SmoothStep`, `BandLimitedNoise`,
                `Recorded`, all for the same number of channels.
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
