"""The QP of a control tick: its coordinates, its rows and their order of giving way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from operator import mul

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array, require
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.active_set import Projection
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.projection import minimise_linear, nearest_point
from vcbf_drake.safety.unit_rows import UnitRows

# A reference this many input ranges away is as good as one infinitely far; without
# limits, one this many units away.
_FARTHEST_REFERENCE = 1e6
_FARTHEST_IN_UNITS = 1e15
# Where the rows that a solution touches are made of numbers this small, in the QP's
# coordinates, it is solved again in coordinates of their size.
_SMALL = 1e-3
# The least slack or violation leaves a set without interior. Its rows are opened by
# this distance, in normalised inputs.
_MARGIN = 1e-10


@dataclass(frozen=True)
class VolumeRow:
    """A condition a u <= c that may give way: the volume barrier's, or a soft one.

    Attributes:
        a: Shape (m,).
        c: The right-hand side.
        slack_penalty: M of (E54, the DOB-VCBF-QP), for the inexact slack.
        linear_penalty: N of (E71): what the slack itself costs, beside M times its
            square.
        unit: What the row was divided by; its slack is multiplied by it.
    """

    a: Array
    c: float
    slack_penalty: float
    unit: float = 1.0
    linear_penalty: float = 0.0

    @property
    def is_finite(self) -> bool:
        """Whether every number in it is finite."""
        return math.isfinite(self.c) and bool(np.isfinite(self.a).all())

    def slack(self, u: Array) -> float:
        """Returns how far the row gives way at an input, at most 0."""
        return self.unit * min(0.0, self.c - float(self.a @ u))


@dataclass(frozen=True)
class Frame:
    """The coordinates z of a QP, u = origin + size * scale * z.

    Attributes:
        origin: Shape (m,); the input set's center, as a rule.
        scale: The input set's, shape (m,).
        size: 1, as a rule.
        metric: The cost is |metric (z - reference)|^2; no singular value is below 1,
            shape (m, m). None for the identity.
        cost_unit: What the cost was divided by for that.
    """

    origin: Array
    scale: Array
    size: float = 1.0
    metric: Array | None = None
    cost_unit: float = 1.0

    @staticmethod
    def of(input_set: InputSet, weights: ArrayLike | None = None) -> Frame:
        """Returns the frame of the normalised inputs.

        Args:
            input_set: The input set.
            weights: W of the cost (u - u_ref)'W (u - u_ref), a matrix (m, m) or its
                diagonal (m,); by default that of the normalised inputs' norm.

        Raises:
            ValueError: W has another shape or is not positive definite.
        """
        frame = Frame(input_set.center, input_set.scale)
        if weights is None or not np.size(weights):
            return frame
        m, W = input_set.num_inputs, np.array(weights, dtype=float)
        W = np.diag(W) if W.ndim == 1 else W
        rule = f"{m} positive numbers or a positive definite ({m}, {m}) matrix"
        is_matrix = W.shape == (m, m) and bool(np.isfinite(W).all())
        require(
            is_matrix and np.allclose(W, W.T) and np.linalg.eigvalsh(W)[0] > 0.0,
            "input_weights",
            weights,
            rule,
        )
        # Inputs that are fixed have no part in it.
        W = input_set.scale[:, None] * W * input_set.scale
        W[input_set.scale == 0.0, input_set.scale == 0.0] = 1.0
        least = float(np.linalg.eigvalsh(W)[0])
        return replace(frame, metric=np.linalg.cholesky(W / least).T, cost_unit=least)

    @property
    def reach(self) -> float:
        """How large coordinates are in a bounded input set, with its origin in it."""
        return 2.0 / self.size

    def input(self, z: Array) -> Array:
        """Returns u of z, shape (m,)."""
        return self.origin + self.size * self.scale * z[: len(self.scale)]

    def distance(self, A: Array, b: Array) -> Array:
        """Returns the right-hand sides of rows ``A u <= b`` in z, shape (n,)."""
        distance: Array = (b - A @ self.origin) / self.size
        return distance


@dataclass(frozen=True)
class QP:
    """min 1/2 |R (z - reference)|^2 subject to ``A z <= b``.

    The variables are the inputs in the coordinates of a frame, the growth of decay
    rates that may grow and, for each row that gives way at a penalty, sqrt(M) times its
    slack; R is the frame's metric. The rows are the feasible set's that can matter, the
    volume row or the limits of decay rates, and those that give way.

    Attributes:
        frame: The coordinates.
        A: The rows, shape (n, d).
        b: Their right-hand sides, shape (n,).
        reference: Shape (d,).
        num_firm: How many rows, the first, limit the input whatever the state.
        num_hard: How many rows, the first, do not give way.
        has_hard_volume: Whether the last of those is the volume row.
        rows: Which of the feasible set's rows are the first.
        further_rows: Those that follow: "volume", or an index.
        num_decays: How many variables, after the inputs, are growths (E69).
    """

    frame: Frame
    A: Array
    b: Array
    reference: Array
    num_firm: int
    num_hard: int
    has_hard_volume: bool = False
    rows: tuple[int, ...] = ()
    further_rows: tuple[str | int, ...] = ()
    num_decays: int = 0

    def solved(self, solver: str) -> Projection:
        """Returns the minimiser z, shape (d,), and its multipliers.

        Raises:
            EmptySetError: No point satisfies the hard rows, certified.
        """
        A, reference, back = self.as_projection()
        found = nearest_point(A, self.b, reference, self.num_firm, solver)
        return found if back is None else found._replace(point=back @ found.point)

    def as_projection(self) -> tuple[Array, Array, Array | None]:
        """Returns rows and reference in y = R z, and R^-1 (None for the identity)."""
        metric = self.frame.metric
        if metric is None:
            return self.A, self.reference, None
        R, m = np.eye(len(self.reference)), len(metric)
        R[:m, :m] = metric
        back = np.asarray(np.linalg.inv(R), dtype=float)
        return self.A @ back, R @ self.reference, back

    @property
    def hard(self) -> QP:
        """The QP of the rows that never give way."""
        n, d = (
            self.num_hard - self.has_hard_volume,
            len(self.frame.scale) + self.num_decays,
        )
        A, b, reference = self.A[:n, :d], self.b[:n], self.reference[:d]
        return QP(
            self.frame, A, b, reference, self.num_firm, n, num_decays=self.num_decays
        )


def state_qp(
    feasible: FeasibleSet,
    frame: Frame,
    volume_row: VolumeRow | None,
    reference: Array,
    exact_slack: bool,
) -> QP:
    """Returns the tick's QP.

    Args:
        feasible: Input limits and barrier rows.
        frame: The coordinates.
        volume_row: The volume barrier's row, finite; None where it has none.
        reference: The controller's input, finite, shape (m,).
        exact_slack: Whether the volume row is hard; else it gives way at its penalty.
    """
    kept, inputs = feasible.cutting, feasible.input_set
    A, b = feasible.A_v[kept], _distances(feasible, frame)
    z = _normalised(reference, inputs)
    if frame.origin is not inputs.center:
        z = z - inputs.normalised(frame.origin)
    if frame.size != 1.0:
        z = z / frame.size
    soft = [
        VolumeRow(
            feasible.rows.A[i],
            float(feasible.bound[i]),
            feasible.penalties[i],
            linear_penalty=feasible.linear_penalties[i],
        )
        for i in feasible.soft.tolist()
    ]
    further = soft if volume_row is None else [volume_row, *soft]
    if further:
        a, c = np.array([row.a for row in further]), [row.c for row in further]
        A = np.concatenate([A, a * frame.scale])
        b = np.concatenate([b, frame.distance(a, np.array(c))])
    names: list[str | int] = (feasible.num_input_rows + feasible.soft).tolist()
    if volume_row is not None:
        names.insert(0, "volume")
    is_hard = exact_slack and volume_row is not None
    yielding = further[1:] if is_hard else further
    qp = QP(
        frame=frame,
        A=A,
        b=b,
        reference=z,
        num_firm=len(inputs.limits),
        num_hard=len(b) - len(yielding),
        has_hard_volume=is_hard,
        rows=tuple(kept.tolist()),
        further_rows=tuple(names),
    )
    return _with_slacks(qp, yielding)


def _with_slacks(qp: QP, yielding: Sequence[VolumeRow]) -> QP:
    """Gives the last rows slacks delta <= 0 at M delta^2 - N delta (E54), (E71).

    In the variables (z, w = sqrt(M) delta) the cost is a distance again, from
    w = N / (2 sqrt(M)); where that is not 0, a row more keeps w from being positive.
    """
    if not yielding:
        return qp
    frame, m, count = qp.frame, len(qp.reference), len(yielding)
    root = np.sqrt([row.slack_penalty / frame.cost_unit for row in yielding])
    linear = np.array([row.linear_penalty for row in yielding])
    away = linear / (2.0 * frame.cost_unit * frame.size * root)
    slopes = np.concatenate([np.zeros((qp.num_hard, count)), np.diag(1.0 / root)])
    is_kept = linear > 0.0
    signs = np.hstack([np.zeros((count, m)), np.eye(count)])[is_kept]
    names = np.array(qp.further_rows, dtype=object)[-count:][is_kept]
    return replace(
        qp,
        A=np.vstack([np.hstack([qp.A, slopes]), signs]),
        b=np.append(qp.b, np.zeros(len(signs))),
        reference=np.append(qp.reference, away),
        further_rows=(*qp.further_rows, *names),
    )


def _distances(feasible: FeasibleSet, frame: Frame) -> Array:
    """Right-hand sides of the feasible set's rows that can matter, in a frame."""
    kept = feasible.cutting
    if frame.origin is feasible.input_set.center:
        return feasible.b_v[kept] / frame.size
    # From the rows as given: where two large numbers cancel, little is left.
    distance = frame.distance(feasible.A[kept], feasible.b[kept])
    k = len(feasible.input_set.limits)
    length = np.linalg.norm(feasible.input_set.A * frame.scale, axis=1)[kept[:k]]
    distance[:k] /= np.where(length > 0.0, length, 1.0)
    return distance


def _normalised(reference: Array, inputs: InputSet) -> Array:
    v = inputs.normalised(reference)
    if np.abs(v).max() > _FARTHEST_REFERENCE:
        is_open = np.isinf(inputs.farthest(np.eye(len(v))))
        farthest = np.where(is_open, _FARTHEST_IN_UNITS, _FARTHEST_REFERENCE)
        v = v.clip(-farthest, farthest)
    return v


def solve_qp(qp: QP, solver: str) -> tuple[Projection, QP]:
    """Returns a QP's minimiser; where its volume row leaves none, that of one it does.

    The hard volume row gives way by the least that the others allow (E55, the exact
    penalty).

    Args:
        qp: The QP.
        solver: The solver's name.

    Raises:
        EmptySetError: No input satisfies the rows that never give way, certified.
        SolverError: The least slack was not verified.
    """
    try:
        return qp.solved(solver), qp
    except EmptySetError:
        if not qp.has_hard_volume:
            raise
    i, b = qp.num_hard - 1, qp.b.copy()
    z = minimise_linear(qp.A[i], qp.A[:i], b[:i], qp.num_firm, qp.frame.reach)
    length = float(UnitRows(qp.A[i : i + 1], b[i : i + 1]).length[0])
    b[i] = max(b[i], float(qp.A[i] @ z) + _MARGIN * length)
    relaxed = replace(qp, b=b)
    try:
        return relaxed.solved(solver), relaxed
    except EmptySetError as error:
        raise SolverError("no least slack was verified", qp.A, qp.b) from error


def finer_frame(
    feasible: FeasibleSet, frame: Frame, u: Array, touched: NDArray[np.bool_]
) -> Frame | None:
    """Returns coordinates of the size of some barrier rows; None if a frame is that.

    Limits may be as good as none, and then barrier rows are made of numbers that are
    next to nothing in normalised inputs, and so is what separates them.

    Args:
        feasible: The feasible set.
        frame: The coordinates until now.
        u: An input near the rows, shape (m,).
        touched: Which of the rows that can matter, but for the limits, shape (n,).
    """
    first, size = feasible.num_input_rows, math.inf
    reach, scale = np.abs(u).tolist(), frame.scale.tolist()
    rows = feasible.cutting[len(feasible.input_set.limits) :][touched] - first
    for i in rows.tolist():
        entries = np.abs(feasible.rows.A[i]).tolist()
        length = math.hypot(*map(mul, entries, scale))
        terms = abs(float(feasible.bound[i]))
        terms += sum(map(mul, entries, reach))
        if terms > 0.0 and length > 0.0:
            size = min(size, terms / length)
    if not 0.0 < size < _SMALL * frame.size:
        return None
    return replace(frame, origin=feasible.input_set.project(u), size=size)


def least_violation(
    feasible: FeasibleSet, qp: QP, held_input: Array, solver: str
) -> Array:
    """Returns the input whose worst weighted barrier violation is least, shape (m,).

    Among those, the one nearest to the reference; the held input, or the one nearest to
    it that is allowed, where none was verified.

    Args:
        feasible: Input limits and barrier rows.
        qp: The QP of its rows, `QP.hard`.
        held_input: The input applied now, shape (m,).
        solver: The solver's name.
    """
    project, k = feasible.input_set.project, qp.num_firm
    try:
        u = qp.frame.input(_least_violation(feasible, qp, solver))
    except (EmptySetError, SolverError, LinAlgError):
        return project(held_input)
    violated = (qp.A @ _coordinates(u, qp.frame) > qp.b)[k:]
    frame = finer_frame(feasible, qp.frame, u, violated)
    if frame is not None:
        reference = qp.frame.input(qp.reference)
        finer = state_qp(feasible, frame, None, reference, exact_slack=True).hard
        try:
            u = frame.input(_least_violation(feasible, finer, solver))
        except (EmptySetError, SolverError, LinAlgError):
            pass  # In the coordinates before there is an answer.
    return project(u)


def _coordinates(u: Array, frame: Frame) -> Array:
    scale = np.where(frame.scale > 0.0, frame.scale, np.inf)
    z: Array = (u - frame.origin) / (frame.size * scale)
    return z


def _least_violation(feasible: FeasibleSet, qp: QP, solver: str) -> Array:
    """Min t subject to weight_i (a_i u - b_i) <= t, t >= 0, and then the nearest z."""
    A, b, k, m = qp.A.copy(), qp.b.copy(), qp.num_firm, len(qp.frame.scale)
    weight = feasible.weights[feasible.cutting[k:] - feasible.num_input_rows]
    length = UnitRows(A[k:], b[k:]).length
    # t is counted in units of the heaviest row's distance, and from where no input is
    # below it.
    weight /= float(np.max(weight * length, initial=0.0)) or 1.0
    A[k:], b[k:] = A[k:] * weight[:, None], b[k:] * weight
    farthest = feasible.input_set.farthest(A[k:]) / qp.frame.size
    b[k:] += max(0.0, float(np.max(-b[k:] - farthest, initial=0.0)))
    last = np.append(np.zeros(m), 1.0)
    give = np.concatenate([np.zeros(k), np.ones(len(weight))])
    rows = np.vstack([np.column_stack([A, -give]), -last])
    z = minimise_linear(last, rows, np.append(b, 0.0), reach=qp.frame.reach)[:-1]
    b[k:] += np.max(A[k:] @ z - b[k:], initial=0.0) + _MARGIN
    return replace(qp, A=A, b=b).solved(solver).point
