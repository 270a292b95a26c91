"""RiseObserver: the RISE disturbance observer in sampled time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.disturbances.bounds import (
    Basis,
    Condition,
    DisturbanceBounds,
    ErrorBound,
)
from vcbf_drake.disturbances.observer import DisturbanceObserver
from vcbf_drake.disturbances.rise_bound import (
    Intervals,
    ObserverStep,
    RiseGains,
    error_bound,
    gain_conditions,
    least_beta,
    with_quadrature,
)
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.typed import Checked, NotNegative, Positive, typed


@dataclass
class ObserverSettings(Checked):
    """The disturbance observers: the RISE observer (E17), and the linear one (B4).

    Attributes:
        alpha: Gain of the RISE observer (E17), (E20, the printed error bound) [1/s].
        beta: Gain of the sign term [m/s^3]; null for the one that the disturbance's
            bounds require (E32, the gain conditions), at least 6.
        gamma: Gain of the filtered error [1/s].
        uncertified: Whether gains that fail (E32) are accepted, with the error bound 2
            delta1 (E37, the worst-case error bound).
        step: Discretisation of the observer: implicit (E24), saturated (E26) or
            explicit (E27, the explicit step's chatter).
        period: Time between the observer's steps [s], at most the control period; 0 for
            the control period.
        boundary_layer: Half-width of the boundary layer in which the sign function of
            the saturated step is linear [m/s].
        linear_rate: Rate of the first-order observer of method wang-xu-dob-cbf-qp
            [1/s].
    """

    alpha: Positive = 5.0
    beta: Positive | None = None
    gamma: Positive = 4.0
    uncertified: bool = False
    step: ObserverStep = "implicit"
    period: NotNegative = 0.0
    boundary_layer: Positive = 0.05
    linear_rate: Positive = 4.0


# The shortest interval assumed where intervals differ, in periods.
_SHORTEST = 0.9


class RiseObserver(DisturbanceObserver):
    """The RISE disturbance observer (E18), its error bounded in sampled time.

    In continuous time, on the disturbed channels,

        dhat = γ xtil + I,    dI/dt = (αγ + 1) xtil + β sign(xtil).

    An interval of length dt with mean disturbance dbar is taken in one of three steps:

    * ``implicit`` (E24), the default: backward Euler, solved exactly. While sliding
      (xtil = 0) the estimate is dbar itself.
    * ``saturated``: the same with clip(xtil / φ, -1, 1) in place of sign(xtil), stable
      for every φ; for noisy measurements, φ about 10 to 50 standard deviations.
    * ``explicit``: forward Euler, which chatters (E27). For comparison only.

    At the ticks, if `gain_conditions` hold and measurements are exact, the error of the
    first two is certified by (E33, the implicit step's bound), (E38). What noise adds
    to that, and the explicit step's bound, are calibrated (E39), (E27). The means'
    quadrature error counts as a disturbance with larger bounds (E42).

    Source: (E17), (E20) are the paper's; the sampled steps and their bounds are ours.
    """

    @typed
    def __init__(
        self,
        model: ControlAffineModel,
        period: Positive,
        bounds: DisturbanceBounds,
        settings: ObserverSettings | None = None,
        *,
        noise: NotNegative = 0.0,
        floor: bool = True,
        longest_interval: float | None = None,
    ) -> None:
        """Initialises the observer.

        Args:
            model: Gives f, g and E.
            period: Time between measurements [s].
            bounds: delta1, delta2 and delta3 of the disturbance (E16).
            settings: Its gains and its step; `ObserverSettings()` by default.
            noise: Standard deviation of the measured disturbed channels [m/s].
            floor: Whether the error bound has its floor. Without, it is (E20) as
                published, which no sampled observer meets.
            longest_interval: The longest time between measurements that is bridged,
                and that the bound is for [s]. By default every time is bridged, and
                the bound is for the period. Where it is longer than that, the bound is
                proven (E34) if beta is large enough for intervals of 0.9 periods to
                the longest (E35), and without noise; else calibrated.

        Raises:
            ValueError: An argument is outside what is allowed, or the gains fail a
                condition.
        """
        self.settings = settings = settings or ObserverSettings()
        interval = max(period, longest_interval or 0.0)
        self.gains, self._intervals = _resolved(
            settings, bounds, period, interval, noise
        )
        gains = self.gains
        self._steadiness = noise, model.num_disturbances
        failed = [
            each
            for each in gain_conditions(gains, bounds, self._intervals, settings.step)
            if not each.holds
        ]
        is_even = self._intervals.shortest == self._intervals.longest
        is_calibrated = bool(noise) or settings.step == "explicit"
        basis: Basis
        if failed and not settings.uncertified:
            raise ValueError(_refusal(gains, failed))
        if failed:
            basis, bound = "worst case", ErrorBound(0.0, 0.0, 2.0 * bounds.delta1)
        elif floor:
            is_calibrated |= is_even and interval > period
            basis = "calibrated" if is_calibrated else "proven"
            bound = self._bound(bounds, interval)
        else:
            rate = gains.decay_rate / 2.0
            basis, bound = "published", ErrorBound(bounds.delta1, rate, 0.0)
        super().__init__(
            model,
            period,
            bounds,
            memory_size=3 * model.num_disturbances,
            error_bound=bound,
            basis=basis,
            estimate_gain=gains.gamma,
            noise=noise,
            longest_interval=longest_interval,
        )

    def gain_conditions(self, quadrature: float = 0.0) -> tuple[Condition, ...]:
        """Returns the inequalities that the bound rests on (E20), (E32), (E42)."""
        intervals = self._intervals
        bounds = with_quadrature(self.bounds, quadrature, intervals.shortest)
        return gain_conditions(self.gains, bounds, intervals, self.settings.step)

    def _advance(self, memory: Array, mean: Array, elapsed: float) -> Array:
        step = self._forward if self.settings.step == "explicit" else self._backward
        return step(memory, mean, elapsed)

    def _backward(self, memory: Array, mean: Array, dt: float) -> Array:
        """Takes the implicit or saturated step (E24), (E38), channel by channel."""
        gains, C = self.gains, self.gains.denominator(dt)
        jump = dt**2 * gains.beta
        settings = self.settings
        layer = settings.boundary_layer if settings.step == "saturated" else 0.0
        reach = C * layer + jump
        channels = []
        for xtil, integral, _, d in zip(
            *memory.reshape(3, -1).tolist(), mean.tolist(), strict=True
        ):
            w = xtil + dt * (d - integral)
            s = min(1.0, max(-1.0, w / reach))
            xtil_1 = (w - jump * s) / C
            integral_1 = integral + dt * (gains.stiffness * xtil_1 + gains.beta * s)
            channels.append((xtil_1, integral_1, s))
        return np.array(channels).T.ravel()

    def _forward(self, memory: Array, mean: Array, dt: float) -> Array:
        """Takes the explicit step, Euler's of (E18)."""
        xtil, integral, s = memory.reshape(3, -1)
        gains = self.gains
        slope = gains.stiffness * xtil + gains.beta * s
        xtil = xtil + dt * (mean - integral - (gains.alpha + gains.gamma) * xtil)
        return np.concatenate((xtil, integral + dt * slope, np.sign(xtil)))

    def _bound(self, bounds: DisturbanceBounds, period: float) -> ErrorBound:
        step, layer = self.settings.step, self.settings.boundary_layer
        return error_bound(self.gains, bounds, period, step, layer, *self._steadiness)

    def _started_at(self, estimate: Array) -> Array:
        zero = np.zeros_like(estimate)
        return np.concatenate((zero, estimate, zero))

    def _bound_after(self, excess: float, quadrature: float) -> ErrorBound:
        bound, period = self._error_bound, self.certified_interval
        if self.basis == "worst case":
            return bound
        if quadrature and self.basis != "published":
            wider = with_quadrature(self.bounds, quadrature, period)
            bound = self._bound(wider, period)
        return ErrorBound(bound.amplitude + excess, bound.rate, bound.floor)

    def _estimate(self, memory: Array) -> Array:
        xtil, integral, _ = memory.reshape(3, -1)
        estimate = self.gains.gamma * xtil + integral
        size, delta1 = float(np.linalg.norm(estimate)), self.bounds.delta1
        if self.basis == "worst case" and size > delta1:
            return estimate * (delta1 / size)  # Nearest to it where d can be (E37).
        return estimate

    def _estimate_rate(self, memory: Array) -> Array:
        xtil, _, s = memory.reshape(3, -1)
        return xtil + self.gains.beta * s


def _resolved(
    settings: ObserverSettings,
    bounds: DisturbanceBounds,
    period: float,
    longest: float,
    noise: float,
) -> tuple[RiseGains, Intervals]:
    """The gains, and the intervals that their bound is proven for.

    The intervals are equal if unequal ones do not occur, or are not proven.
    """
    even = Intervals(longest, longest)
    uneven = Intervals(_SHORTEST * period, longest) if longest > period else even
    if noise or settings.step != "implicit":
        uneven = even
    gains = RiseGains.for_bounds(bounds, longest, settings.alpha, settings.gamma)
    gains = replace(gains, beta=settings.beta or gains.beta)
    is_enough = gains.beta > least_beta(gains, bounds, uneven)
    return gains, uneven if is_enough else even


def _refusal(gains: RiseGains, failed: list[Condition]) -> str:
    """Returns the line that explains why gains have no proven error bound."""
    broken = "; ".join(
        f"{each.name} needs {each.left:.4g} > {each.right:.4g}" for each in failed
    )
    return (
        f"gains alpha, beta, gamma = {gains.alpha:g}, {gains.beta:g},"
        f" {gains.gamma:g}: {broken}; leave them out to have them computed, or say"
        " uncertified for a bound of 2 delta1"
    )
