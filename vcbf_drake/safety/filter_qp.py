"""The filter's QP, verified, and what happens at a tick when it has no solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.linalg import LinAlgError

from vcbf_drake.errors import Array, EmptySetError, SolverError
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.linear_program import minimise_linear
from vcbf_drake.safety.nearest_point import nearest_point, nearest_point_by_active_set

InfeasiblePolicy = Literal["stop", "least_violation", "hold"]

INFEASIBLE_POLICIES: tuple[InfeasiblePolicy, ...] = ("stop", "least_violation", "hold")

# A reference this many input ranges away is as good as one infinitely far.
_FARTHEST_REFERENCE = 1e6
# A minimal relaxation leaves a set without interior; this opens it for the QP.
_OPENING = 1e-9


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
    """

    input: Array
    status: FilterStatus
    slack: float = 0.0
    conflict: tuple[int, ...] = ()


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
        volume_rows: The volume barrier's rows, the one that gives way last first.
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
    slack, status = 0.0, FilterStatus.FILTERED
    v = np.minimum(np.maximum(v_reference, -1.0), 1.0)
    # The nearest point of the bounding box is the nearest of all if the rows allow it.
    if not (A @ v <= b).all():
        try:
            if not rows:
                v = _hard(A, b, v_reference)
            elif exact_slack:
                v, slack, status = _hard_first(A, b, len(rows), v_reference)
            else:
                penalties = [row.slack_penalty for row in rows]
                v, slack, status = _with_penalty(A, b, penalties, v_reference)
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


def _hard(A: Array, b: Array, reference: Array) -> Array:
    return nearest_point(A, b, reference).point


_Solution = tuple[Array, float, FilterStatus]


def _hard_first(A: Array, b: Array, count: int, reference: Array) -> _Solution:
    """The last rows as constraints; relaxed only where they leave nothing (E25).

    With several, each in its turn gives way by the least that those before it allow.
    """
    k = len(b) - count
    found = nearest_point_by_active_set(A, b, reference)
    if found is not None:
        return found.point, 0.0, FilterStatus.FILTERED
    v, relaxed = _hard(A[:k], b[:k], reference), b.copy()  # Empty without them too?
    for i in range(k, len(b)):
        if A[i].any():
            v = minimise_linear(A[i], A[:i], relaxed[:i])
        relaxed[i] = max(b[i], float(A[i] @ v) + _OPENING * (1.0 + abs(b[i])))
    try:
        v = _hard(A, relaxed, reference)
    except (EmptySetError, SolverError):
        pass  # The last linear program's own minimiser is a solution too.
    slack = min(0.0, float((b[k:] - A[k:] @ v).min()))
    return v, slack, FilterStatus.RELAXED if slack < 0.0 else FilterStatus.FILTERED


def _with_penalty(
    A: Array, b: Array, penalties: Sequence[float], reference: Array
) -> _Solution:
    """Each of the last rows with its free slack delta at the cost M delta^2 (E24).

    In the variables (v, sqrt(M) delta) the cost is a distance again.
    """
    k, root = len(penalties), np.sqrt(penalties)
    slopes = np.concatenate([np.zeros((len(b) - k, k)), np.diag(1.0 / root)])
    solution = _hard(np.column_stack([A, slopes]), b, np.append(reference, np.zeros(k)))
    v, slacks = solution[:-k], solution[-k:] / root
    slack = float(slacks.min())
    status = FilterStatus.RELAXED if slack < 0.0 else FilterStatus.FILTERED
    return v, slack, status


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

    min t subject to weight_i (a_i u - b_i) <= t; among those inputs, the one nearest
    to the reference.
    """
    A, b = feasible.A_v[feasible.cutting], feasible.b_v[feasible.cutting]
    give = np.zeros(len(feasible.b_v))
    give[feasible.num_input_rows :] = 1.0 / feasible.weights
    give = give[feasible.cutting]
    with_violation = np.column_stack([A, -give])
    no_reward = np.append(np.zeros(A.shape[1]), -1.0)  # violation >= 0
    cost = np.append(np.zeros(A.shape[1]), 1.0)
    try:
        solution = minimise_linear(
            cost, np.vstack([with_violation, no_reward]), np.append(b, 0.0)
        )
        v, violation = solution[:-1], solution[-1]
        relaxed = b + give * (violation + _OPENING * (1.0 + violation))
        v = _hard(A, relaxed, reference)
    except EmptySetError:
        pass  # The linear program's own minimiser is a solution too.
    except (SolverError, LinAlgError):
        return input_set.project(held_input)
    return input_set.project(input_set.center + input_set.scale * v)
