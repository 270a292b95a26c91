"""TickPrograms: a control tick as the two MathematicalPrograms that state it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.solvers import MathematicalProgram, MathematicalProgramResult

from vcbf_drake.checks import Array
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.programs import EllipsoidProgram, NearestPointProgram
from vcbf_drake.safety.tick_qp import QP
from vcbf_drake.safety.unit_rows import UnitRows


@dataclass(frozen=True)
class TickPrograms:
    """The QP and the cone program of one control tick, as MathematicalPrograms.

    Both are stated anew, with rows of unit length as the filter's solver was given
    them; nobody else holds them. The inputs are normalised, v with u = center + scale v
    (see `InputSet`), unless the cost has weights or limits are very large.

    Attributes:
        qp: min 1/2 |z - reference|^2 subject to ``A z <= b``; z is v, followed by the
            scaled slack of every row that gives way at a penalty.
        qp_rows: The meaning of each of its rows.
        ellipsoid: max (det L)^(1/P) subject to |L'a_i| + a_i d <= b_i (E48), the set's
            largest ellipsoid {L w + d : |w| <= 1}; None for a single input, whose
            largest interval needs no program.
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
        qp: QP, feasible: FeasibleSet, names: tuple[str, ...], widening: float
    ) -> TickPrograms:
        """States the programs of a tick.

        Args:
            qp: The QP that was solved.
            feasible: The feasible set whose ellipsoid was found.
            names: The names of the feasible set's rows.
            widening: kappa of the volume barrier.
        """
        A, reference, _ = qp.as_projection()
        rows = UnitRows(A, qp.b)
        nearest = NearestPointProgram(*A.shape)
        nearest.state(rows.A, rows.b, reference)
        cut, k = feasible.cut_by(widening), feasible.num_input_rows
        limits, sides = feasible.input_set.limiting
        first = feasible.input_set.limits.tolist()
        kept = [*first, *(k + cut).tolist()]
        unit = UnitRows(
            np.concatenate([limits, feasible.normals[cut]]),
            np.concatenate([sides, feasible.distance[cut] / widening]),
        )
        cone, m = None, feasible.input_set.num_inputs
        if m > 1:
            largest = EllipsoidProgram(len(kept), m, 1e-9)
            largest.state(unit.A, unit.b)
            cone = largest.program
        qp_rows = (*first, *(k + qp.cut).tolist(), *qp.further_rows)
        named = (row if isinstance(row, str) else names[row] for row in qp_rows)
        ellipsoid_rows = tuple(names[i] for i in kept)
        return TickPrograms(nearest.program, tuple(named), cone, ellipsoid_rows, qp)

    def input(self, result: MathematicalProgramResult) -> Array:
        """Returns the input u of a solution of the QP, shape (m,)."""
        y, back = result.get_x_val(), self.solved.as_projection()[2]
        return self.solved.frame.input(y if back is None else back @ y)

    def log_det(self, result: MathematicalProgramResult) -> float:
        """Returns log det B of a solution of the cone program, in normalised inputs."""
        row, column = np.tril_indices(len(self.solved.frame.scale))
        diagonal = result.get_x_val()[: len(row)][row == column]
        return float(np.log(diagonal).sum())
