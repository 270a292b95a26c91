"""Observers whose measurements come at unequal intervals, or not at all for a while."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.helpers.observer_runs import Bench, DragModel
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    LinearDisturbanceObserver,
    ObserverSettings,
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


# The proof for unequal intervals, (E34) and (E35) --------------------------------


def signal(generator) -> tuple:
    """A sum of sinusoids with its integral, and bounds of its derivatives."""
    size, rate, phase = generator.uniform([0.1, 0.2, 0.0], [1.0, 9.0, 6.3], (4, 3)).T

    def mean(a: float, b: float) -> float:
        change = np.cos(rate * a + phase) - np.cos(rate * b + phase)
        return float(np.sum(size / rate * change) / (b - a))

    return mean, *(float(np.sum(size * rate**k)) for k in range(3))


@pytest.mark.parametrize("seed", range(20))
def test_rates_of_means_over_unequal_intervals_jump_no_further(seed: int) -> None:
    generator = np.random.default_rng(seed)
    mean, _, delta2, delta3 = signal(generator)
    shortest, longest = np.sort(generator.uniform(0.005, 0.2, 2))
    h = generator.choice([shortest, longest], 400)
    t = np.concatenate([[0.0], np.cumsum(h)])
    means = np.array([mean(*ends) for ends in itertools.pairwise(t)])
    v = np.diff(means) / h[1:]
    r = longest / shortest
    assert np.abs(v).max() <= delta2 * (1.0 + r) / 2.0
    jump = delta2 * (r - 1.0 / r) / 2.0 + delta3 * longest * (1.0 + r) / 2.0
    assert np.abs(np.diff(v)).max() <= jump


@pytest.mark.parametrize("seed", range(10))
def test_the_proven_bound_holds_over_the_worst_of_intervals(seed: int) -> None:
    """The disturbance turns at random between its bounds, and so do the intervals."""
    generator = np.random.default_rng(seed)
    bounds, settings = DisturbanceBounds(0.6, 0.9, 3.0), ObserverSettings(beta=600.0)
    observer = RiseObserver(MODEL, PERIOD, bounds, settings, longest_interval=LONGEST)
    assert observer.basis == "proven"
    direction = generator.normal(size=2)
    direction /= np.linalg.norm(direction)
    d, rate, push, speed, t = 0.0, 0.0, bounds.delta3, 0.0, 0.0
    bench, fine = Bench(observer), 1e-4
    for _ in range(300):
        bench.measure(t, np.concatenate((np.zeros(2), speed * direction)))
        off = d * direction - bench.output("disturbance_estimate")
        # Speeds are summed up in steps of 0.1 ms, with d held there.
        most = bench.estimate().error_bound + bounds.delta2 * fine
        assert np.linalg.norm(off) <= most
        bench.update()
        steps = round(generator.choice([0.9 * PERIOD, PERIOD, LONGEST]) / fine)
        push = generator.choice([-1.0, 1.0]) * bounds.delta3
        for _ in range(steps):
            if abs(d) > 0.5 * bounds.delta1:
                push = -np.sign(d) * bounds.delta3
            rate = np.clip(rate + fine * push, -bounds.delta2, bounds.delta2)
            d += fine * rate
            speed += fine * d
        assert abs(d) <= bounds.delta1
        t += steps * fine
    assert observer.error_bound(t) < 0.2 * bounds.delta1


def test_what_the_bound_of_unequal_intervals_rests_on() -> None:
    """Beta of (E35) by hand; one that meets (E32) alone is calibrated."""
    delta2, delta3, h, kappa = 0.9, 3.0, 0.9 * PERIOD, 4.0
    r = LONGEST / h
    jump = delta2 * (r - 1.0 / r) / 2.0 + delta3 * LONGEST * (1.0 + r) / 2.0
    least = delta2 * (1.0 + r) / 2.0 + (1.0 + kappa * h) * jump / h
    bounds = DisturbanceBounds(0.6, delta2, delta3)

    def basis(beta=None, step="implicit", longest=LONGEST, noise=0.0) -> str:
        settings = ObserverSettings(beta=beta, step=step)
        return RiseObserver(
            MODEL, PERIOD, bounds, settings, longest_interval=longest, noise=noise
        ).basis

    assert basis(1.001 * least) == "proven"
    assert basis(0.999 * least) == basis() == basis(6.0) == "calibrated"
    assert basis(6.0, longest=PERIOD) == basis(6.0, longest=None) == "proven"
    assert basis(2.0 * least, "saturated") == "calibrated"
    assert basis(2.0 * least, noise=1e-3) == "calibrated"
    assert basis(step="saturated", longest=None) == "proven"
    linear = LinearDisturbanceObserver(MODEL, PERIOD, bounds, longest_interval=LONGEST)
    assert linear.basis == "proven"
