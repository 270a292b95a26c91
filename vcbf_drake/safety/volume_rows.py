"""VolumeRows: V_v of a filter's feasible sets, and its row in the QP."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import SolverError, VcbfError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.ellipsoid import InscribedEllipsoidSolver
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.methods import METHODS
from vcbf_drake.safety.settings import FilterSettings
from vcbf_drake.safety.tick_qp import VolumeRow
from vcbf_drake.safety.volume import Volume, VolumeMeasure, volume, volume_row


class VolumeRows:
    """The volume barrier of one filter.

    Args:
        model: The plant's f, g, E.
        input_set: What the actuators can do.
        settings: The filter's.

    Raises:
        ValueError: The method has a volume barrier, and the input set no bounds.
    """

    def __init__(
        self, model: ControlAffineModel, input_set: InputSet, settings: FilterSettings
    ) -> None:
        self._model, self._input_set, self._settings = model, input_set, settings
        solver = settings.solver
        self._is_bounded = input_set.is_bounded
        if not self._is_bounded:
            if not METHODS[settings.method].has_volume_row:
                return
            raise ValueError(
                "input_set: has an infinite limit, and the volume barrier of method"
                f" {settings.method} needs a bounded set of inputs; give limits, or"
                " take a method without volume barrier, as dob-cbf-qp"
            )
        self._measure = VolumeMeasure(input_set, 0.0, settings.volume.widening, solver)
        self._ellipsoids = InscribedEllipsoidSolver(input_set, solver)

    def determinant(self, feasible: FeasibleSet) -> Volume | None:
        """Returns V_v + xi with its derivatives; None where it cannot be verified."""
        if not (feasible.is_finite and self._is_bounded):
            return None
        if feasible.is_uncut and self._measure.widening == 1.0:
            return self._unmoved
        k = feasible.num_input_rows
        try:
            measured = self._measure(feasible.A_v[k:], feasible.b_v[k:])
        except (SolverError, np.linalg.LinAlgError):
            return None
        return volume(measured, feasible, self._input_set)

    @cached_property
    def _unmoved(self) -> Volume:
        """V_v + xi of the input set as it is."""
        measured = self._measure(np.zeros((0, self._model.num_inputs)), np.zeros(0))
        n, q = self._model.num_states, self._model.num_disturbances
        return Volume.unmoved(measured, n, q)

    def ellipsoid(
        self, feasible: FeasibleSet, known: Volume | None
    ) -> tuple[Array, Array]:
        """Returns frame (m, m) and center (m,) of the largest ellipsoid of inputs.

        Of the set as it is, whatever the widening; nan where the set is empty.

        Args:
            feasible: The feasible set.
            known: V_v, which may have found it already.
        """
        inputs, k = self._input_set, feasible.num_input_rows
        m = inputs.num_inputs
        nothing = np.full((m, m), np.nan), np.full(m, np.nan)
        if not self._is_bounded:
            return nothing
        found = known.ellipsoid if known else None
        try:
            found = found or self._ellipsoids.solve(feasible.A_v[k:], feasible.b_v[k:])
        except (VcbfError, ValueError, np.linalg.LinAlgError):
            return nothing
        frame = inputs.scale[:, None] * found.shape
        return frame, inputs.center + inputs.scale * found.center

    def rows(
        self, state: Array, feasible: FeasibleSet, v: Volume | None
    ) -> tuple[list[VolumeRow], bool]:
        """Returns the row, where it acts, and whether it is missing.

        Args:
            state: Shape (n,).
            feasible: The feasible set.
            v: V_v of it.
        """
        if v is None:
            return [], True
        if v.is_on_plateau:  # 0 <= lambda_Vv V_v.
            return [], False
        row = self._row(state, feasible, v)
        return ([row], False) if row.is_finite else ([], True)

    def _row(self, state: Array, feasible: FeasibleSet, v: Volume) -> VolumeRow:
        drift, input_matrix = self._model.drift_and_input_matrix(state)
        a, c = volume_row(
            v,
            drift,
            input_matrix,
            self._model.disturbance_matrix,
            feasible.known,
            self._settings.volume.gain,
            self._settings.corrections.total_derivative,
        )
        penalty = self._settings.volume.slack_penalty * v.unit**2
        return VolumeRow(a / v.unit, c / v.unit, penalty, unit=v.unit)


def above(threshold: float, determinant: Volume | None) -> Volume | None:
    """Returns V_v, the determinant less its threshold xi."""
    if determinant is None:
        return None
    value = determinant.value - threshold
    return replace(determinant, value=value, unit=determinant.value)
