"""The filter's QP, and what happens at a tick when it has no solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
import math
from typing import Literal

import numpy as np
from numpy.linalg import LinAlgError

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import FEASIBILITY_TOLERANCE, UnitRows
from vcbf_drake.safety.programs import DEFAULT_SOLVER
from vcbf_drake.safety.projection import (
    SHORTEST,
    minimise_linear,
    nearest_point,
    opening,
)

InfeasiblePolicy = Literal["stop", "least_violation", "hold"]

INFEASIBLE_POLICIES: tuple[InfeasiblePolicy, ...] = ("stop", "least_violation", "hold")

# A reference this many input ranges away is as good as one infinitely far.
_FARTHEST_REFERENCE = 1e6
# The least slack or violation leaves a set without interior. Its rows are opened by
# this distance, in normalised inputs; at narrow angles it takes more.
_MARGIN = 1e-10
_WIDER = (0.0, 1e-8, 1e-7, 1e-6)


class FilterStatus(IntEnum):
    """What the filter did at a tick."""

    REFERENCE = 0
    """The reference satisfied every row and passed through untouched."""
    FILTERED = 1
    """The nearest input that satisfies every row."""
    RELAXED = 2
    """No input satisfies the volume row too; it gave way by the least slack."""
    INFEASIBLE = 3
    """No input satisfies the barrier rows, by certificate; the policy chose."""
    FAILED = 4
    """Data were not finite or no solver's answer was verified; the fallback acts."""


@dataclass(frozen=True)
class VolumeRow:
    """The volume barrier's condition a u <= c.

    Attributes:
        a: Shape (m,).
        c: The right-hand side.
        slack_penalty: M of (E24), for the inexact slack.
        name: For whoever reads the program.
    """

    a: Array
    c: float
    slack_penalty: float
    name: str = "volume"

    @property
    def is_finite(self) -> bool:
        """Whether every number in it is finite."""
        return math.isfinite(self.c) and bool(np.isfinite(self.a).all())

    def normalised(self, input_set: InputSet) -> VolumeRow:
        """Returns the row in normalised inputs."""
        shifted = self.c - float(self.a @ input_set.center)
        return replace(self, a=self.a * input_set.scale, c=shifted)


@dataclass(frozen=True)
class QP:
    """min 1/2 |z - reference|^2 subject to ``A z <= b``.

    The variables are the normalised inputs v and, for each row that gives way at a
    penalty, sqrt(M) times its slack. The rows are the feasible set's that can matter,
    the volume rows, and those that give way.

    Attributes:
        A: The rows, shape (n, d).
        b: Their right-hand sides, shape (n,).
        reference: Shape (d,).
        num_inputs: m, the first variables.
        num_firm: How many rows, the first, limit the input whatever the state.
        num_hard: How many rows, the first, do not give way.
        num_volume: How many of those, the last, are volume rows.
        rows: Which of the feasible set's rows are the first.
        further_rows: The names of those that follow.
    """

    A: Array
    b: Array
    reference: Array
    num_inputs: int
    num_firm: int
    num_hard: int
    num_volume: int
    rows: tuple[int, ...] = ()
    further_rows: tuple[str, ...] = ()

    def solved(self, solver: str) -> Array:
        """Returns the minimiser z, shape (d,).

        Raises:
            EmptySetError: No point satisfies the hard rows, certified.
            SolverError: No solver's answer was verified.
        """
        try:
            found = nearest_point(self.A, self.b, self.reference, self.num_firm, solver)
        except EmptySetError as error:
            if self.num_hard == len(self.b):
                raise
            # With free slacks it is empty only where the hard rows are.
            A, b, m = self.A, self.b, self.num_inputs
            hard, free = A[: self.num_hard, :m], self.reference[:m]
            nearest_point(hard, b[: self.num_hard], free, self.num_firm, solver)
            raise SolverError("no solution with slacks", A, b) from error
        return found.point


@dataclass(frozen=True)
class FilterDecision:
    """The input that leaves the filter, finite and inside the input set.

    Attributes:
        input: Shape (m,).
        status: How it was found.
        slack: delta of (E24): how far the volume row gave way, 0 when it did not; of
            several rows, the one that gave way most.
        conflict: When infeasible, rows of the feasible set that exclude each other.
        row_margin: What every barrier row's chi is at least until the next tick (E77);
            nan where no such input was sought.
        qp: The QP whose solution the input is, where it is one.
    """

    input: Array
    status: FilterStatus
    slack: float = 0.0
    conflict: tuple[int, ...] = ()
    row_margin: float = math.nan
    qp: QP | None = field(default=None, compare=False, repr=False)


def choose_input(
    feasible: FeasibleSet,
    volume_rows: Sequence[VolumeRow],
    reference: Array,
    held_input: Array,
    input_set: InputSet,
    exact_slack: bool,
    policy: InfeasiblePolicy,
    solver: str = DEFAULT_SOLVER,
) -> FilterDecision:
    """Returns the feasible input nearest to the reference, (E19) or (E24), (E25).

    With the exact slack volume rows are hard and give way, by as little as possible,
    only when no input satisfies them together with the other rows; without, they have
    the printed penalty M delta^2.

    Args:
        feasible: Input limits and barrier rows.
        volume_rows: The volume barrier's rows, finite, the one that gives way last
            first.
        reference: The controller's input, shape (m,).
        held_input: The input applied now, shape (m,); for the fallbacks.
        input_set: The inputs the actuators can produce.
        exact_slack: How the volume rows may give way.
        policy: What to apply when the barrier rows have no solution.
        solver: The name of the solver that proposes, one of `SOLVERS`.
    """
    if not (feasible.is_finite and np.isfinite(reference).all()):
        return FilterDecision(input_set.project(held_input), FilterStatus.FAILED)
    rows = [row.normalised(input_set) for row in volume_rows]
    # The others hold on the whole bounding box.
    rows = [row for row in rows if row.c < np.abs(row.a).sum()]
    qp = _stated(feasible, rows, _normalised(reference, input_set), exact_slack)
    if (qp.A @ qp.reference <= qp.b).all():
        return FilterDecision(reference, FilterStatus.REFERENCE, qp=qp)
    try:
        z, solved = _solution(qp, solver)
    except EmptySetError as error:
        # Of the feasible set's rows alone; a volume row that may give way has none.
        among = [i for i in error.conflict if i < len(feasible.cutting)]
        conflict = tuple(feasible.cutting[among].tolist())
        if policy == "hold":
            u = input_set.project(held_input)
        else:
            u = _least_violation(feasible, qp.reference, held_input, input_set, solver)
        return FilterDecision(u, FilterStatus.INFEASIBLE, conflict=conflict)
    except (SolverError, LinAlgError):
        return failed_decision(feasible, qp.reference, held_input, input_set, solver)
    v, slack = z[: qp.num_inputs], 0.0
    if solved is not qp or not exact_slack:
        slack = min([0.0, *(row.c - float(row.a @ v) for row in rows)])
    status = FilterStatus.RELAXED if slack < 0.0 else FilterStatus.FILTERED
    u = input_set.project(input_set.center + input_set.scale * v)
    return FilterDecision(u, status, slack, qp=solved)


def _normalised(reference: Array, input_set: InputSet) -> Array:
    v: Array = (reference - input_set.center) / input_set.scale
    if np.abs(v).max() > _FARTHEST_REFERENCE:
        v = v.clip(-_FARTHEST_REFERENCE, _FARTHEST_REFERENCE)
    return v


def _stated(
    feasible: FeasibleSet,
    volume_rows: Sequence[VolumeRow],
    reference: Array,
    exact_slack: bool,
) -> QP:
    """The tick's QP, all in normalised inputs."""
    A, b = feasible.A_v[feasible.cutting], feasible.b_v[feasible.cutting]
    m, count = len(reference), len(volume_rows)
    if volume_rows:
        A = np.concatenate([A, [row.a for row in volume_rows]])
        b = np.concatenate([b, [row.c for row in volume_rows]])
    num_firm = feasible.num_input_rows
    rows, names = tuple(feasible.cutting.tolist()), tuple(r.name for r in volume_rows)
    if exact_slack or not volume_rows:
        return QP(A, b, reference, m, num_firm, len(b), count, rows, names)
    # Each with its free slack delta at the cost M delta^2 (E24): in the variables
    # (v, sqrt(M) delta) the cost is a distance again.
    root = np.sqrt([row.slack_penalty for row in volume_rows])
    num_hard = len(b) - count
    slopes = np.concatenate([np.zeros((num_hard, count)), np.diag(1.0 / root)])
    A, reference = np.hstack([A, slopes]), np.append(reference, np.zeros(count))
    return QP(A, b, reference, m, num_firm, num_hard, 0, rows, names)


def _solution(qp: QP, solver: str) -> tuple[Array, QP]:
    """A QP's minimiser; where its volume rows leave none, that of one where they do.

    With several volume rows, each in its turn gives way by the least that those before
    it allow (E25).
    """
    try:
        return qp.solved(solver), qp
    except (EmptySetError, SolverError, LinAlgError):
        if not qp.num_volume:
            raise
    first = qp.num_hard - qp.num_volume
    firmer = replace(qp, A=qp.A[:first], b=qp.b[:first], num_hard=first, num_volume=0)
    rows = UnitRows(qp.A, qp.b, SHORTEST)
    bounds, opened = qp.b.copy(), rows.length * opening(rows, qp.num_firm)
    for i in range(first, qp.num_hard):
        z = minimise_linear(qp.A[i], qp.A[:i], bounds[:i] + opened[:i])
        margin = 0.0 if rows.is_blank[i] else _MARGIN * rows.length[i]
        bounds[i] = max(bounds[i], float(qp.A[i] @ z) + margin)
    may_open = rows.length * (np.arange(len(bounds)) >= first)
    z, relaxed = _opened(replace(qp, b=bounds), may_open, z, solver)
    excess = (qp.A[:first] @ z - bounds[:first]) / rows.length[:first]
    if (excess > FEASIBILITY_TOLERANCE).any():
        firmer.solved(solver)  # Or is it empty without the volume rows too?
        raise SolverError("no least slack that leaves the other rows alone", qp.A, qp.b)
    return z, relaxed


def _opened(qp: QP, may_open: Array, z: Array, solver: str) -> tuple[Array, QP]:
    """The minimiser of a QP with next to no interior, near its feasible point z.

    Args:
        qp: Its rows opened already.
        may_open: How far a row may be opened, in units of `_WIDER`, shape (n,).
        z: What is returned where the QP fails and z leaves no row.
        solver: The solver's name.
    """
    for wider in _WIDER:
        attempt = replace(qp, b=qp.b + wider * may_open)
        try:
            return attempt.solved(solver), attempt
        except (EmptySetError, SolverError, LinAlgError):
            if (qp.A @ z <= qp.b).all():
                break
    return z, qp


def failed_decision(
    feasible: FeasibleSet,
    reference: Array,
    held_input: Array,
    input_set: InputSet,
    solver: str = DEFAULT_SOLVER,
) -> FilterDecision:
    """Returns the fallback where no solver's answer was verified.

    Args:
        feasible: Input limits and barrier rows, all finite.
        reference: The controller's input, normalised, shape (m,).
        held_input: The input applied now, shape (m,).
        input_set: The inputs the actuators can produce.
        solver: The solver's name.
    """
    u = _least_violation(feasible, reference, held_input, input_set, solver)
    return FilterDecision(u, FilterStatus.FAILED)


def _least_violation(
    feasible: FeasibleSet,
    reference: Array,
    held_input: Array,
    input_set: InputSet,
    solver: str,
) -> Array:
    """The input within its limits whose worst weighted barrier violation is least.

    min t subject to weight_i (a_i u - b_i) <= t, t >= 0; among those inputs, the one
    nearest to the reference.
    """
    A, b = feasible.A_v[feasible.cutting], feasible.b_v[feasible.cutting]
    k, m = feasible.num_input_rows, input_set.num_inputs
    weight = feasible.weights[feasible.cutting[k:] - k]
    length = np.linalg.norm(A[k:], axis=1)
    # t is counted in units of the heaviest row's distance, and from where no input is
    # below it.
    weight /= float(np.max(weight * length, initial=0.0)) or 1.0
    A = np.concatenate([A[:k], A[k:] * weight[:, None]])
    b = np.concatenate([b[:k], b[k:] * weight])
    b[k:] += max(0.0, float(np.max(-b[k:] - np.abs(A[k:]).sum(axis=1), initial=0.0)))
    last = np.append(np.zeros(m), 1.0)
    give = np.concatenate([np.zeros(k), np.ones(len(weight))])
    rows = np.vstack([np.column_stack([A, -give]), -last])
    try:
        v = minimise_linear(last, rows, np.append(b, 0.0))[:-1]
    except (EmptySetError, SolverError, LinAlgError):
        return input_set.project(held_input)
    b[k:] += np.max(A[k:] @ v - b[k:], initial=0.0) + _MARGIN
    nearest = QP(A, b, reference[:m], m, k, len(b), 0)
    v, _ = _opened(nearest, give, v, solver)
    return input_set.project(input_set.center + input_set.scale * v)
