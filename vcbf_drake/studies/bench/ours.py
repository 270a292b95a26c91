"""This package's routes: the SafetyFilter as it stands in a diagram."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.primitives import LinearSystem

from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import (
    FeasibleSet,
    FilterDecision,
    FilterStatus,
    InputSet,
    SafetyFilter,
    VolumeBarrier,
)
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver
from vcbf_drake.safety.filter_qp import VolumeRow, choose_input
from vcbf_drake.safety.volume_barrier import volume_row
from vcbf_drake.studies.bench.problem import (
    A_PLANT,
    B_PLANT,
    CENTERS,
    GAINS,
    LIMIT,
    NUM_INPUTS,
    NUM_STATES,
    RADII,
    THRESHOLD,
    VOLUME_GAIN,
)
from vcbf_drake.studies.bench.route import Filter, VolumeGradient


def safety_filter(method: str) -> SafetyFilter:
    """Returns the filter; a method without observer, as the plant has no wind."""
    plant = LinearSystem(
        A_PLANT,
        B_PLANT,
        np.eye(NUM_STATES),
        np.zeros((NUM_STATES, NUM_INPUTS)),
    )
    return SafetyFilter(
        ControlAffineModel.from_system(plant),
        [
            SphereObstacle(center, radius, form="squared").barrier(GAINS)
            for center, radius in zip(CENTERS, RADII, strict=True)
        ],
        InputSet.box(-LIMIT * np.ones(NUM_INPUTS), LIMIT * np.ones(NUM_INPUTS)),
        method=method,
        volume_barrier=VolumeBarrier(THRESHOLD, VOLUME_GAIN),
    )


def filtered_input(method: str) -> Filter:
    """Returns a tick: ports are set, the decision is read."""
    system = safety_filter(method)
    context = system.CreateDefaultContext()

    def tick(state: Array, reference: Array) -> Array | None:
        _fix(system, context, state, reference)
        return _answer(system.decision(context))

    return tick


class SolversAlone:
    """Ellipsoid and QP of a tick, on rows and a volume row that are given.

    `prepare`, which is not measured, makes of state and reference what a call takes.
    """

    def __init__(self) -> None:
        self._system = safety_filter("vcbf-qp")
        self._context = self._system.CreateDefaultContext()
        self._solver = InscribedEllipsoidSolver(self._system.input_set)

    def prepare(
        self, state: Array, reference: Array
    ) -> tuple[FeasibleSet, list[VolumeRow], Array]:
        """Returns the feasible set, the volume rows and the reference."""
        system, context = self._system, self._context
        _fix(system, context, state, reference)
        feasible, volume = system.feasible_set(context), system.volume(context)
        if volume is None or volume.is_on_plateau:
            return feasible, [], reference
        drift, input_matrix = system.model.drift_and_input_matrix(state)
        a, c = volume_row(
            volume,
            drift,
            input_matrix,
            system.model.disturbance_matrix,
            feasible.known,
            VOLUME_GAIN,
            system.corrections.total_derivative,
        )
        penalty = system.volume_barrier.slack_penalty
        return feasible, [VolumeRow(a, c, penalty)], reference

    def __call__(
        self, feasible: FeasibleSet, volume_rows: list[VolumeRow], reference: Array
    ) -> Array | None:
        """Solves both, and returns the input as the whole tick does."""
        system, k = self._system, feasible.num_input_rows
        try:
            self._solver.solve(feasible.A_v[k:], feasible.b_v[k:])
        except EmptySetError:
            pass  # The QP says so too.
        decision = choose_input(
            feasible,
            volume_rows,
            reference,
            np.zeros(NUM_INPUTS),
            system.input_set,
            system.corrections.exact_slack,
            system.infeasible,
        )
        return _answer(decision)


def _answer(decision: FilterDecision) -> Array | None:
    found = decision.status in (FilterStatus.REFERENCE, FilterStatus.FILTERED)
    return decision.input if found else None


def volume_gradient() -> VolumeGradient:
    """Returns rows, ellipsoid and gradient, as the filter has them."""
    system = safety_filter("vcbf-qp")
    context = system.CreateDefaultContext()

    def evaluate(state: Array) -> tuple[float, Array] | None:
        _fix(system, context, state, np.zeros(NUM_INPUTS))
        volume = system.volume(context)
        if volume is None or volume.ellipsoid is None:
            return None
        return volume.value + THRESHOLD, volume.state

    return evaluate


def _fix(
    system: SafetyFilter, context: Context, state: Array, reference: Array
) -> None:
    system.GetInputPort("state").FixValue(context, state)
    system.GetInputPort("reference").FixValue(context, reference)
