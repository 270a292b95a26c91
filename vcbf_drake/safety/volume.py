"""The volume barrier: keep the QP's feasible set from vanishing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np

from vcbf_drake.checks import Array, check_parameter, require
from vcbf_drake.errors import EmptySetError
from vcbf_drake.safety.ellipsoid import (
    THINNEST,
    Ellipsoid,
    InscribedEllipsoidSolver,
)
from vcbf_drake.safety.feasible_set import DisturbanceKnowledge, FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.programs import DEFAULT_SOLVER
from vcbf_drake.typed import check_fields

# The thresholds that a start can lead to: the least is a ball of this radius.
_LEAST_RADIUS, _MOST_THRESHOLD = 1e-4, 0.02


@dataclass
class VolumeBarrier:
    """The barrier V_v = det B - xi on the room that rows leave the inputs (E49).

    B is the shape of the largest ellipsoid of inputs, in normalised inputs, so that
    det B = 1 for a box that no barrier cuts, whatever the units of the inputs.

    Attributes:
        threshold: xi, the part of the free volume that must remain; null for a tenth
            of what the set has at the first tick, at most 0.02 (E50).
        gain: lambda_Vv, how fast V_v may decrease towards zero [1/s].
        slack_penalty: M, the weight of the squared slack; unused with the exact slack.
        widening: kappa >= 1: the input set is taken this many times as wide, so that
            rows are felt before they cut it (E64, widening).
    """

    threshold: float | None = None
    gain: float = 3.0
    slack_penalty: float = 1000.0
    widening: float = 1.0

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("gain", "slack_penalty"):
            check_parameter(name, getattr(self, name))
        if self.threshold is not None:
            check_parameter("threshold", self.threshold)
            rule = "below 1, det B of the free box"
            require(self.threshold < 1.0, "threshold", self.threshold, rule)
        is_wide = math.isfinite(self.widening) and self.widening >= 1.0
        require(is_wide, "widening", self.widening, "finite and at least 1")

    @property
    def label(self) -> str:
        """The measure V_v in a few words, for summaries and figures."""
        if self.widening == 1.0:
            return "volume"
        return f"volume, inputs x {self.widening:g}"


def threshold_of(determinant: float, num_inputs: int) -> float:
    """Returns xi of a barrier that has none, from det B at its start (E50)."""
    least = least_threshold(num_inputs)
    return float(np.clip(determinant / 10.0, least, _MOST_THRESHOLD))


def least_threshold(num_inputs: int) -> float:
    """Returns the least xi that a start can lead to (E50)."""
    return _LEAST_RADIUS**num_inputs


@dataclass(frozen=True)
class Measurement:
    """V_v of one polytope {v : A v <= b} and its derivative (E63).

    dV_v = sum_i mu_i (db_i - da_i p_i).

    Attributes:
        value: det B - xi: positive when there is more room than the threshold.
        multipliers: mu_i = dV_v/db_i, at least zero, shape (n,).
        contacts: p_i, where the ellipsoid touches the rows, shape (n, m); matters only
            where mu_i is positive.
        ellipsoid: The largest ellipsoid; None when the set is empty, or widened.
    """

    value: float
    multipliers: Array
    contacts: Array
    ellipsoid: Ellipsoid | None = None


class VolumeMeasure:
    """det B - xi of the largest ellipsoid of an input set under barrier rows (E49).

    All in normalised inputs v (see `InputSet`). With a widening kappa > 1 the input
    set is replaced by kappa times itself (E64): in the coordinates v / kappa, the same
    input set under the rows A v <= b / kappa. An empty set counts as a ball that is too
    small to be told from one.

    Args:
        input_set: The inputs before any row cuts them.
        threshold: xi, the share of the bounding box's volume that must remain.
        widening: See the attribute.
        solver: The name of the solver that proposes ellipsoids.

    Attributes:
        widening: kappa.
    """

    def __init__(
        self,
        input_set: InputSet,
        threshold: float,
        widening: float = 1.0,
        solver: str = DEFAULT_SOLVER,
    ) -> None:
        self._num_limits = len(input_set.b_normalised)
        self._threshold, self.widening = threshold, widening
        self._solver = InscribedEllipsoidSolver(input_set, solver)

    def __call__(self, A: Array, b: Array) -> Measurement:
        """Returns V_v of the input set under the rows ``A v <= b``.

        Args:
            A: The barrier rows, shape (N, m).
            b: Their right-hand sides, shape (N,).

        Raises:
            SolverError: No ellipsoid could be certified.
        """
        if self.widening == 1.0:
            return self._measured(A, b)
        found = self._measured(A, b / self.widening)
        return replace(
            found,
            multipliers=found.multipliers / self.widening,
            contacts=found.contacts * self.widening,
            ellipsoid=None,
        )

    def _measured(self, A: Array, b: Array) -> Measurement:
        contacts = np.zeros(A.shape)
        try:
            ellipsoid = self._solver.solve(A, b)
        except EmptySetError:
            value = THINNEST ** A.shape[1] - self._threshold
            return Measurement(value, np.zeros(len(b)), contacts)
        determinant = math.exp(ellipsoid.log_det)
        multipliers = determinant * ellipsoid.multipliers[self._num_limits :]
        for i in multipliers.nonzero()[0].tolist():
            q = ellipsoid.shape @ A[i]
            contacts[i] = ellipsoid.center + ellipsoid.shape @ q / math.sqrt(q @ q)
        return Measurement(
            determinant - self._threshold, multipliers, contacts, ellipsoid
        )


@dataclass(frozen=True)
class Volume:
    """V_v at one tick and its partial derivatives (E58), in normalised inputs.

    Attributes:
        value: V_v.
        ellipsoid: The largest ellipsoid of the set, in normalised inputs; None when the
            set is empty or widened.
        state: dV_v/dx, shape (n,).
        time: dV_v/dt with state, estimate and bound held [1/s].
        estimate: dV_v/d(estimate), shape (q,).
        bound: dV_v/d(error bound), at most zero.
        unit: det B, as whose share the row is stated: among strong actuators it may be
            1e-15, and so small what its row is made of.
    """

    value: float
    ellipsoid: Ellipsoid | None
    state: Array
    time: float
    estimate: Array
    bound: float
    unit: float = 1.0

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
        """Returns dV_v/dt when the disturbance is known (E60) [1/s].

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
    """Returns a measure and its partial derivatives by the envelope theorem (E58).

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

    The total derivative is (E62); without it the row leaves out that the estimate
    moves, as printed (E53, the printed volume term), (E54).

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
