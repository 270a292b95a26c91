"""The inputs that a control tick may choose from, and the QP over them.

Input limits and robust barrier rows are the feasible set; the QP has its rows that can
matter, the volume row and those that give way, in coordinates in which its cost is a
distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array, require
from vcbf_drake.safety.input_set import InputSet


class DisturbanceKnowledge(NamedTuple):
    """The knowledge of the disturbance d at one time: ``|d - estimate| <= bound``.

    Attributes:
        estimate: The estimate, shape (q,) [m/s^2].
        rate: The part of its time derivative that does not depend on the unknown
            error, shape (q,) [m/s^3].
        bound: The bound on the error's norm [m/s^2].
        bound_rate: The bound's time derivative [m/s^3].
        gain: The gain from the unknown error to the estimate's rate [1/s]:
            d(estimate)/dt = rate + gain (d - estimate).
    """

    estimate: Array
    rate: Array
    bound: float
    bound_rate: float
    gain: float

    @staticmethod
    def constant(num_disturbances: int, bound: float) -> DisturbanceKnowledge:
        """Returns the knowledge without an observer: a fixed ball around zero."""
        zero = np.zeros(num_disturbances)
        return DisturbanceKnowledge(zero, zero, bound, 0.0, 0.0)


@dataclass(frozen=True)
class RowCosts:
    """The costs of violated barrier rows.

    Attributes:
        weights: The weight of each violation where not all rows can hold, shape (N,).
        penalties: For soft rows the penalty of their squared slack, else infinity,
            shape (N,).
        linear_penalties: For soft rows the penalty of the slack itself, shape (N,).
    """

    weights: Array
    penalties: Array
    linear_penalties: Array

    @staticmethod
    def equal(num_rows: int) -> RowCosts:
        """Returns the costs of N hard rows that count alike."""
        ones = np.ones(num_rows)
        return RowCosts(ones, np.full(num_rows, np.inf), 0.0 * ones)

    @cached_property
    def soft(self) -> list[int]:
        """Indices of the soft rows."""
        return np.flatnonzero(np.isfinite(self.penalties)).tolist()


class VolumeRow(NamedTuple):
    """A condition a u <= c that may give way: the volume barrier's, or a soft one.

    Attributes:
        a: Shape (m,).
        c: The right-hand side.
        slack_penalty: M of (E54, the DOB-VCBF-QP); infinite for a hard row.
        unit: The divisor of the row, which multiplies its slack.
        linear_penalty: N of (E71): the penalty of the slack itself, beside M times its
            square.
        name: "volume", or the index of the feasible set's row that it is.
    """

    a: Array
    c: float
    slack_penalty: float = math.inf
    unit: float = 1.0
    linear_penalty: float = 0.0
    name: str | int = "volume"

    @property
    def is_finite(self) -> bool:
        """Whether every number in it is finite."""
        return all(map(math.isfinite, (self.c, *self.a.tolist())))

    def slack(self, u: Array) -> float:
        """Returns the row's slack at an input, at most 0."""
        return self.unit * min(0.0, self.c - float(self.a @ u))


class FeasibleSet(NamedTuple):
    """The polytope ``{u : A u <= b}`` of (E46), with the barrier rows it came from.

    The first rows are the input set's, then follows one row per barrier.

    Attributes:
        input_set: The input limits, for every state.
        rows: The barrier rows.
        bound: The right-hand side of each with its margin, b + Lambda, shape (N,).
        known: The knowledge of the disturbance in the rows.
        costs: The costs of violated rows.
        normals: The barrier rows in normalised inputs v, u = center + scale v, (N, m).
        distance: Their right-hand sides, shape (N,). The set takes no notice of soft
            rows: there is infinity.
        farthest: Their most on the inputs' bounding box, shape (N,).
        cut: Indices of those that cut it; the others hold for every input.
        is_finite: Whether every number in the rows is finite.
    """

    input_set: InputSet
    rows: BarrierRows
    bound: Array
    known: DisturbanceKnowledge
    costs: RowCosts
    normals: Array
    distance: Array
    farthest: Array
    cut: NDArray[np.intp]
    is_finite: bool

    @property
    def A(self) -> Array:
        """The rows, shape (k + N, m)."""
        return np.concatenate([self.input_set.A, self.rows.A])

    @property
    def b(self) -> Array:
        """Their right-hand sides, shape (k + N,)."""
        b = np.where(np.isinf(self.costs.penalties), self.bound, np.inf)
        return np.concatenate([self.input_set.b, b])

    @property
    def num_input_rows(self) -> int:
        """The number k of rows that limit the input whatever the state."""
        return len(self.input_set.b)

    def tightened(self, reserve: Array) -> FeasibleSet:
        """Returns the subset that leaves every barrier row a reserve, (N,) (E88)."""
        return feasible_set(self.input_set, self.rows, self.known, self.costs, reserve)

    def cut_by(self, widening: float) -> tuple[NDArray[np.intp], Array, Array]:
        """Returns the barrier rows that cut the input set, taken so many times (E64).

        Their indices, and the rows in the v of the set as it is: normals (k, m),
        distances (k,).
        """
        cut, distance, inputs = self.cut, self.distance, self.input_set
        if widening != 1.0:
            distance = distance / widening
            if not inputs.is_box:
                center = inputs.largest_ellipsoid.center
                distance += (1.0 - 1.0 / widening) * (self.normals @ center)
            cut = (distance < self.farthest).nonzero()[0]
        return cut, self.normals[cut], distance[cut]

    def soft_rows(self) -> list[VolumeRow]:
        """Returns the soft rows, which give way at their penalties."""
        A, b, costs, k = self.rows.A, self.bound, self.costs, self.num_input_rows
        squares, linear = costs.penalties, costs.linear_penalties
        return [
            VolumeRow(A[i], float(b[i]), squares[i], 1.0, linear[i], k + i)
            for i in costs.soft
        ]


def disturbance_margin(rows: BarrierRows, known: DisturbanceKnowledge) -> Array:
    """Returns Lambda, the certified lower bound of w'd per row (E44), shape (N,)."""
    w_norm = np.sqrt(np.vecdot(rows.w, rows.w))
    return rows.w @ known.estimate - w_norm * known.bound


def feasible_set(
    input_set: InputSet,
    rows: BarrierRows,
    known: DisturbanceKnowledge,
    costs: RowCosts | None = None,
    reserve: Array | None = None,
) -> FeasibleSet:
    """Returns the feasible set of (E46): A u <= b + Delta b.

    Args:
        input_set: The inputs the actuators can produce.
        rows: The barriers' rows at one state and time.
        known: The knowledge of the disturbance there.
        costs: The costs of violated rows; by default all are hard.
        reserve: What is taken off each barrier row, not negative, shape (N,).
    """
    costs = costs or RowCosts.equal(len(rows.b))
    bound = rows.b + disturbance_margin(rows, known)
    if reserve is not None:
        bound = bound - reserve
    normals = rows.A * input_set.scale
    distance = bound - rows.A @ input_set.center
    if costs.soft:
        distance[costs.soft] = np.inf
    farthest = input_set.farthest(normals)
    # Sums, for what is not finite stays so in them.
    total = float(np.add.reduce(normals, axis=None) + np.add.reduce(bound))
    cut, is_finite = (distance < farthest).nonzero()[0], math.isfinite(total)
    given = input_set, rows, bound, known, costs
    return FeasibleSet(*given, normals, distance, farthest, cut, is_finite)


@dataclass(frozen=True)
class Frame:
    """The coordinates z of a QP, u = origin + scale * (inverse z).

    In them its cost is a distance.

    Attributes:
        origin, scale: The input set's, shape (m,).
        metric: R with R'R = S W S / cost_unit, S of the scale and W the weights; no
            singular value is below 1, shape (m, m). None for the identity.
        inverse: Its inverse.
        cost_unit: The divisor of the cost for that.
    """

    origin: Array
    scale: Array
    metric: Array | None = None
    inverse: Array | None = None
    cost_unit: float = 1.0

    @staticmethod
    def of(input_set: InputSet, weights: ArrayLike | None = None) -> Frame:
        """Returns the frame of an input set.

        Args:
            input_set: The input set.
            weights: W of the cost (u - u_ref)'W (u - u_ref), a matrix (m, m) or its
                diagonal (m,); by default that of the normalised inputs' norm.

        Raises:
            ValueError: W has another shape or is not positive definite.
        """
        origin, scale = input_set.origin, input_set.scale
        if weights is None or not np.size(weights):
            return Frame(origin, scale)
        m, W = input_set.num_inputs, np.array(weights, dtype=float)
        W = np.diag(W) if W.ndim == 1 else W
        is_matrix = W.shape == (m, m) and bool(np.isfinite(W).all())
        require(
            is_matrix
            and np.allclose(W, W.T, atol=1e-8 * np.abs(W).max(initial=0.0))
            and np.linalg.eigvalsh(W)[0] > 0.0,
            "input_weights",
            weights,
            f"{m} positive numbers or a positive definite ({m}, {m}) matrix",
        )
        # Inputs that are fixed have no part in it.
        W = scale[:, None] * W * scale
        W[scale == 0.0, scale == 0.0] = 1.0
        least = float(np.linalg.eigvalsh(W)[0])
        metric = np.linalg.cholesky(W / least).T
        return Frame(origin, scale, metric, np.linalg.inv(metric), least)

    def input(self, z: Array) -> Array:
        """Returns u of z, whose first entries are the inputs', shape (m,)."""
        z = z[: len(self.scale)]
        return self.origin + self.scale * (
            z if self.inverse is None else self.inverse @ z
        )


class QP(NamedTuple):
    """min 1/2 |z - reference|^2 subject to ``A z <= b``.

    The variables are the inputs in the coordinates of a frame, the growth of decay
    rates that may grow and, for each row that gives way at a penalty, sqrt(M) times its
    slack. The rows are the feasible set's that can matter, the volume row or the limits
    of decay rates, and those that give way.

    Attributes:
        frame: The coordinates.
        A: The rows, shape (n, d).
        b: Their right-hand sides, shape (n,).
        reference: Shape (d,).
        rows: What they are: indices of the feasible set's rows, or "volume".
        num_firm: The number of first rows, which limit the input in every state.
        num_hard: The number of first rows, which do not give way.
    """

    frame: Frame
    A: Array
    b: Array
    reference: Array
    rows: tuple[str | int, ...]
    num_firm: int
    num_hard: int

    @property
    def has_hard_volume(self) -> bool:
        """Whether the volume row is hard, and so the last of those."""
        return self.rows[self.num_hard - 1 : self.num_hard] == ("volume",)

    @property
    def is_met(self) -> bool:
        """Whether the reference satisfies every row, and none gives way."""
        m = len(self.frame.scale)
        return bool((self.A[:, :m] @ self.reference[:m] <= self.b).all())


def state_qp(
    feasible: FeasibleSet,
    frame: Frame,
    reference: Array,
    volume_row: VolumeRow | None = None,
    soft: Sequence[VolumeRow] = (),
) -> QP:
    """Returns the tick's QP.

    Args:
        feasible: Input limits and barrier rows.
        frame: The coordinates.
        reference: The controller's input, finite, shape (m,).
        volume_row: The volume barrier's row, finite; None where it has none.
        soft: The soft barrier rows; none for the hard rows alone.
    """
    inputs, cut = feasible.input_set, feasible.cut
    z = (inputs.near(reference) - frame.origin) / inputs.units
    limits, sides = inputs.limiting
    distance = feasible.bound[cut]
    if inputs.fixed:
        distance = distance - feasible.rows.A[cut] @ frame.origin
    rows, distances = [limits, feasible.normals[cut]], [sides, distance]
    further = [*([] if volume_row is None else [volume_row]), *soft]
    for row in further:
        rows.append((row.a * frame.scale)[None])
        distances.append(np.array([row.c - row.a @ frame.origin]))
    A, b = np.concatenate(rows), np.concatenate(distances)
    if frame.metric is not None:
        A, z = A @ frame.inverse, frame.metric @ z
    k, yielding = len(inputs.b), [r for r in further if r.slack_penalty < math.inf]
    names: list[str | int] = [*inputs.limits.tolist(), *[k + i for i in cut.tolist()]]
    names += [row.name for row in further]
    qp = QP(frame, A, b, z, tuple(names), len(sides), len(b) - len(yielding))
    return _with_slacks(qp, yielding) if yielding else qp


def _with_slacks(qp: QP, yielding: Sequence[VolumeRow]) -> QP:
    """Gives the last rows slacks delta <= 0 at M delta^2 - N delta (E54), (E71).

    In the variables (z, w = sqrt(M) delta) the cost is a distance again, from
    w = N / (2 sqrt(M)); where that is not 0, a row more keeps w from being positive.
    """
    frame, m, count = qp.frame, len(qp.reference), len(yielding)
    root = np.sqrt([row.slack_penalty / frame.cost_unit for row in yielding])
    linear = np.array([row.linear_penalty for row in yielding])
    away = linear / (2.0 * frame.cost_unit * root)
    slopes = np.concatenate([np.zeros((qp.num_hard, count)), np.diag(1.0 / root)])
    is_kept = linear > 0.0
    signs = np.hstack([np.zeros((count, m)), np.eye(count)])[is_kept]
    names = [row.name for row in yielding if row.linear_penalty > 0.0]
    return qp._replace(
        A=np.vstack([np.hstack([qp.A, slopes]), signs]),
        b=np.append(qp.b, np.zeros(len(signs))),
        reference=np.append(qp.reference, away),
        rows=(*qp.rows, *names),
    )
