"""The QP of a control tick: its coordinates, its rows and its MathematicalPrograms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.solvers import MathematicalProgram, MathematicalProgramResult

from vcbf_drake.checks import Array, require
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import UnitRows, minimise_linear, nearest_point
from vcbf_drake.safety.programs import EllipsoidProgram, NearestPointProgram

# The least slack or violation leaves a set without interior. Its rows are opened by
# this distance, relative to their sizes.
MARGIN = 1e-10


class VolumeRow(NamedTuple):
    """A condition a u <= c that may give way: the volume barrier's, or a soft one.

    Attributes:
        a: Shape (m,).
        c: The right-hand side.
        slack_penalty: M of (E54, the DOB-VCBF-QP), for the inexact slack.
        unit: The divisor of the row, which multiplies its slack.
        linear_penalty: N of (E71): the penalty of the slack itself, beside M times its
            square.
    """

    a: Array
    c: float
    slack_penalty: float
    unit: float = 1.0
    linear_penalty: float = 0.0

    @property
    def is_finite(self) -> bool:
        """Whether every number in it is finite."""
        return all(map(math.isfinite, (self.c, *self.a.tolist())))

    def slack(self, u: Array) -> float:
        """Returns the row's slack at an input, at most 0."""
        return self.unit * min(0.0, self.c - float(self.a @ u))


@dataclass(frozen=True)
class Frame:
    """The coordinates z of a QP, in which its cost is a distance.

    u = origin + scale * (inverse z): without weights of the cost, the inverse is the
    identity.

    Attributes:
        origin: The input set's, shape (m,).
        scale: The input set's, shape (m,).
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
        frame = Frame(input_set.origin, input_set.scale)
        if weights is None or not np.size(weights):
            return frame
        m, W = input_set.num_inputs, np.array(weights, dtype=float)
        W = np.diag(W) if W.ndim == 1 else W
        is_matrix = W.shape == (m, m) and bool(np.isfinite(W).all())
        require(
            is_matrix and np.allclose(W, W.T) and np.linalg.eigvalsh(W)[0] > 0.0,
            "input_weights",
            weights,
            f"{m} positive numbers or a positive definite ({m}, {m}) matrix",
        )
        # Inputs that are fixed have no part in it.
        W = input_set.scale[:, None] * W * input_set.scale
        W[input_set.scale == 0.0, input_set.scale == 0.0] = 1.0
        least = float(np.linalg.eigvalsh(W)[0])
        metric = np.linalg.cholesky(W / least).T
        return replace(
            frame, metric=metric, inverse=np.linalg.inv(metric), cost_unit=least
        )

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
        num_firm: The number of first rows, which limit the input in every state.
        cut: Which barrier rows follow those.
        num_hard: The number of first rows, which do not give way.
        has_hard_volume: Whether the last of those is the volume row.
        further_rows: The rows after the feasible set's: "volume", or an index there.
    """

    frame: Frame
    A: Array
    b: Array
    reference: Array
    num_firm: int
    cut: NDArray[np.intp]
    num_hard: int
    has_hard_volume: bool = False
    further_rows: tuple[str | int, ...] = ()

    @property
    def is_met(self) -> bool:
        """Whether the reference satisfies every row, and none gives way."""
        m = len(self.frame.scale)
        return bool((self.A[:, :m] @ self.reference[:m] <= self.b).all())

    def solved(self, solver: str) -> Array:
        """Returns the minimiser z, shape (d,).

        Raises:
            EmptySetError: No point satisfies the hard rows, certified.
        """
        return nearest_point(self.A, self.b, self.reference, self.num_firm, solver)

    def relaxed(self) -> QP:
        """Returns the QP whose hard volume row gives way by the least (E55).

        Raises:
            EmptySetError: No point satisfies the other hard rows, certified.
            SolverError: The least slack was not verified.
        """
        i, b = self.num_hard - 1, self.b.copy()
        row, others = self.A[i], self.A[:i]
        z = minimise_linear(row, others, b[:i], self.num_firm)
        volume = UnitRows(row[None], b[[i]])
        margin = MARGIN * float(volume.length[0] * volume.sizes(z)[0])
        b[i] = max(b[i], float(row @ z) + margin)
        return self._replace(b=b)


def state_qp(
    feasible: FeasibleSet,
    frame: Frame,
    reference: Array,
    volume_row: VolumeRow | None = None,
    exact_slack: bool = True,
    soft: Sequence[VolumeRow] = (),
) -> QP:
    """Returns the tick's QP.

    Args:
        feasible: Input limits and barrier rows.
        frame: The coordinates.
        reference: The controller's input, finite, shape (m,).
        volume_row: The volume barrier's row, finite; None where it has none.
        exact_slack: Whether the volume row is hard; else it gives way at its penalty.
        soft: The soft barrier rows: all of them, or none for the hard rows alone.
    """
    inputs, cut = feasible.input_set, feasible.cut
    z = (inputs.near(reference) - frame.origin) / inputs.units
    limits, sides = inputs.limiting
    distance = feasible.bound[cut]
    if inputs.fixed:
        distance = distance - feasible.rows.A[cut] @ frame.origin
    rows, distances = [limits, feasible.normals[cut]], [sides, distance]
    further = [*([] if volume_row is None else [volume_row]), *soft]
    names: list[str | int] = [] if volume_row is None else ["volume"]
    names += [feasible.num_input_rows + i for i in feasible.costs.soft[: len(soft)]]
    for row in further:
        rows.append((row.a * frame.scale)[None])
        distances.append(np.array([row.c - row.a @ frame.origin]))
    A, b = np.concatenate(rows), np.concatenate(distances)
    if frame.metric is not None:
        A, z = A @ frame.inverse, frame.metric @ z
    is_hard = exact_slack and volume_row is not None
    yielding = further[is_hard:]
    num_hard = len(b) - len(yielding)
    qp = QP(frame, A, b, z, len(sides), cut, num_hard, is_hard, tuple(names))
    return _with_slacks(qp, yielding) if yielding else qp


def soft_rows(feasible: FeasibleSet) -> list[VolumeRow]:
    """Returns the soft barrier rows of a feasible set."""
    costs, bound = feasible.costs, feasible.bound
    return [
        VolumeRow(
            feasible.rows.A[i],
            float(bound[i]),
            costs.penalties[i],
            linear_penalty=costs.linear_penalties[i],
        )
        for i in costs.soft
    ]


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
    names = np.array(qp.further_rows, dtype=object)[-count:][is_kept]
    return qp._replace(
        A=np.vstack([np.hstack([qp.A, slopes]), signs]),
        b=np.append(qp.b, np.zeros(len(signs))),
        reference=np.append(qp.reference, away),
        further_rows=(*qp.further_rows, *names),
    )


@dataclass(frozen=True)
class TickPrograms:
    """The QP and the cone program of one control tick, as MathematicalPrograms.

    Both are stated anew, with rows of unit length as the filter's solver was given
    them; nobody else holds them.

    Attributes:
        qp: min 1/2 |z - reference|^2 subject to ``A z <= b``: see `QP`.
        qp_rows: The meaning of each of its rows.
        ellipsoid: max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i (E48), the set's
            largest ellipsoid {L w + d : |w| <= 1} in normalised inputs; None for a
            single input, whose largest interval needs no program.
        ellipsoid_rows: The meaning of each of its rows.
        solved: The QP that it states.
    """

    qp: MathematicalProgram
    qp_rows: tuple[str, ...]
    ellipsoid: MathematicalProgram | None
    ellipsoid_rows: tuple[str, ...]
    solved: QP

    @staticmethod
    def of(
        qp: QP, feasible: FeasibleSet, names: Sequence[str], widening: float
    ) -> TickPrograms:
        """States the programs of a tick.

        Args:
            qp: The QP that was solved.
            feasible: The feasible set whose ellipsoid was found.
            names: The names of the feasible set's rows.
            widening: kappa of the volume barrier.
        """
        rows, nearest = UnitRows(qp.A, qp.b), NearestPointProgram(*qp.A.shape)
        nearest.state(rows.A, rows.b, qp.reference)
        inputs, (cut, A, b) = feasible.input_set, feasible.cut_by(widening)
        first, k, cone = inputs.limits, feasible.num_input_rows, None
        limits, sides = inputs.A_normalised[first], inputs.b_normalised[first]
        rows = UnitRows(np.concatenate([limits, A]), np.concatenate([sides, b]))
        if inputs.num_inputs > 1:
            largest = EllipsoidProgram(len(rows.b), inputs.num_inputs, 1e-9)
            largest.state(rows.A, rows.b)
            cone = largest.program
        qp_rows = (*first.tolist(), *(k + qp.cut).tolist(), *qp.further_rows)
        return TickPrograms(
            nearest.program,
            tuple(row if isinstance(row, str) else names[row] for row in qp_rows),
            cone,
            tuple(names[i] for i in (*first.tolist(), *(k + cut).tolist())),
            qp,
        )

    def input(self, result: MathematicalProgramResult) -> Array:
        """Returns the input u of a solution of the QP, shape (m,)."""
        return self.solved.frame.input(result.get_x_val())

    def log_det(self, result: MathematicalProgramResult) -> float:
        """Returns log det B of a solution of the cone program, in normalised inputs."""
        row, column = np.tril_indices(len(self.solved.frame.scale))
        diagonal = result.get_x_val()[: len(row)][row == column]
        return float(np.log(diagonal).sum())
