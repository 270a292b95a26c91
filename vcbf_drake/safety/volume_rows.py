"""VolumeRows: V_v of a filter's feasible sets, and its rows in the QP."""

from __future__ import annotations

from collections.abc import Iterable
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
    """The volume barrier of one filter, and its guard where there is one.

    Args:
        model: The plant's f, g, E.
        input_set: What the actuators can do.
        settings: The filter's.

    Raises:
        ValueError: The method has a volume barrier, and the input set no bounds.

    Attributes:
        has_guard: Whether a second row, of the set as it is, gives way last.
    """

    def __init__(
        self, model: ControlAffineModel, input_set: InputSet, settings: FilterSettings
    ) -> None:
        self._model, self._input_set, self._settings = model, input_set, settings
        self.has_guard = settings.volume.guard != "none"
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
        self._guard_measure = VolumeMeasure(input_set, 0.0, 1.0, solver)
        self._ellipsoids = InscribedEllipsoidSolver(input_set, solver)

    def determinant(
        self, feasible: FeasibleSet, *, guard: bool = False
    ) -> Volume | None:
        """Returns V_v + xi with its derivatives; None where it cannot be verified.

        Args:
            feasible: The feasible set.
            guard: Of the set as it is, whatever the widening.
        """
        if not (feasible.is_finite and self._is_bounded):
            return None
        measure = self._guard_measure if guard else self._measure
        if feasible.is_uncut and measure.widening == 1.0:
            return self._unmoved
        k = feasible.num_input_rows
        try:
            measured = measure(feasible.A_v[k:], feasible.b_v[k:])
        except (SolverError, np.linalg.LinAlgError):
            return None
        return volume(measured, feasible, self._input_set)

    @cached_property
    def _unmoved(self) -> Volume:
        """V_v + xi of the input set as it is."""
        measured = self._guard_measure(
            np.zeros((0, self._model.num_inputs)), np.zeros(0)
        )
        n, q = self._model.num_states, self._model.num_disturbances
        return Volume.unmoved(measured, n, q)

    def ellipsoid(
        self, feasible: FeasibleSet, known: Iterable[Volume | None]
    ) -> tuple[Array, Array]:
        """Returns frame (m, m) and center (m,) of the largest ellipsoid of inputs.

        Of the set as it is, whatever the widening; nan where the set is empty.

        Args:
            feasible: The feasible set.
            known: Volumes that may have found it already.
        """
        inputs, k = self._input_set, feasible.num_input_rows
        m = inputs.num_inputs
        nothing = np.full((m, m), np.nan), np.full(m, np.nan)
        if not self._is_bounded:
            return nothing
        found = next((v.ellipsoid for v in known if v and v.ellipsoid), None)
        try:
            found = found or self._ellipsoids.solve(feasible.A_v[k:], feasible.b_v[k:])
        except (VcbfError, ValueError, np.linalg.LinAlgError):
            return nothing
        frame = inputs.scale[:, None] * found.shape
        return frame, inputs.center + inputs.scale * found.center

    def rows(
        self,
        state: Array,
        feasible: FeasibleSet,
        v: Volume | None,
        guard: Volume | None,
    ) -> tuple[list[VolumeRow], bool]:
        """Returns the rows that act, the guard's first, and whether one is missing.

        Args:
            state: Shape (n,).
            feasible: The feasible set.
            v: V_v of it.
            guard: The guard's, where there is one.
        """
        barrier = self._settings.volume
        measured = [("volume", v, barrier.gain)]
        if self.has_guard:
            measured.insert(0, ("guard", guard, barrier.guard_gain))
        rows = [
            self._row(state, feasible, name, each, gain)
            for name, each, gain in measured
            if each is not None and not each.is_on_plateau  # Else 0 <= lambda_Vv V_v.
        ]
        finite = [row for row in rows if row.is_finite]
        is_whole = len(finite) == len(rows) and all(each for _, each, _ in measured)
        return finite, not is_whole

    def _row(
        self, state: Array, feasible: FeasibleSet, name: str, v: Volume, gain: float
    ) -> VolumeRow:
        drift, input_matrix = self._model.drift_and_input_matrix(state)
        a, c = volume_row(
            v,
            drift,
            input_matrix,
            self._model.disturbance_matrix,
            feasible.known,
            gain,
            self._settings.corrections.total_derivative,
        )
        penalty = self._settings.volume.slack_penalty * v.unit**2
        return VolumeRow(a / v.unit, c / v.unit, penalty, name, v.unit)


def above(threshold: float, determinant: Volume | None) -> Volume | None:
    """Returns V_v, the determinant less its threshold xi."""
    if determinant is None:
        return None
    value = determinant.value - threshold
    return replace(determinant, value=value, unit=determinant.value)
