"""The certificate after a run: block by block what it would be of the whole log."""

import tracemalloc

import numpy as np
import pytest

from vcbf_drake import ControlAffineModel, InputSet, SafetyFilter, SphereObstacle
from vcbf_drake.between_ticks import HeldRows, certified_heights
from vcbf_drake.between_ticks.certified_heights import certified_least_barrier
from vcbf_drake.between_ticks.interval import hull
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.plants import Car
from vcbf_drake.safety import DisturbanceKnowledge, FilterSettings

PERIOD, DELTA_1, HOLD_MARGIN = 0.02, 0.8, 0.01


def parked_car(method):
    sphere = SphereObstacle([9.0, 0.0], 1.0).barrier(
        [4.0, 3.0], position=Car.position_indices
    )
    return SafetyFilter(
        ControlAffineModel.from_system(Car()),
        [sphere],
        InputSet.box([-1.0, -1.0], [1.0, 1.0]),
        FilterSettings(period=PERIOD, method=method),
        bounds=DisturbanceBounds(DELTA_1, HOLD_MARGIN / PERIOD, 0.0),
    )


def parked_log(ticks, seed=0):
    """A car that stays near one place 8 m from a disc, and what an observer thinks."""
    rng = np.random.default_rng(seed)
    return {
        "time": PERIOD * np.arange(ticks),
        "state": 1e-3 * rng.normal(size=(ticks, 4)),
        "input": 1e-3 * rng.normal(size=(ticks, 2)),
        "disturbance_estimate": rng.normal(size=(ticks, 1)),
        "error_bound": rng.uniform(0.0, 0.5, ticks),
        "barriers": np.full((ticks, 1), 8.1),
    }


@pytest.mark.parametrize("method", ["cbf-qp", "robust-cbf-qp", "dob-vcbf-qp"])
def test_a_parked_car_is_certified_where_it_stands(method):
    whole = certified_least_barrier(
        parked_car(method), parked_log(10), 9, PERIOD, DELTA_1
    )
    # 8 m less some millimetres, of which the car loses little within a period.
    assert 7.9 < whole < 8.01


@pytest.mark.parametrize("seed", range(2))
def test_the_disturbance_of_many_ticks_is_the_hull_of_every_ones(seed):
    safety_filter, log = parked_car("dob-vcbf-qp"), parked_log(9000, seed)
    rows = HeldRows(safety_filter.model, safety_filter.barrier_set, PERIOD, DELTA_1)
    every = [
        rows.disturbances(DisturbanceKnowledge(estimate, np.zeros(1), bound, 0.0, 0.0))
        for estimate, bound in zip(
            log["disturbance_estimate"], log["error_bound"] + HOLD_MARGIN, strict=True
        )
    ]
    holds = certified_heights._Holds(safety_filter, log, PERIOD, DELTA_1)
    for first, last in [(0, 9000), (3, 5), (7, 5000), (4090, 4100), (8999, 9000)]:
        (found,) = holds._disturbances(first, last)
        expected = hull(*(d for (d,) in every[first:last]))
        assert (found.low, found.high) == (expected.low, expected.high)


@pytest.mark.parametrize("method", ["robust-cbf-qp", "dob-vcbf-qp"])
def test_memory_does_not_grow_with_the_run(method):
    def peak(ticks):
        safety_filter, log = parked_car(method), parked_log(ticks)
        log["barriers"][0] = 1.0  # So near that nothing else is worth a look.
        tracemalloc.start()
        found = certified_least_barrier(safety_filter, log, ticks - 1, PERIOD, DELTA_1)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert found <= 1.0
        return most

    peak(10)  # Compiles what there is to compile.
    assert peak(100_000) < peak(10_000) + 100_000
