"""The filter's QP, verified, and what happens at a tick when it has no solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
import math
from typing import Literal

import numpy as np
from numpy.linalg import LinAlgError

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.linear_program import minimise_linear
from vcbf_drake.safety.nearest_point import (
    FEASIBILITY_TOLERANCE,
    nearest_point,
    nearest_point_by_active_set,
    opened,
)
from vcbf_drake.safety.unit_length import of_unit_length

InfeasiblePolicy = Literal["stop", "least_violation", "hold"]

INFEASIBLE_POLICIES: tuple[InfeasiblePolicy, ...] = ("stop", "least_violation", "hold")

# A reference this many input ranges away is as good as one infinitely far.
_FARTHEST_REFERENCE = 1e6
# A minimal relaxation leaves a set without interior; rows opened by this distance, in
# normalised inputs, give the QP one. At narrow angles it takes more.
_OPENING = 1e-10
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
    """

    a: Array
    c: float
    slack_penalty: float

    @property
    def is_finite(self) -> bool:
        """Whether every number in it is finite."""
        return math.isfinite(self.c) and bool(np.isfinite(self.a).all())

    def normalised(self, input_set: InputSet) -> VolumeRow:
        """Returns the row in normalised inputs."""
        shifted = self.c - float(self.a @ input_set.center)
        return VolumeRow(self.a * input_set.scale, shifted, self.slack_penalty)


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
    """

    input: Array
    status: FilterStatus
    slack: float = 0.0
    conflict: tuple[int, ...] = ()
    row_margin: float = math.nan


def choose_input(
    feasible: FeasibleSet,
    volume_rows: Sequence[VolumeRow],
    reference: Array,
    held_input: Array,
    input_set: InputSet,
    exact_slack: bool,
    policy: InfeasiblePolicy,
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
    """
    if not (feasible.is_finite and np.isfinite(reference).all()):
        return FilterDecision(input_set.project(held_input), FilterStatus.FAILED)
    A, b = feasible.A_v[feasible.cutting], feasible.b_v[feasible.cutting]
    rows = [row.normalised(input_set) for row in volume_rows]
    # The others hold on the whole bounding box.
    rows = [row for row in rows if row.c < np.abs(row.a).sum()]
    if rows:
        A = np.concatenate([A, [row.a for row in rows]])
        b = np.concatenate([b, [row.c for row in rows]])
    v_reference = (reference - input_set.center) / input_set.scale
    if np.abs(v_reference).max() > _FARTHEST_REFERENCE:
        v_reference = v_reference.clip(-_FARTHEST_REFERENCE, _FARTHEST_REFERENCE)
    if (A @ v_reference <= b).all():
        return FilterDecision(reference, FilterStatus.REFERENCE)
    slack, status, firm = 0.0, FilterStatus.FILTERED, feasible.num_input_rows
    v = np.minimum(np.maximum(v_reference, -1.0), 1.0)
    # The nearest point of the bounding box is the nearest of all if the rows allow it.
    if not (A @ v <= b).all():
        try:
            if not rows:
                v = _hard(A, b, v_reference, firm)
            elif exact_slack:
                v, slack, status = _hard_first(A, b, len(rows), v_reference, firm)
            else:
                penalties = [row.slack_penalty for row in rows]
                v, slack, status = _with_penalty(A, b, penalties, v_reference, firm)
        except EmptySetError as error:
            # Of the feasible set's rows alone; a volume row that may give way has none.
            among = [i for i in error.conflict if i < len(feasible.cutting)]
            conflict = tuple(feasible.cutting[among].tolist())
            return _infeasible(
                feasible, v_reference, held_input, input_set, policy, conflict
            )
        except (SolverError, LinAlgError):
            return failed_decision(feasible, v_reference, held_input, input_set)
    u = input_set.project(input_set.center + input_set.scale * v)
    return FilterDecision(u, status, slack)


def _hard(A: Array, b: Array, reference: Array, firm: int) -> Array:
    return nearest_point(A, b, reference, firm).point


_Solution = tuple[Array, float, FilterStatus]


def _hard_first(
    A: Array, b: Array, count: int, reference: Array, firm: int
) -> _Solution:
    """The last rows as constraints; relaxed only where they leave nothing (E25).

    With several, each in its turn gives way by the least that those before it allow.
    """
    k = len(b) - count
    found = nearest_point_by_active_set(A, b, reference, firm)
    if found is not None:
        return found.point, 0.0, FilterStatus.FILTERED
    v = _hard(A[:k], b[:k], reference, firm)  # Or is it empty without them too?
    rows, bounds, _ = of_unit_length(A, b)
    may_open = np.concatenate([np.zeros(k), np.ones(count)])
    for i in range(k, len(b)):
        if rows[i].any():
            v = minimise_linear(rows[i], rows[:i], opened(rows, bounds, firm)[:i])
        bounds[i] = max(bounds[i], float(rows[i] @ v) + _OPENING)
    v = _opened(rows, bounds, may_open, reference, v, firm)
    if (rows[:k] @ v > bounds[:k] + FEASIBILITY_TOLERANCE).any():
        raise SolverError("no least slack that leaves the other rows alone", A, b)
    return _with_slack(A[k:], b[k:], v)


def _with_slack(A: Array, b: Array, v: Array) -> _Solution:
    slack = min(0.0, float((b - A @ v).min()))
    return v, slack, FilterStatus.RELAXED if slack < 0.0 else FilterStatus.FILTERED


def _opened(
    A: Array, b: Array, may_open: Array, reference: Array, v: Array, firm: int
) -> Array:
    """The nearest point of a set with next to no interior, near its point v.

    Args:
        A: The rows.
        b: Their right-hand sides, opened.
        may_open: 1 for rows that may be opened further, else 0.
        reference: The point to stay close to.
        v: What is returned where the QP fails and v leaves no row.
        firm: How many rows, the first, are never opened.
    """
    for opening in _WIDER:
        try:
            return _hard(A, b + opening * may_open, reference, firm)
        except (EmptySetError, SolverError, LinAlgError):
            if (A @ v <= b).all():
                break
    return v


def _with_penalty(
    A: Array, b: Array, penalties: Sequence[float], reference: Array, firm: int
) -> _Solution:
    """Each of the last rows with its free slack delta at the cost M delta^2 (E24).

    In the variables (v, sqrt(M) delta) the cost is a distance again.
    """
    k, root = len(penalties), np.sqrt(penalties)
    slopes = np.concatenate([np.zeros((len(b) - k, k)), np.diag(1.0 / root)])
    hard, all_A = len(b) - k, np.column_stack([A, slopes])
    try:
        solution = _hard(all_A, b, np.append(reference, np.zeros(k)), firm)
    except EmptySetError as error:
        # With free slacks it is empty only where the other rows are.
        _hard(A[:hard], b[:hard], reference, firm)
        raise SolverError("no solution with slacks", all_A, b) from error
    return _with_slack(A[hard:], b[hard:], solution[:-k])


def _infeasible(
    feasible: FeasibleSet,
    reference: Array,
    held_input: Array,
    input_set: InputSet,
    policy: InfeasiblePolicy,
    conflict: tuple[int, ...],
) -> FilterDecision:
    if policy == "hold":
        u = input_set.project(held_input)
    else:
        u = _least_violation(feasible, reference, held_input, input_set)
    return FilterDecision(u, FilterStatus.INFEASIBLE, 0.0, conflict)


def failed_decision(
    feasible: FeasibleSet, reference: Array, held_input: Array, input_set: InputSet
) -> FilterDecision:
    """Returns the fallback where no solver's answer was verified.

    Args:
        feasible: Input limits and barrier rows, all finite.
        reference: The controller's input, normalised, shape (m,).
        held_input: The input applied now, shape (m,).
        input_set: The inputs the actuators can produce.
    """
    u = _least_violation(feasible, reference, held_input, input_set)
    return FilterDecision(u, FilterStatus.FAILED)


def _least_violation(
    feasible: FeasibleSet, reference: Array, held_input: Array, input_set: InputSet
) -> Array:
    """The input within its limits whose worst weighted barrier violation is least.

    min t subject to weight_i (a_i u - b_i) <= t, t >= 0; among those inputs, the one
    nearest to the reference.
    """
    A, b = feasible.A_v[feasible.cutting], feasible.b_v[feasible.cutting]
    k = feasible.num_input_rows
    weight = feasible.weights[feasible.cutting[k:] - k]
    length = np.linalg.norm(A[k:], axis=1)
    # t is counted in units of the heaviest row's distance, and from where no input is
    # below it.
    weight /= float(np.max(weight * length, initial=0.0)) or 1.0
    A = np.concatenate([A[:k], A[k:] * weight[:, None]])
    b = np.concatenate([b[:k], b[k:] * weight])
    b[k:] += max(0.0, float(np.max(-b[k:] - np.abs(A[k:]).sum(axis=1), initial=0.0)))
    last = np.append(np.zeros(A.shape[1]), 1.0)
    give = np.concatenate([np.zeros(k), np.ones(len(weight))])
    rows = np.vstack([np.column_stack([A, -give]), -last])
    try:
        v = minimise_linear(last, rows, np.append(b, 0.0))[:-1]
    except (SolverError, LinAlgError):
        return input_set.project(held_input)
    b[k:] += np.max(A[k:] @ v - b[k:], initial=0.0) + _OPENING
    v = _opened(A, b, give, reference, v, k)
    return input_set.project(input_set.center + input_set.scale * v)
