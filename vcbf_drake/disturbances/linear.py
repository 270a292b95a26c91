"""LinearDisturbanceObserver: the first-order observer of Wang and Xu."""

from __future__ import annotations

import math

from vcbf_drake.checks import Array
from vcbf_drake.disturbances.bounds import (
    DisturbanceBounds,
    ErrorBound,
    noise_peak,
)
from vcbf_drake.disturbances.observer import DisturbanceObserver
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.typed import NotNegative, Positive, typed


class LinearDisturbanceObserver(DisturbanceObserver):
    """The first-order disturbance observer (E67), exact for sampled states.

    An interval of length dt with mean disturbance dbar moves the estimate by

        dhat <- rho dhat + (1 - rho) dbar,    rho = exp(-l dt),

    which is (E67) for a disturbance that is constant over the interval. The bound of
    the error at the ticks (E41, the first-order observer's bound) is proven for every
    rate, period and bounds; what noise adds (E40) is exceeded with a probability below
    1e-4 at each tick.

    Source: Wang and Xu (2023) for the observer; its sampled form and bound are ours.
    """

    @typed
    def __init__(
        self,
        model: ControlAffineModel,
        period: Positive,
        bounds: DisturbanceBounds,
        rate: Positive = 4.0,
        noise: NotNegative = 0.0,
        longest_interval: float | None = None,
    ) -> None:
        """Initialises the observer.

        Args:
            model: Gives f, g and E.
            period: Time between measurements [s].
            bounds: delta1, delta2 and delta3 of the disturbance (E16).
            rate: l, the rate at which the estimate follows [1/s].
            noise: Standard deviation of the measured disturbed channels [m/s].
            longest_interval: The longest time between measurements that is bridged, and
                that the bound is for, also with shorter ones [s].
        """
        interval = max(period, longest_interval or 0.0)
        floor = bounds.delta2 * interval / (2.0 * math.tanh(rate * interval / 2.0))
        # In white noise a channel's estimate has this standard deviation (E40).
        rho = math.exp(-rate * period)
        deviation = noise * (1.0 - rho) / period * math.sqrt(2.0 / (1.0 + rho))
        noise_floor = noise_peak(model.num_disturbances) * deviation
        super().__init__(
            model,
            period,
            bounds,
            memory_size=model.num_disturbances,
            error_bound=ErrorBound(bounds.delta1 - floor, rate, floor + noise_floor),
            basis="calibrated" if noise else "proven",
            estimate_gain=rate,
            noise=noise,
            longest_interval=longest_interval,
        )

    def _advance(self, memory: Array, mean: Array, elapsed: float) -> Array:
        return mean + math.exp(-self.estimate_gain * elapsed) * (memory - mean)
