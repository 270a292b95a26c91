"""This package's routes: the SafetyFilter as it stands in a diagram."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.primitives import LinearSystem

from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.errors import Array
from vcbf_drake.plants import ControlAffineModel
from vcbf_drake.safety import FilterStatus, InputSet, SafetyFilter, VolumeBarrier
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
        decision = system.decision(context)
        found = decision.status in (FilterStatus.REFERENCE, FilterStatus.FILTERED)
        return decision.input if found else None

    return tick


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
