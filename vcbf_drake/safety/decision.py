"""The decision of a control tick: the filter's QP, or the policy without a solution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
import math
from typing import Literal, NamedTuple, Protocol

import numpy as np
from pydrake.solvers import MathematicalProgram, MathematicalProgramResult

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.decay import DecayRates
from vcbf_drake.safety.polytope import minimise_linear
from vcbf_drake.safety.programs import (
    DEFAULT_SOLVER,
    EllipsoidProgram,
    NearestPointProgram,
)
from vcbf_drake.safety.projection import UnitRows, nearest_point
from vcbf_drake.safety.qp import (
    QP,
    DisturbanceKnowledge,
    FeasibleSet,
    Frame,
    VolumeRow,
    disturbance_margin,
    state_qp,
)

InfeasiblePolicy = Literal["stop", "least_violation", "hold", "decay", "backup"]

# The least slack or violation leaves a set without interior. Its rows are opened by
# this distance, relative to their sizes.
_MARGIN = 1e-10


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


@dataclass(frozen=True)
class TickPrograms:
    """The QP and the cone program of one control tick, as MathematicalPrograms.

    Both are stated anew, with rows of unit length as the filter's solver had them.

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
        """States the QP that was solved and the widened set's ellipsoid (E64).

        Args:
            qp: The QP.
            feasible: The feasible set.
            names: The names of its rows.
            widening: kappa of the volume barrier.
        """
        rows, nearest = UnitRows(qp.A, qp.b), NearestPointProgram(*qp.A.shape)
        nearest.state(rows.A, rows.b, qp.reference)
        of_qp = tuple(names[i] if isinstance(i, int) else i for i in qp.rows)
        inputs, (cut, A, b) = feasible.input_set, feasible.cut_by(widening)
        first, cone = inputs.limits, None
        limits, sides = inputs.A_normalised[first], inputs.b_normalised[first]
        rows = UnitRows(np.concatenate([limits, A]), np.concatenate([sides, b]))
        of_cone = tuple(names[i] for i in [*first, *(feasible.num_input_rows + cut)])
        if inputs.num_inputs > 1:
            largest = EllipsoidProgram(len(rows.b), inputs.num_inputs, 1e-9)
            largest.state(rows.A, rows.b)
            cone = largest.program
        return TickPrograms(nearest.program, of_qp, cone, of_cone, qp)

    def input(self, result: MathematicalProgramResult) -> Array:
        """Returns the input u of a solution of the QP, shape (m,)."""
        return self.solved.frame.input(result.get_x_val())

    def log_det(self, result: MathematicalProgramResult) -> float:
        """Returns log det B of a solution of the cone program, in normalised inputs."""
        row, column = np.tril_indices(len(self.solved.frame.scale))
        diagonal = result.get_x_val()[: len(row)][row == column]
        return float(np.log(diagonal).sum())


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
    """Finds inputs under which the rows last until the next tick, as `HeldRows`."""

    def can_enclose(self, state: Array, u: Array) -> bool:
        """Returns whether the motion from a state under an input can be enclosed."""

    def lasting_decision(
        self,
        tick: Tick,
        decision: FilterDecision,
        choose: Callable[[Array], FilterDecision],
    ) -> FilterDecision:
        """Returns a decision under which the rows last, where there is one.

        From that for the tick alone; `choose` returns the one under margins, (N,).
        """


class Gate(Protocol):
    """Lets inputs pass that a certified plan follows on, as `BackupGate` does."""

    def decide(self, tick: Tick, decision: FilterDecision) -> FilterDecision:
        """Returns the method's decision, or one with a certified plan."""


def choose_input(
    feasible: FeasibleSet,
    volume_row: VolumeRow | None,
    reference: Array,
    held_input: Array,
    policy: InfeasiblePolicy,
    solver: str = DEFAULT_SOLVER,
    frame: Frame | None = None,
    decay_rates: DecayRates | None = None,
) -> FilterDecision:
    """Returns the feasible input nearest to the reference, (E47) or (E54), (E55).

    A hard volume row gives way, by as little as possible, only when no input satisfies
    it together with the other rows; else it has the printed penalty M delta^2. Soft
    barrier rows have theirs (E71).

    Args:
        feasible: Input limits and barrier rows.
        volume_row: The volume barrier's row, finite; None where it has none.
        reference: The controller's input, shape (m,).
        held_input: The input applied now, shape (m,); for the fallbacks.
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
    fallback = partial(least_violation, feasible, frame, reference, held_input, solver)
    if not (feasible.is_finite and np.isfinite(reference).all()):
        return FilterDecision(fallback(), FilterStatus.FAILED)
    soft = feasible.soft_rows()
    qp = state_qp(feasible, frame, reference, volume_row, soft)
    growing = decay_rates
    if growing is None or growing.only_where_empty:
        growing = None
    else:
        qp = growing.grown(qp, feasible)
    is_possible = all(reference[j] == inputs.center[j] for j in inputs.fixed)
    if qp.is_met and is_possible:
        inside = inputs.project(reference)  # An ulp is lost in normalised inputs.
        is_same = inside.tolist() == reference.tolist()
        status = FilterStatus.REFERENCE if is_same else FilterStatus.FILTERED
        return FilterDecision(inside, status, qp=qp)
    try:
        point, solved = _solved(qp, solver)
    except SolverError:
        return FilterDecision(fallback(), FilterStatus.FAILED)
    except EmptySetError as error:
        # Rows of the feasible set all: those that may give way are in no conflict.
        conflict = tuple(sorted({int(qp.rows[i]) for i in error.conflict}))
        u, decay = None, 1.0
        if policy == "hold":
            u = inputs.project(held_input)
        elif policy == "decay" and decay_rates is not None:
            hard = decay_rates.grown(state_qp(feasible, frame, reference), feasible)
            with suppress(EmptySetError):  # No rate may help.
                u = inputs.project(frame.input(_nearest(hard, solver)))
                decay = decay_rates.factor(feasible, u)
        u = fallback() if u is None else u
        status = FilterStatus.INFEASIBLE
        return FilterDecision(u, status, conflict=conflict, decay=decay)
    u, gave_way = frame.input(point), solved is not qp or not qp.has_hard_volume
    slack = volume_row.slack(u) if volume_row and gave_way else 0.0
    status = FilterStatus.RELAXED if slack < 0.0 else FilterStatus.FILTERED
    soft_slacks = tuple([row.slack(u) for row in soft])
    u = inputs.project(u)
    decay = 1.0 if growing is None else growing.factor(feasible, u)
    return FilterDecision(
        u, status, slack, soft_slacks=soft_slacks, decay=decay, qp=solved
    )


def _nearest(qp: QP, solver: str) -> Array:
    """A QP's minimiser z; `EmptySetError` where its rows have no point, certified."""
    return nearest_point(qp.A, qp.b, qp.reference, qp.num_firm, solver)


def _solved(qp: QP, solver: str) -> tuple[Array, QP]:
    """A QP's minimiser; a hard volume row without one gives way by the least (E55).

    Raises:
        EmptySetError: No input satisfies the rows that never give way, certified.
        SolverError: The least slack was not verified.
    """
    i = qp.num_hard - 1
    try:
        return _nearest(qp, solver), qp
    except EmptySetError as error:
        if not (qp.has_hard_volume and i in error.conflict):
            raise
    row, b = qp.A[i], qp.b.copy()
    z = minimise_linear(row, qp.A[:i], b[:i], qp.num_firm)
    volume = UnitRows(row[None], b[[i]])
    margin = _MARGIN * float(volume.length[0] * volume.sizes(z)[0])
    b[i] = max(b[i], float(row @ z) + margin)
    relaxed = qp._replace(b=b)
    try:
        return _nearest(relaxed, solver), relaxed
    except EmptySetError as error:
        raise SolverError("no least slack was verified", qp.A, qp.b) from error


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
        with suppress(EmptySetError, SolverError):
            u = frame.input(_nearest(_eased(qp, feasible), solver))
    return feasible.input_set.project(u)


def _eased(qp: QP, feasible: FeasibleSet) -> QP:
    """The QP whose barrier rows give way by the least t, weight (a u - b) <= t."""
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
    margin = _MARGIN * UnitRows(A[k:], b[k:]).sizes(z)
    b[k:] += np.max(A[k:] @ z - b[k:], initial=0.0) + margin
    return qp._replace(A=A, b=b)
