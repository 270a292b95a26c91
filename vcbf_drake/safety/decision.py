"""The decision of a control tick: the filter's QP, or the policy without a solution."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
import math
from typing import Literal, NamedTuple, Protocol, get_args

import numpy as np
from numpy.linalg import LinAlgError

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.decay import DecayRates
from vcbf_drake.safety.feasible_set import (
    DisturbanceKnowledge,
    FeasibleSet,
    disturbance_margin,
)
from vcbf_drake.safety.polytope import UnitRows, minimise_linear
from vcbf_drake.safety.programs import DEFAULT_SOLVER
from vcbf_drake.safety.qp import MARGIN, QP, Frame, VolumeRow, soft_rows, state_qp

InfeasiblePolicy = Literal["stop", "least_violation", "hold", "decay", "backup"]

INFEASIBLE_POLICIES: tuple[InfeasiblePolicy, ...] = get_args(InfeasiblePolicy)


class FilterStatus(IntEnum):
    """The filter's status at a tick."""

    REFERENCE = 0
    """The reference satisfied every row and passed through untouched."""
    FILTERED = 1
    """The nearest input that satisfies every row."""
    RELAXED = 2
    """No input satisfies the volume row too; it gave way by the least slack."""
    INFEASIBLE = 3
    """No input satisfies the barrier rows, by certificate; the policy chose. With
    decay rates that are variables these are taken at their largest."""
    FAILED = 4
    """Data were not finite or no solver's answer was verified; the fallback acts."""


class FilterDecision(NamedTuple):
    """The input that leaves the filter, finite and inside the input set.

    Attributes:
        input: Shape (m,).
        status: The status of the tick.
        slack: delta of (E54): the relaxation of the volume row, 0 without one.
        conflict: When infeasible, rows of the feasible set that exclude each other.
        row_margin: A lower bound of every barrier row's chi until the next tick (E88);
            nan where no such input was sought.
        soft_slacks: The relaxation of each soft barrier row, at most 0, where the input
            is a QP's solution.
        decay: The largest factor omega on a barrier's last decay rate (E69), 1 where
            the rows hold at their own rates.
        backup: The share of a backup manoeuvre in the input, from 0 to 1.
        is_certified: Whether a certified plan follows on it (Theorem 5); None where
            none was sought.
        qp: The QP whose solution the input is, where it is one.
    """

    input: Array
    status: FilterStatus
    slack: float = 0.0
    conflict: tuple[int, ...] = ()
    row_margin: float = math.nan
    soft_slacks: tuple[float, ...] = ()
    decay: float = 1.0
    backup: float = 0.0
    is_certified: bool | None = None
    qp: QP | None = None


class Tick(NamedTuple):
    """The data of one tick.

    Attributes:
        rows: The barrier rows.
        state: Shape (n,).
        time: The time of the tick [s].
        known: The knowledge of the disturbance until the next tick.
        obstacles: The perceived obstacles, shape (obstacles_size,).
    """

    rows: BarrierRows
    state: Array
    time: float
    known: DisturbanceKnowledge
    obstacles: Array | None = None

    def chi(self, u: Array) -> Array:
        """Returns b + Lambda - A u at an input, shape (N,)."""
        margin = disturbance_margin(self.rows, self.known)
        chi: Array = self.rows.b + margin - self.rows.A @ u
        return chi


class RowHolder(Protocol):
    """Finds inputs under which the rows hold until the next tick.

    `vcbf_drake.between_ticks.HeldRows` is one.
    """

    def can_enclose(self, state: Array, u: Array) -> bool:
        """Returns whether the motion from a state under an input can be enclosed."""

    def lasting_decision(
        self,
        tick: Tick,
        decision: FilterDecision,
        choose: Callable[[Array], FilterDecision],
    ) -> FilterDecision:
        """Returns a decision under which the rows last, where there is one.

        Args:
            tick: The tick of the decision.
            decision: The decision for the tick alone.
            choose: Returns the decision under margins, shape (N,).
        """


class Gate(Protocol):
    """Lets inputs pass that a certified plan follows on.

    `vcbf_drake.between_ticks.BackupGate` is one.
    """

    def decide(self, tick: Tick, decision: FilterDecision) -> FilterDecision:
        """Returns the method's decision, or one with a certified plan."""


def choose_input(
    feasible: FeasibleSet,
    volume_row: VolumeRow | None,
    reference: Array,
    held_input: Array,
    exact_slack: bool,
    policy: InfeasiblePolicy,
    solver: str = DEFAULT_SOLVER,
    frame: Frame | None = None,
    decay_rates: DecayRates | None = None,
) -> FilterDecision:
    """Returns the feasible input nearest to the reference, (E47) or (E54), (E55).

    With the exact slack the volume row is hard and gives way, by as little as possible,
    only when no input satisfies it together with the other rows; without, it has the
    printed penalty M delta^2. Soft barrier rows always have theirs (E71).

    Args:
        feasible: Input limits and barrier rows.
        volume_row: The volume barrier's row, finite; None where it has none.
        reference: The controller's input, shape (m,).
        held_input: The input applied now, shape (m,); for the fallbacks.
        exact_slack: Whether the volume row is hard with the least slack.
        policy: The policy when the barrier rows have no solution.
        solver: The name of the solver that proposes, one of `SOLVERS`.
        frame: The coordinates of the normalised inputs, with the cost's weights; by
            default `Frame.of(feasible.input_set)`.
        decay_rates: The decay rates that may grow, at every tick or only where the rows
            have no input (the policy ``decay``); None for fixed rates. At every tick
            there is no volume row.
    """
    inputs = feasible.input_set
    frame = frame or Frame.of(inputs)
    if not (feasible.is_finite and np.isfinite(reference).all()):
        u = least_violation(feasible, frame, reference, held_input, solver)
        return FilterDecision(u, FilterStatus.FAILED)
    soft = soft_rows(feasible)
    qp = state_qp(feasible, frame, reference, volume_row, exact_slack, soft)
    growing = decay_rates
    if growing is not None and growing.only_where_empty:
        growing = None
    if growing is not None:
        qp = growing.grown(qp, feasible)
    is_possible = all(reference[j] == inputs.center[j] for j in inputs.fixed)
    if qp.is_met and is_possible:
        return FilterDecision(reference, FilterStatus.REFERENCE, qp=qp)
    try:
        point, solved = _solved(qp, solver)
    except EmptySetError as error:
        # Rows of the feasible set all: those that may give way are in no conflict, and
        # those that limit decay rates say nothing beside the rows that these belong to.
        kept = feasible.cutting
        conflict = tuple(kept[[i for i in error.conflict if i < len(kept)]].tolist())
        u, decay = _fallback(
            feasible, frame, policy, decay_rates, reference, held_input, solver
        )
        status = FilterStatus.INFEASIBLE
        return FilterDecision(u, status, conflict=conflict, decay=decay)
    except (SolverError, LinAlgError):
        u = least_violation(feasible, frame, reference, held_input, solver)
        return FilterDecision(u, FilterStatus.FAILED)
    u, gave_way = frame.input(point), solved is not qp or not exact_slack
    slack = volume_row.slack(u) if volume_row and gave_way else 0.0
    status = FilterStatus.RELAXED if slack < 0.0 else FilterStatus.FILTERED
    soft_slacks = tuple([row.slack(u) for row in soft])
    u = inputs.project(u)
    decay = 1.0 if growing is None else growing.factor(feasible, u)
    return FilterDecision(
        u, status, slack, soft_slacks=soft_slacks, decay=decay, qp=solved
    )


def _solved(qp: QP, solver: str) -> tuple[Array, QP]:
    """A QP's minimiser; a hard volume row that leaves none is relaxed.

    Raises:
        EmptySetError: No input satisfies the rows that never give way, certified.
        SolverError: The least slack was not verified.
    """
    try:
        return qp.solved(solver), qp
    except EmptySetError as error:
        if not (qp.has_hard_volume and qp.num_hard - 1 in error.conflict):
            raise
    relaxed = qp.relaxed()
    try:
        return relaxed.solved(solver), relaxed
    except EmptySetError as error:
        raise SolverError("no least slack was verified", qp.A, qp.b) from error


def _fallback(
    feasible: FeasibleSet,
    frame: Frame,
    policy: InfeasiblePolicy,
    rates: DecayRates | None,
    reference: Array,
    held_input: Array,
    solver: str,
) -> tuple[Array, float]:
    """The policy's input where the rows have none, and its factor omega (E69)."""
    project = feasible.input_set.project
    if policy == "hold":
        return project(held_input), 1.0
    if policy == "decay" and rates is not None:
        hard = state_qp(feasible, frame, reference)
        try:
            z = rates.grown(hard, feasible).solved(solver)
        except (EmptySetError, SolverError, LinAlgError):
            pass  # No rate helps.
        else:
            u = project(frame.input(z))
            return u, rates.factor(feasible, u)
    return least_violation(feasible, frame, reference, held_input, solver), 1.0


def least_violation(
    feasible: FeasibleSet,
    frame: Frame,
    reference: Array,
    held_input: Array,
    solver: str = DEFAULT_SOLVER,
) -> Array:
    """Returns the input whose worst weighted barrier violation is least, shape (m,).

    Among those, the one nearest to the reference; the held input, or the one nearest to
    it that is allowed, where data are not finite or none was verified. The arguments
    are those of `choose_input`.
    """
    u = held_input
    if feasible.is_finite and np.isfinite(reference).all():
        qp = state_qp(feasible, frame, reference)
        with suppress(EmptySetError, SolverError, LinAlgError):
            u = frame.input(_least_violation(feasible, qp, solver))
    return feasible.input_set.project(u)


def _least_violation(feasible: FeasibleSet, qp: QP, solver: str) -> Array:
    """Min t subject to weight_i (a_i u - b_i) <= t, t >= 0, and then the nearest z."""
    A, b, k, m = qp.A.copy(), qp.b.copy(), qp.num_firm, len(qp.frame.scale)
    cut, weight = feasible.cut, feasible.costs.weights[feasible.cut]
    # t is counted in units of the heaviest row's distance, and from where no input is
    # below it.
    heaviest = float(np.max(weight * UnitRows(A[k:], b[k:]).length, initial=0.0))
    weight /= heaviest or 1.0
    least = -weight * (feasible.distance[cut] + feasible.farthest[cut])
    A[k:] *= weight[:, None]
    b[k:] = b[k:] * weight + np.max(least, initial=0.0)
    last = np.append(np.zeros(m), 1.0)
    give = np.concatenate([np.zeros(k), np.ones(len(weight))])
    rows = np.vstack([np.column_stack([A, -give]), -last])
    z = minimise_linear(last, rows, np.append(b, 0.0))[:-1]
    margin = MARGIN * UnitRows(A[k:], b[k:]).sizes(z)
    b[k:] += np.max(A[k:] @ z - b[k:], initial=0.0) + margin
    return qp._replace(A=A, b=b).solved(solver)
