"""The volume barrier: keep the QP's feasible set from vanishing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np

from vcbf_drake.checks import Array, check_parameter, require, require_choice
from vcbf_drake.safety.ellipsoid import Ellipsoid
from vcbf_drake.safety.feasibility_measure import (
    MEASURES,
    FeasibilityMeasure,
    Measurement,
)
from vcbf_drake.safety.feasible_set import DisturbanceKnowledge, FeasibleSet
from vcbf_drake.safety.input_set import InputSet

NO_GUARD = "none"


@dataclass
class VolumeBarrier:
    """The barrier V_v = measure - threshold on the room that rows leave the inputs.

    By default the paper's: V_v = det B - xi of the largest ellipsoid of inputs (E21),
    with B in normalised inputs, so that det B = 1 for a box that no barrier cuts,
    whatever the units of the inputs. Which measure to take for what is in
    docs/results/feasibility_measures.md.

    Attributes:
        threshold: xi, the part of the free volume that must remain.
        gain: lambda_Vv, how fast V_v may decrease towards zero [1/s].
        slack_penalty: M, the weight of the squared slack; unused with the exact slack.
        measure: One of `MEASURES`.
        widening: kappa >= 1: the input set is taken this many times as wide, so that
            rows are felt before they cut it (E58).
        guard: A second measure, of the set as it is: one of `MEASURES`, or ``none``.
            Its row gives way last.
        guard_gain: How fast the guard may decrease towards zero [1/s].
    """

    threshold: float = 0.02
    gain: float = 3.0
    slack_penalty: float = 1000.0
    measure: str = "volume"
    widening: float = 1.0
    guard: str = "none"
    guard_gain: float = 3.0

    def __post_init__(self) -> None:
        for name in ("threshold", "gain", "slack_penalty", "guard_gain"):
            check_parameter(name, getattr(self, name))
        rule = "below 1, det B of the free box"
        require(self.threshold < 1.0, "threshold", self.threshold, rule)
        is_wide = math.isfinite(self.widening) and self.widening >= 1.0
        require(is_wide, "widening", self.widening, "finite and at least 1")
        for name, allowed in (
            ("measure", [*MEASURES]),
            ("guard", [NO_GUARD, *MEASURES]),
        ):
            require_choice(name, getattr(self, name), allowed)

    @property
    def label(self) -> str:
        """What V_v measures, in a few words, for summaries and figures."""
        words = self.measure.replace("_", " ")
        if self.widening == 1.0:
            return words
        return f"{words}, inputs x {self.widening:g}"

    def feasibility_measure(self, input_set: InputSet) -> FeasibilityMeasure:
        """Returns what the volume row keeps positive.

        Raises:
            ValueError: The measure is not defined for that many inputs.
        """
        return MEASURES[self.measure](input_set, self.threshold, self.widening)

    def guard_measure(self, input_set: InputSet) -> FeasibilityMeasure | None:
        """Returns what the guard row keeps positive, if there is one.

        Raises:
            ValueError: The measure is not defined for that many inputs.
        """
        if self.guard == NO_GUARD:
            return None
        return MEASURES[self.guard](input_set, self.threshold)


@dataclass(frozen=True)
class Volume:
    """V_v at one tick and its partial derivatives (E44), in normalised inputs.

    Attributes:
        value: V_v, the measure minus its threshold.
        ellipsoid: The largest ellipsoid of the set, in normalised inputs; None when the
            set is empty or the measure needs no ellipsoid of it.
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
    def unmoved(measured: Measurement, num_states: int, num_channels: int) -> Volume:
        """Returns V_v of a set that no barrier row cuts.

        Args:
            measured: The measure of the input set.
            num_states: n.
            num_channels: q.
        """
        state, estimate = np.zeros(num_states), np.zeros(num_channels)
        return Volume(measured.value, measured.ellipsoid, state, 0.0, estimate, 0.0)

    @cached_property
    def is_on_plateau(self) -> bool:
        """Whether there is room, and no row that touches it and could take it away."""
        moving = self.state.any() or self.time or self.estimate.any() or self.bound
        return bool(self.value >= 0.0 and not moving)

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


def volume(measured: Measurement, feasible: FeasibleSet, input_set: InputSet) -> Volume:
    """Returns a measure and its partial derivatives by the envelope theorem (E44).

    Args:
        measured: The measure of the feasible set, in normalised inputs.
        feasible: The feasible set.
        input_set: The input set, for the scaling of the inputs.
    """
    rows, known = feasible.rows, feasible.known
    n = rows.num_states
    touching = measured.multipliers.nonzero()[0].tolist()
    extended, estimate, bound = np.zeros(n + 1), np.zeros(len(known.estimate)), 0.0
    gradients = rows.gradients(touching) if touching else ()
    for i, gradient in zip(touching, gradients, strict=True):
        contact = input_set.center + input_set.scale * measured.contacts[i]
        w, margin = rows.w[i], known.estimate
        w_norm = math.sqrt(w @ w)
        if w_norm > 0.0:
            margin = margin - known.bound / w_norm * w
        # d(b + Lambda - A u) at the contact u, from the gradients of [A, b, w].
        change = np.concatenate([-contact, (1.0,), margin]) @ gradient
        multiplier = float(measured.multipliers[i])
        extended += multiplier * change
        estimate += multiplier * w
        bound -= multiplier * w_norm
    return Volume(
        value=measured.value,
        ellipsoid=measured.ellipsoid,
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
