"""The volume barrier: keep the QP's feasible set from vanishing."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from vcbf_drake.errors import Array
from vcbf_drake.safety.ellipsoid import Ellipsoid
from vcbf_drake.safety.feasible_set import DisturbanceKnowledge, FeasibleSet
from vcbf_drake.safety.input_set import InputSet


@dataclass
class VolumeBarrier:
    """The barrier V_v = det B - threshold on the largest ellipsoid of inputs (E21).

    B is the ellipsoid's shape in normalised inputs, so det B = 1 for a box that no
    barrier cuts, whatever the units of the inputs.

    Attributes:
        threshold: xi, the part of the free volume that must remain.
        gain: lambda_Vv, how fast V_v may decrease towards zero [1/s].
        slack_penalty: M, the weight of the squared slack; unused with the exact slack.
    """

    threshold: float = 0.02
    gain: float = 3.0
    slack_penalty: float = 1000.0

    def __post_init__(self) -> None:
        for name in ("threshold", "gain", "slack_penalty"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(
                    f"VolumeBarrier.{name}: got {value}; must be positive and finite"
                )


@dataclass(frozen=True)
class Volume:
    """V_v at one tick and its partial derivatives (E44), in normalised inputs.

    Attributes:
        value: V_v = det B - threshold.
        ellipsoid: The ellipsoid in normalised inputs; None when the set is empty.
        state: dV_v/dx, shape (n,).
        time: dV_v/dt with state, estimate and bound held [1/s].
        estimate: dV_v/d(estimate), shape (q,).
        bound: dV_v/d(error bound), at most zero.
    """

    value: float
    ellipsoid: Ellipsoid | None
    state: Array
    time: float
    estimate: Array
    bound: float

    @staticmethod
    def vanished(num_states: int, num_disturbances: int, threshold: float) -> Volume:
        """Returns V_v of an empty set: no volume, and no direction to regain it."""
        return Volume(
            value=-threshold,
            ellipsoid=None,
            state=np.zeros(num_states),
            time=0.0,
            estimate=np.zeros(num_disturbances),
            bound=0.0,
        )

    @property
    def is_on_plateau(self) -> bool:
        """Whether no barrier touches the ellipsoid, so that V_v has no gradient."""
        moving = self.state.any() or self.time or self.estimate.any() or self.bound
        return self.ellipsoid is not None and not moving

    def rate(
        self, state_rate: Array, known: DisturbanceKnowledge, disturbance: Array
    ) -> float:
        """Returns dV_v/dt when the disturbance is known (E26) [1/s].

        Args:
            state_rate: dx/dt under the input and the disturbance, shape (n,).
            known: What the observer says.
            disturbance: The true disturbance, shape (q,).
        """
        estimate_rate = known.rate + known.gain * (disturbance - known.estimate)
        return float(
            self.state @ state_rate
            + self.time
            + self.estimate @ estimate_rate
            + self.bound * known.bound_rate
        )


def volume(
    ellipsoid: Ellipsoid,
    feasible: FeasibleSet,
    input_set: InputSet,
    threshold: float,
) -> Volume:
    """Returns V_v and its partial derivatives by the envelope theorem (E43), (E44).

    Args:
        ellipsoid: The largest ellipsoid of the feasible set, in normalised inputs.
        feasible: The feasible set.
        input_set: The input set, for the scaling of the inputs.
        threshold: xi of (E21).
    """
    rows, known, k = feasible.rows, feasible.known, feasible.num_input_rows
    n = rows.num_states
    determinant = math.exp(ellipsoid.log_det)
    touching = ellipsoid.multipliers[k:].nonzero()[0].tolist()
    extended, estimate, bound = np.zeros(n + 1), np.zeros(len(known.estimate)), 0.0
    gradients = rows.gradients(touching) if touching else ()
    for i, gradient in zip(touching, gradients, strict=True):
        normal = ellipsoid.shape @ feasible.A_v[k + i]
        reach = ellipsoid.shape @ normal / math.sqrt(normal @ normal)
        contact = input_set.center + input_set.scale * (ellipsoid.center + reach)
        w, margin = rows.w[i], known.estimate
        w_norm = math.sqrt(w @ w)
        if w_norm > 0.0:
            margin = margin - known.bound / w_norm * w
        # d(b + Lambda - A u) at the contact u, from the gradients of [A, b, w].
        change = np.concatenate([-contact, (1.0,), margin]) @ gradient
        multiplier = determinant * float(ellipsoid.multipliers[k + i])
        extended += multiplier * change
        estimate += multiplier * w
        bound -= multiplier * w_norm
    return Volume(
        value=determinant - threshold,
        ellipsoid=ellipsoid,
        state=extended[:n],
        time=float(extended[n]),
        estimate=estimate,
        bound=bound,
    )


def volume_row(
    volume: Volume,
    drift: Array,
    input_matrix: Array,
    disturbance_matrix: Array,
    known: DisturbanceKnowledge,
    gain: float,
    total_derivative: bool,
) -> tuple[Array, float]:
    """Returns the row a and the number c of the volume barrier's condition a u <= c.

    The total derivative is (E28); without it the row leaves out that the estimate
    moves, as printed (E23), (E24).

    Args:
        volume: V_v and its derivatives.
        drift: f(x), shape (n,).
        input_matrix: g(x), shape (n, m).
        disturbance_matrix: E, shape (n, q).
        known: What is known of the disturbance.
        gain: lambda_Vv [1/s].
        total_derivative: Which derivative.
    """
    along_disturbance = volume.state @ disturbance_matrix
    along_error = along_disturbance
    known_rate = (
        volume.state @ drift
        + volume.time
        + volume.bound * known.bound_rate
        + along_disturbance @ known.estimate
    )
    if total_derivative:
        known_rate += volume.estimate @ known.rate
        along_error = along_disturbance + known.gain * volume.estimate
    worst = float(np.linalg.norm(along_error)) * known.bound
    return -volume.state @ input_matrix, float(known_rate - worst + gain * volume.value)
