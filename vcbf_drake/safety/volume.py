"""The volume barrier: keep the QP's feasible set from vanishing."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from vcbf_drake.checks import Array, require
from vcbf_drake.errors import EmptySetError, SolverError, VcbfError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.ellipsoid import (
    THINNEST,
    Ellipsoid,
    ellipsoid_of_unit_rows,
    inscribed_ellipsoid,
    symmetric,
)
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import chebyshev_ball
from vcbf_drake.safety.programs import DEFAULT_SOLVER
from vcbf_drake.safety.qp import DisturbanceKnowledge, FeasibleSet, VolumeRow
from vcbf_drake.typed import Positive, check_fields

# The thresholds that a start can lead to: the least is a ball of this radius.
_LEAST_RADIUS, _MOST_THRESHOLD = 1e-4, 0.02
# The least divisor.
_SHORTEST = 1e-300


@dataclass
class VolumeBarrier:
    """The barrier V_v = det B - xi on the volume of the feasible set (E49).

    B is the shape of the largest ellipsoid of inputs, in normalised inputs, so that det
    B = 1 for a box that no barrier cuts, in any units of the inputs.

    The defaults suit plants without tuning: early and gentle, at the price of time
    (docs/results/feasibility_defaults.md). The paper's are a gain of 3 and a widening
    of 1.

    Attributes:
        threshold: xi, the share of the input set's volume that must remain; null for a
            tenth of det B at the first tick, at most 0.02 (E50).
        gain: lambda_Vv, the rate at which V_v may decay towards zero [1/s].
        slack_penalty: M, the weight of the squared slack; unused with the exact slack.
        widening: kappa >= 1: the volume is measured over an input set this many times
            as wide, so that a row reduces it before it cuts the true one (E64,
            widening).
    """

    threshold: Positive | None = None
    gain: Positive = 0.1
    slack_penalty: Positive = 1000.0
    widening: float = 8.0

    def __post_init__(self) -> None:
        check_fields(self)
        rule = "below 1, det B of the free box"
        require((self.threshold or 0.0) < 1.0, "threshold", self.threshold, rule)
        is_wide = math.isfinite(self.widening) and self.widening >= 1.0
        require(is_wide, "widening", self.widening, "finite and at least 1")

    @property
    def label(self) -> str:
        """The measure V_v in a few words, for summaries and figures."""
        if self.widening == 1.0:
            return "volume"
        return f"volume, inputs x {self.widening:g}"

    @property
    def choice(self) -> str:
        """The origin of widening, gain and threshold, in a sentence."""
        default, threshold, words = VolumeBarrier(), "given", "given"
        if (self.widening, self.gain) == (default.widening, default.gain):
            words = "the default, for untuned plants (docs/guide/feasibility.md)"
        if self.threshold is None:
            threshold = f"a tenth of det B at the start, at most {_MOST_THRESHOLD:g}"
        return f"widening and gain are {words}; the threshold is {threshold}"


def threshold_of(determinant: float, num_inputs: int) -> float:
    """Returns xi of a barrier that has none, from det B at its start (E50)."""
    least = least_threshold(num_inputs)
    return float(np.clip(determinant / 10.0, least, _MOST_THRESHOLD))


def least_threshold(num_inputs: int) -> float:
    """Returns the least xi that a start can lead to (E50)."""
    return _LEAST_RADIUS**num_inputs


class Volume(NamedTuple):
    """V_v, or det B, at one tick and its partial derivatives (E58).

    Attributes:
        value: V_v.
        ellipsoid: The largest ellipsoid, in normalised inputs; None when the set is
            empty or widened.
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

    def above(self, threshold: float) -> Volume:
        """Returns V_v, where this is det B: less its threshold xi."""
        return Volume(self.value - threshold, *self[1:])

    @property
    def is_on_plateau(self) -> bool:
        """Whether there is room, and no row that touches it and could take it away."""
        moving = self.state.any() or self.time or self.estimate.any() or self.bound
        return bool(self.value >= 0.0 and not moving)


class VolumeMeasure:
    """det B of the largest ellipsoid of an input set under barrier rows (E49).

    All in normalised inputs v (see `InputSet`). With a widening kappa > 1 the input
    set is replaced by kappa times itself, about its own ellipsoid's centre v_0 (E64):
    in the coordinates v_0 + (v - v_0) / kappa, the same input set under rows further
    away. An empty set counts as a ball that is too small to be told from one.

    Args:
        input_set: The inputs before any row cuts them.
        widening: kappa.
        solver: The name of the solver that proposes ellipsoids; where it takes no cone
            programs, `DEFAULT_SOLVER` does.

    Attributes:
        free: The ellipsoid of the input set alone, where it is bounded.
    """

    free: Ellipsoid

    def __init__(
        self, input_set: InputSet, widening: float = 1.0, solver: str = DEFAULT_SOLVER
    ) -> None:
        self._input_set, self._widening, self._solver = input_set, widening, solver
        if input_set.is_bounded:
            self.free = input_set.largest_ellipsoid

    def __call__(self, feasible: FeasibleSet) -> Volume | None:
        """Returns det B and its derivatives, by the envelope theorem (E58).

        None where the inputs have no bounds, numbers are not finite or no ellipsoid
        could be certified.
        """
        if not (self._input_set.is_bounded and feasible.is_finite):
            return None
        kappa, m = self._widening, self._input_set.num_inputs
        cut, A, b = feasible.cut_by(kappa)
        try:
            found = self.largest(A, b) if len(cut) else self.free
        except EmptySetError:
            return self._constant(feasible, THINNEST**m, None)
        except (SolverError, np.linalg.LinAlgError):
            return None
        determinant = math.exp(found.log_det)
        weights = found.multipliers[feasible.num_input_rows :]
        touching = weights.nonzero()[0] if len(cut) else cut
        ellipsoid = found if kappa == 1.0 or not len(cut) else None
        if not len(touching):
            return self._constant(feasible, determinant, ellipsoid)
        weights = determinant / kappa * weights[touching]
        inputs, rows, known = self._input_set, feasible.rows, feasible.known
        barriers = cut[touching]
        contacts = kappa * found.contact_points(A[touching])
        if not inputs.is_box:
            contacts -= (kappa - 1.0) * self.free.center
        w = rows.w[barriers]
        w_norm = np.sqrt(np.vecdot(w, w))
        direction = w / np.maximum(w_norm, _SHORTEST)[:, None]
        # Of d(b + Lambda - A u) at the contacts u, from the gradients of [A, b, w].
        change = np.empty((len(w), m + 1 + w.shape[1]))
        change[:, :m] = -inputs.center - inputs.scale * contacts
        change[:, m] = 1.0
        change[:, m + 1 :] = known.estimate - known.bound * direction
        gradients = rows.gradients(barriers.tolist())
        by_entry = gradients.reshape(change.size, -1)
        extended = (weights[:, None] * change).ravel() @ by_entry
        state, time = extended[:-1], float(extended[-1])
        by_known = weights @ w, -float(weights @ w_norm)
        return Volume(determinant, ellipsoid, state, time, *by_known, determinant)

    @staticmethod
    def _constant(
        feasible: FeasibleSet, determinant: float, ellipsoid: Ellipsoid | None
    ) -> Volume:
        """A volume that no row that moves touches."""
        n, q = feasible.rows.num_states, len(feasible.known.estimate)
        still = np.zeros(n), 0.0, np.zeros(q), 0.0
        return Volume(determinant, ellipsoid, *still, determinant)

    def packed(self, feasible: FeasibleSet, known: Volume | None) -> Array:
        """Returns the value of the port ``feasible_set``: see `unpack_feasible_set`.

        V_v may have found its ellipsoid already.
        """
        inputs, m = self._input_set, self._input_set.num_inputs
        found = known.ellipsoid if known else None
        try:
            if not found and inputs.is_bounded:
                found = self.largest(*feasible.cut_by(1.0)[1:])
        except (VcbfError, ValueError, np.linalg.LinAlgError):
            pass
        frame, center = np.full((m, m), np.nan), np.full(m, np.nan)
        if found is not None:
            frame = inputs.scale[:, None] * found.frame
            center = inputs.center + inputs.scale * found.center
        return np.concatenate([feasible.A.ravel(), feasible.b, frame.ravel(), center])

    @np.errstate(over="ignore", divide="ignore", invalid="ignore")
    def largest(self, A: Array, b: Array) -> Ellipsoid:
        """Returns the largest ellipsoid in v of a bounded input set with ``A v <= b``.

        When the input set's own meets every row, it is the answer: the plateau. Its
        multipliers are those of `InputSet.A_normalised` (of a box +v_1, .., +v_m, -v_1,
        .., -v_m), and then of the rows given.

        Raises:
            EmptySetError: Input set and rows have no interior in common, or one too
                thin (an inradius below 1e-7) to be certified.
            SolverError: No ellipsoid could be certified.
            ValueError: Numbers that are not finite.
        """
        inputs, free, k = self._input_set, self.free, len(self.free.multipliers)
        length = reach = np.sqrt(np.vecdot(A, A))
        if not inputs.is_box:
            reach = np.linalg.norm(A @ free.frame, axis=1)
        if (reach <= b - A @ free.center).all():
            multipliers = np.concatenate([free.multipliers, np.zeros(len(b))])
            return free._replace(multipliers=multipliers)
        lengths = length.tolist()
        is_plain = 0.0 < min(lengths) and math.isfinite(sum(lengths) + sum(b.tolist()))
        if is_plain:
            A, b = A / length[:, None], b / length
        A = np.concatenate([inputs.A_normalised, A])
        b = np.concatenate([inputs.b_normalised, b])
        if not is_plain:
            return inscribed_ellipsoid(A, b)
        try:
            found = self._cut(A, b)
        except SolverError:
            radius = chebyshev_ball(A, b)[1]
            if radius < THINNEST:
                raise EmptySetError(A, b, radius) from None
            raise
        found.multipliers[k:] /= length
        return found

    def _cut(self, A: Array, b: Array) -> Ellipsoid:
        """The same, of all rows, of unit length.

        An input of a box that no other row mentions is an axis, of half-length 1.
        """
        is_box, m = self._input_set.is_box, A.shape[1]
        matters = [any(column) for column in A[2 * m :].T.tolist()]
        if not is_box or all(matters):
            return ellipsoid_of_unit_rows(A, b, self._solver, is_box)
        cut = np.flatnonzero(matters)
        own = np.concatenate([cut, m + cut, np.arange(2 * m, len(b))])
        found = ellipsoid_of_unit_rows(A[own[:, None], cut], b[own], self._solver, True)
        center, frame = self.free.center.copy(), self.free.frame.copy()
        center[cut], frame[cut[:, None], cut] = found.center, found.frame
        multipliers = np.full(len(b), 0.5)
        multipliers[own] = found.multipliers
        return found._replace(center=center, frame=frame, multipliers=multipliers)


def volume_row(
    volume: Volume,
    model: ControlAffineModel,
    state: Array,
    known: DisturbanceKnowledge,
    barrier: VolumeBarrier,
    total_derivative: bool,
    exact_slack: bool,
) -> VolumeRow:
    """Returns the volume barrier's condition a u <= c, as a share of det B.

    The total derivative is (E62); without it the row leaves out that the estimate
    moves, as printed (E53, the printed volume term), (E54). With the exact slack (E55)
    the row is hard; without, it has the printed penalty.
    """
    drift, input_matrix = model.drift_and_input_matrix(state)
    along_disturbance = volume.state @ model.disturbance_matrix
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
    worst = math.sqrt(along_error @ along_error) * known.bound
    c = float(known_rate - worst + barrier.gain * volume.value) / volume.unit
    penalty = math.inf if exact_slack else barrier.slack_penalty * volume.unit**2
    a = volume.state @ input_matrix / -volume.unit
    return VolumeRow(a, c, penalty, unit=volume.unit)


class PackedFeasibleSet(NamedTuple):
    """The ``feasible_set`` port's value, taken apart; leading axes are kept.

    Attributes:
        A: Rows in physical inputs, (..., rows, m).
        b: Right-hand sides, (..., rows).
        shape: The largest ellipsoid's symmetric B, (..., m, m); nan when empty.
        center: Its center, (..., m); nan when empty.
    """

    A: Array
    b: Array
    shape: Array
    center: Array


def unpack_feasible_set(packed: Array, num_inputs: int) -> PackedFeasibleSet:
    """Takes apart one value, or an array of values, of the ``feasible_set`` port.

    A value is A, b and, of the largest ellipsoid without widening, F with F F' = B^2
    and the center; nan where there is none.

    Args:
        packed: Shape (..., size of the port).
        num_inputs: m.
    """
    *lead, size = packed.shape
    m, rows = num_inputs, size // (num_inputs + 1) - num_inputs
    A, b, frame, center = np.split(packed, np.cumsum([rows * m, rows, m * m]), axis=-1)
    shape = symmetric(frame.reshape(*lead, m, m))
    return PackedFeasibleSet(A.reshape(*lead, rows, m), b, shape, center)
