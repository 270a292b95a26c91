"""The RISE observer's error in sampled time: gain conditions and bounds (E27) to (E42).

Proven for exact measurements are the implicit step's bound (E33), over unequal
intervals too (E35), and the saturated step's (E38). Calibrated by simulations are what
measurement noise adds (E39), the saturated step over unequal intervals, and all of the
explicit step, which chatters (E27). The proofs are in `docs/theory.md`, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Literal, NamedTuple

import numpy as np

from vcbf_drake.disturbances.bounds import (
    Condition,
    DisturbanceBounds,
    ErrorBound,
    noise_peak,
)
from vcbf_drake.typed import Checked, Positive

ObserverStep = Literal["implicit", "saturated", "explicit"]

# The explicit step's peaks over the law (E27) were 0.86 to 1.18 in simulations.
_CHATTER_MARGIN = 1.2
# The factor by which a computed beta exceeds the least that (E32) allows.
_GAIN_MARGIN = 1.1


@dataclass(frozen=True)
class RiseGains(Checked):
    """Gains of the RISE observer (E17, the RISE observer).

    Attributes:
        alpha: Feedback of the state's error [1/s].
        beta: Size of the switching term [m/s^3].
        gamma: Feedback of the disturbance's error [1/s].
    """

    alpha: Positive = 5.0
    beta: Positive = 6.0
    gamma: Positive = 4.0

    @classmethod
    def for_bounds(
        cls,
        bounds: DisturbanceBounds,
        period: float,
        alpha: float = 5.0,
        gamma: float = 4.0,
    ) -> RiseGains:
        """Returns gains whose beta satisfies (E32), whatever the disturbance's unit.

        beta is the paper's 6 where that satisfies (E32), else 10 % above the least
        (E36). In the implicit step a large beta costs nothing: the bound (E33) does not
        contain it. alpha has to be more than 1.
        """
        gains = cls(alpha, gamma=gamma)
        least = least_beta(gains, bounds, Intervals(period, period))
        return gains if gains.beta > least else cls(alpha, _GAIN_MARGIN * least, gamma)

    @property
    def decay_rate(self) -> float:
        """lambda_V = min(alpha - 1, gamma) of (E20), or 0 where alpha <= 1 [1/s]."""
        return max(0.0, min(self.alpha - 1.0, self.gamma))

    @property
    def stiffness(self) -> float:
        """The gain from xtil to dI/dt in (E18), alpha gamma + 1 [1/s^2]."""
        return self.alpha * self.gamma + 1.0

    def denominator(self, dt: float) -> float:
        """Returns C of (E24), 1 + dt (alpha + gamma) + dt^2 (alpha gamma + 1)."""
        return 1.0 + dt * (self.alpha + self.gamma) + dt**2 * self.stiffness


class Intervals(NamedTuple):
    """The range of times between one measurement and the next.

    Attributes:
        shortest: The shortest [s].
        longest: The longest; the same, if all are equal [s].
    """

    shortest: float
    longest: float


def least_beta(
    gains: RiseGains, bounds: DisturbanceBounds, intervals: Intervals
) -> float:
    """Returns the lower limit of beta, by (E32), (E35) or (E20) [m/s^3]."""
    shortest, longest = intervals
    size, change = bounds.delta2, bounds.delta3
    if longest > shortest:
        ratio = longest / shortest
        size = bounds.delta2 * (1.0 + ratio) / 2.0
        jump = bounds.delta2 * (ratio - 1.0 / ratio) / 2.0
        change = jump / shortest + bounds.delta3 * ratio * (1.0 + ratio) / 2.0
    stretch = 1.0 + gains.decay_rate * shortest
    slack = max(1.0, gains.alpha - gains.gamma)
    return size + stretch * change / slack


def gain_conditions(
    gains: RiseGains, bounds: DisturbanceBounds, intervals: Intervals, step: str
) -> tuple[Condition, ...]:
    """Returns the gain conditions (E20), in sampled time (E32), (E35).

    The explicit step has those of continuous time, and its linear part has to be
    stable (E37).
    """
    alpha, beta, gamma = gains.alpha, gains.beta, gains.gamma
    sampled = step != "explicit"
    least = least_beta(gains, bounds, intervals if sampled else Intervals(0.0, 0.0))
    factor = "(1 + lambda_V dt) " if sampled else ""
    name = f"beta > delta2 + {factor}delta3 / max(1, alpha - gamma)"
    if sampled and intervals.longest > intervals.shortest:
        name = "beta > least beta of unequal intervals (E35)"
    conditions = (
        Condition("alpha > 1", alpha, 1.0),
        Condition("gamma > 0", gamma, 0.0),
        Condition(name, beta, least),
    )
    if sampled:
        return conditions
    damping = alpha + gamma
    oscillation = math.sqrt(max(0.0, damping**2 - 4.0 * gains.stiffness))
    longest = (damping - oscillation) / gains.stiffness
    stable = Condition("longest stable period > dt", longest, intervals.longest)
    return (*conditions, stable)


def with_quadrature(
    bounds: DisturbanceBounds, quadrature: float, period: float
) -> DisturbanceBounds:
    """Returns bounds of a disturbance that includes the means' quadrature error (E42).

    The period is the shortest time between measurements [s].
    """
    return DisturbanceBounds(
        bounds.delta1 + quadrature,
        bounds.delta2 + 2.0 * quadrature / period,
        bounds.delta3 + 4.0 * quadrature / period**2,
    )


def error_bound(
    gains: RiseGains,
    bounds: DisturbanceBounds,
    period: float,
    step: str,
    boundary_layer: float,
    noise: float,
    num_disturbances: int,
) -> ErrorBound:
    """Returns the bound of the error at the ticks: (E33), (E38), (E39), or (E27).

    Args:
        gains: The gains.
        bounds: Bounds of the disturbance.
        period: Time between measurements [s].
        step: The observer's step.
        boundary_layer: phi, where the saturated step's sign is linear [m/s].
        noise: Standard deviation of each disturbed channel's measurement [m/s].
        num_disturbances: q.
    """
    peak = noise_peak(num_disturbances)
    if step == "explicit":
        law = gains.beta * math.sqrt(3.0 * period / (gains.alpha + gains.gamma))
        chatter = _CHATTER_MARGIN * math.sqrt(num_disturbances) * law
        floor = chatter + peak * gains.gamma * noise
        return ErrorBound(bounds.delta1, gains.decay_rate / 2.0, floor)
    layer, deviation = boundary_layer if step == "saturated" else 0.0, 0.0
    if noise > 0.0:
        layer, deviation = _noise_response(gains, period, layer, noise)
    drift = bounds.delta2 * period
    floor = drift / 2.0 + _layer_floor(gains, bounds, period, layer) + peak * deviation
    rate = math.log1p(gains.decay_rate * period) / (2.0 * period)
    return ErrorBound(bounds.delta1 + drift, rate, floor)


def _layer_floor(
    gains: RiseGains, bounds: DisturbanceBounds, period: float, layer: float
) -> float:
    """Returns the contribution of a boundary layer to the bound (E38)."""
    alpha, kappa = gains.alpha, gains.decay_rate
    if layer == 0.0 or kappa == 0.0:  # Without decay there is no certificate.
        return 0.0
    c = (alpha - kappa) * bounds.delta2 + (1.0 + kappa * period) * bounds.delta3
    square = bounds.delta2**2 + c**2 / (kappa * (2.0 * alpha - kappa))
    return math.sqrt(layer / gains.beta * square)


def _noise_response(
    gains: RiseGains, period: float, boundary_layer: float, noise: float
) -> tuple[float, float]:
    """Returns the response of the implicit or saturated step to white noise (E39).

    The step's s = clip(w / (C phi + dt^2 beta), -1, 1) is replaced by k w + r, with the
    gain k and the uncorrelated rest r that it has for a normal w, and r taken as white.
    The step is then linear; its discrete Lyapunov equation gives the deviation of w,
    which gives k and r in turn. The implicit step has phi = 0.

    Returns:
        The boundary layer that acts, phi widened by the noise [m/s], and the standard
        deviation of each channel of the estimate [m/s^2].
    """
    C, jump = gains.denominator(period), period**2 * gains.beta
    edge = C * boundary_layer + jump
    spread = noise
    for _ in range(60):
        k, rest = _clip_of_normal(edge, spread)
        new_spread, deviation = _stationary(gains, period, noise, k, rest)
        spread = (spread + new_spread) / 2.0
    return (1.0 / k - jump) / C, deviation


def _clip_of_normal(edge: float, spread: float) -> tuple[float, float]:
    """Returns gain and rest's variance of clip(w / edge, -1, 1), w ~ N(0, spread^2)."""
    ratio = edge / spread
    inside = math.erf(ratio / math.sqrt(2.0))
    density = math.sqrt(2.0 / math.pi) * math.exp(-(ratio**2) / 2.0)
    mean_square = inside / ratio**2 - density / ratio + 1.0 - inside
    gain = inside / edge
    return gain, max(0.0, mean_square - (gain * spread) ** 2)


def _stationary(
    gains: RiseGains, dt: float, noise: float, k: float, rest: float
) -> tuple[float, float]:
    """Returns the standard deviations of w and of dhat with s = k w + r in (E24).

    The state is (xtil, I, noise of the last measurement), the input (noise, r).
    """
    C, jump = gains.denominator(dt), dt**2 * gains.beta
    w_state, w_input = np.array([1.0, -dt, -1.0]), np.array([1.0, 0.0])
    s_state, s_input = k * w_state, np.array([k, 1.0])
    x_state = (w_state - jump * s_state) / C
    x_input = (w_input - jump * s_input) / C
    integral = np.array([0.0, 1.0, 0.0])
    A = np.array(
        [
            x_state,
            integral + dt * (gains.stiffness * x_state + gains.beta * s_state),
            np.zeros(3),
        ]
    )
    B = np.array(
        [
            x_input,
            dt * (gains.stiffness * x_input + gains.beta * s_input),
            [1.0, 0.0],
        ]
    )
    Q = B @ np.diag([noise**2, rest]) @ B.T
    P = np.linalg.solve(np.eye(9) - np.kron(A, A), Q.ravel()).reshape(3, 3)
    estimate = np.array([gains.gamma, 1.0, 0.0])
    return math.sqrt(w_state @ P @ w_state + noise**2), math.sqrt(
        estimate @ P @ estimate
    )
