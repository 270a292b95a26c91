"""The two programs of a control tick, to look at and to solve by other means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.solvers import MathematicalProgram, MathematicalProgramResult

from vcbf_drake.checks import Array
from vcbf_drake.safety.feasible_set import FeasibleSet, cutting_rows
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import UnitRows
from vcbf_drake.safety.programs import EllipsoidProgram, NearestPointProgram
from vcbf_drake.safety.projection import SHORTEST
from vcbf_drake.safety.qp import QP


@dataclass(frozen=True)
class TickPrograms:
    """The QP and the cone program of one control tick, as MathematicalPrograms.

    Both are stated anew, in normalised inputs v (u = center + scale v) and with rows of
    unit length, as the filter's solver was given them; nobody else holds them.

    Attributes:
        qp: min 1/2 |z - reference|^2 subject to ``A z <= b``; z is v, followed by the
            scaled slack of every row that gives way at a penalty.
        qp_rows: What each of its rows stands for.
        ellipsoid: max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i (E20), the set's
            largest ellipsoid {L w + d : |w| <= 1}; None for a single input, whose
            largest interval needs no program.
        ellipsoid_rows: What each of its rows stands for.
        input_set: What the inputs are normalised by.
    """

    qp: MathematicalProgram
    qp_rows: tuple[str, ...]
    ellipsoid: MathematicalProgram | None
    ellipsoid_rows: tuple[str, ...]
    input_set: InputSet

    def input(self, result: MathematicalProgramResult) -> Array:
        """Returns the input u of a solution of the QP, shape (m,)."""
        v = result.get_x_val()[: self.input_set.num_inputs]
        return np.asarray(self.input_set.center + self.input_set.scale * v)

    def log_det(self, result: MathematicalProgramResult) -> float:
        """Returns log det B of a solution of the cone program, in normalised inputs."""
        m = self.input_set.num_inputs
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
    rows = UnitRows(qp.A, qp.b, SHORTEST)
    nearest = NearestPointProgram(*qp.A.shape)
    nearest.state(rows.A, rows.b, qp.reference)
    bounds = feasible.b_v.copy()
    bounds[feasible.num_input_rows :] /= widening
    kept = cutting_rows(feasible.A_v, bounds, feasible.num_input_rows)
    unit = UnitRows(feasible.A_v[kept], bounds[kept])
    cone, m = None, feasible.input_set.num_inputs
    if m > 1:
        largest = EllipsoidProgram(len(kept), m, 1e-9)
        largest.state(unit.A, unit.b)
        cone = largest.program
    return TickPrograms(
        nearest.program,
        (*(names[i] for i in qp.rows), *qp.further_rows),
        cone,
        tuple(names[i] for i in kept),
        feasible.input_set,
    )
