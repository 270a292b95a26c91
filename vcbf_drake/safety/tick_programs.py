"""The two programs of a control tick, to look at and to solve by other means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.solvers import MathematicalProgram, MathematicalProgramResult

from vcbf_drake.checks import Array
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.programs import EllipsoidProgram, NearestPointProgram
from vcbf_drake.safety.tick_qp import QP, Frame
from vcbf_drake.safety.unit_rows import UnitRows


@dataclass(frozen=True)
class TickPrograms:
    """The QP and the cone program of one control tick, as MathematicalPrograms.

    Both are stated anew, with rows of unit length as the filter's solver was given
    them; nobody else holds them. The inputs are normalised, v with u = center + scale v
    (see `InputSet`), but for weights of the cost and for limits as good as none.

    Attributes:
        qp: min 1/2 |z - reference|^2 subject to ``A z <= b``; z is v, followed by the
            scaled slack of every row that gives way at a penalty.
        qp_rows: What each of its rows stands for.
        ellipsoid: max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i (E48), the set's
            largest ellipsoid {L w + d : |w| <= 1}; None for a single input, whose
            largest interval needs no program.
        ellipsoid_rows: What each of its rows stands for.
        frame: The coordinates of the QP's inputs.
        back: What makes of the QP's variables z in these, shape (d, d); None for the
            identity.
    """

    qp: MathematicalProgram
    qp_rows: tuple[str, ...]
    ellipsoid: MathematicalProgram | None
    ellipsoid_rows: tuple[str, ...]
    frame: Frame
    back: Array | None

    def input(self, result: MathematicalProgramResult) -> Array:
        """Returns the input u of a solution of the QP, shape (m,)."""
        y = result.get_x_val()
        return self.frame.input(y if self.back is None else self.back @ y)

    def log_det(self, result: MathematicalProgramResult) -> float:
        """Returns log det B of a solution of the cone program, in normalised inputs."""
        m = len(self.frame.scale)
        row, column = np.tril_indices(m)
        diagonal = result.get_x_val()[: len(row)][row == column]
        return float(np.log(diagonal).sum())


def state_programs(
    qp: QP, feasible: FeasibleSet, names: tuple[str, ...], widening: float
) -> TickPrograms:
    """States the programs of a tick.

    Args:
        qp: The QP that was solved.
        feasible: The feasible set whose ellipsoid was found.
        names: Of the feasible set's rows.
        widening: kappa of the volume barrier.
    """
    A, reference, back = qp.as_projection()
    rows = UnitRows(A, qp.b)
    nearest = NearestPointProgram(*A.shape)
    nearest.state(rows.A, rows.b, reference)
    limits, k = feasible.input_set.limits, feasible.num_input_rows
    kept = np.concatenate([limits, k + feasible.cutting_barriers(widening)])
    bounds = feasible.b_v[kept] / np.where(kept < k, 1.0, widening)
    unit = UnitRows(feasible.A_v[kept], bounds)
    cone, m = None, feasible.input_set.num_inputs
    if m > 1:
        largest = EllipsoidProgram(len(kept), m, 1e-9)
        largest.state(unit.A, unit.b)
        cone = largest.program
    return TickPrograms(
        nearest.program,
        tuple(
            row if isinstance(row, str) else names[row]
            for row in (*qp.rows, *qp.further_rows)
        ),
        cone,
        tuple(names[i] for i in kept),
        qp.frame,
        back,
    )
