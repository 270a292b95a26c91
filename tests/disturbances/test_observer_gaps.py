"""Observers whose measurements come at unequal intervals, or not at all for a while."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.observer_runs import Bench, DragModel
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    LinearDisturbanceObserver,
    RiseObserver,
)

MODEL = DragModel(q=2, linear=0.0, cubic=0.0)
PERIOD, LONGEST = 0.01, 0.08  # In seconds.
SIZE, RATE = 0.3, 0.9  # Of the disturbance, in m/s^2 and rad/s.
PHASE = np.array([0.0, 1.1])
BOUNDS = DisturbanceBounds(*(SIZE * 2**0.5 * RATE**k for k in range(3)))
OBSERVERS = [RiseObserver, LinearDisturbanceObserver]


def disturbance(t: float) -> np.ndarray:
    return SIZE * np.sin(RATE * t + PHASE)


def state(t: float) -> np.ndarray:
    """Of a mass that only the disturbance moves; its position is not looked at."""
    speed = SIZE / RATE * (np.cos(PHASE) - np.cos(RATE * t + PHASE))
    return np.concatenate((np.zeros(2), speed))


def error(bench: Bench, t: float) -> float:
    return float(np.linalg.norm(disturbance(t) - bench.output("disturbance_estimate")))


def settled(observer, until: float = 3.0) -> Bench:
    bench = Bench(observer)
    for t in np.arange(0.0, until, PERIOD):
        bench.measure(t, state(t))
        bench.update()
    return bench


@pytest.mark.parametrize("kind", OBSERVERS)
@pytest.mark.parametrize("seed", range(4))
def test_the_bound_holds_over_unequal_intervals(kind, seed: int) -> None:
    bench = Bench(kind(MODEL, PERIOD, BOUNDS, longest_interval=LONGEST))
    generator, t = np.random.default_rng(seed), 0.0
    while t < 8.0:
        bench.measure(t, state(t))
        assert error(bench, t) <= bench.estimate().error_bound
        bench.update()
        # Some intervals are ten times as long as others.
        t += generator.choice([0.8 * PERIOD, PERIOD, 0.99 * LONGEST])
    assert bench.estimate().error_bound < 0.25 * BOUNDS.delta1


@pytest.mark.parametrize("kind", OBSERVERS)
@pytest.mark.parametrize("later", [1.01 * LONGEST, 2.0, -2.9])
def test_after_a_gap_or_back_in_time_it_begins_anew(kind, later: float) -> None:
    observer = kind(MODEL, PERIOD, BOUNDS, longest_interval=LONGEST)
    bench = settled(observer)
    calm = bench.estimate().error_bound
    t = 2.99 + later
    bench.measure(t, state(t))
    for _ in range(2):  # Before the update and after it.
        assert bench.output("disturbance_estimate").tolist() == [0.0, 0.0]
        assert bench.estimate().rate.tolist() == [0.0, 0.0]
        assert bench.estimate().error_bound == observer.error_bound(0.0)
        assert error(bench, t) <= bench.estimate().error_bound
        bench.update()
    assert observer.error_bound(0.0) > 3.0 * calm
    for later_tick in np.arange(1, 400):
        moment = t + later_tick * PERIOD
        bench.measure(moment, state(moment))
        assert error(bench, moment) <= bench.estimate().error_bound
        bench.update()
    assert bench.estimate().error_bound == pytest.approx(
        observer.error_bound(399 * PERIOD)
    )


@pytest.mark.parametrize("kind", OBSERVERS)
def test_a_gap_is_bridged_unless_a_longest_interval_is_given(kind) -> None:
    bench = settled(kind(MODEL, PERIOD, BOUNDS))
    bench.measure(3.2, state(3.2))
    assert np.any(bench.output("disturbance_estimate"))
    assert bench.estimate().error_bound == bench.observer.error_bound(3.2)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_a_longer_interval_costs_a_higher_floor(kind) -> None:
    usual = kind(MODEL, PERIOD, BOUNDS)
    patient = kind(MODEL, PERIOD, BOUNDS, longest_interval=LONGEST)
    slow = kind(MODEL, LONGEST, BOUNDS)
    assert usual.certified_interval == PERIOD
    assert patient.certified_interval == slow.certified_interval == LONGEST
    assert patient.error_bound(60.0) == slow.error_bound(60.0)
    assert patient.error_bound(60.0) > usual.error_bound(60.0)
    assert kind(MODEL, 1.0, BOUNDS, longest_interval=0.1).longest_interval == 1.0
