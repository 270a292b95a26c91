"""Random states of real plants, and of what a filter is told of them."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from tests.properties.decision_check import POLICIES, Tick
from vcbf_drake.barriers import (
    BarrierRows,
    PerceivedSpheres,
    StateInputLimit,
    ackermann_limit,
)
from vcbf_drake.between_ticks import BackupGate
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceEstimate
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car
from vcbf_drake.safety import (
    METHODS,
    FilterDecision,
    FilterSettings,
    InfeasiblePolicy,
    InputSet,
    SafetyFilter,
)

PLANTS = ("blimp", "car")
MOST_OBSTACLES = 4
OBSTACLE_GAINS = (4.0, 3.0)
PERIOD = 0.02

Generator = np.random.Generator


class _Filter(NamedTuple):
    system: SafetyFilter
    context: Context
    spheres: PerceivedSpheres


def random_decision(rng: Generator, plant: str) -> tuple[Tick, FilterDecision]:
    """Returns what a filter of that plant answers somewhere, and to what.

    The state is anywhere: between obstacles, inside one, at its centre, far away, or
    not a number; so are reference, estimate and error bound.

    Args:
        rng: The generator.
        plant: One of `PLANTS`.
    """
    method = str(rng.choice(list(METHODS)))
    policies = (*POLICIES, "backup")
    policy = policies[int(rng.integers(len(policies)))]
    if method == "backup" and policy == "decay":  # Its rows have no decay rates.
        policy = "backup"
    safety_filter, context, spheres = _filter(plant, method, policy)
    inputs = safety_filter.input_set
    signals = _signals(rng, safety_filter, spheres)
    for name, value in signals.items():
        safety_filter.GetInputPort(name).FixValue(context, value)
    context.SetTime(float(rng.uniform(0.0, 100.0)))
    with np.errstate(all="ignore"):
        decision = safety_filter.decision(context)
        feasible = safety_filter.feasible_set(context)
    limits = len(inputs.b)
    slopes = growth = np.zeros(0)
    if safety_filter.method.feasibility != "backup":
        slopes, growth = _decay(safety_filter, feasible.rows)
    tick = Tick(
        input_set=inputs,
        A=feasible.A[limits:],
        b=feasible.b[limits:],
        weights=feasible.costs.weights,
        volume_row=None,
        knows_volume=safety_filter.method.feasibility in ("none", "backup"),
        reference=signals["reference"],
        held_input=signals["held_input"],
        exact_slack=True,
        policy=policy,
        decays_always=safety_filter.method.feasibility == "decay",
        slopes=slopes,
        growth=growth,
        state=signals["state"],
        rates=_rates(safety_filter, signals.get("estimate")),
    )
    return tick, decision


def _decay(system: SafetyFilter, rows: BarrierRows) -> tuple[Array, Array]:
    """By how much rows open for each unit their last decay rate grows by, and may.

    The rates of an obstacle are the roots of s^2 + 4 s + 3, the least is the last; of
    its level, while positive, at most nine tenths are gone in a period.
    """
    rate, slopes = float(-np.roots([1.0, *OBSTACLE_GAINS]).max()), np.zeros(len(rows.b))
    for i, barrier in enumerate(system.barriers):
        if not isinstance(barrier, StateInputLimit) and rows.chain[i][1] > 0.0:
            slopes[i] = rate * rows.chain[i][1]
    slopes[np.isinf(slopes)] = 0.0
    return slopes, np.full(len(slopes), 0.9 / (rate * PERIOD) - 1.0)


def _rates(system: SafetyFilter, estimate: Array | None) -> Array:
    """What a volume row needs beside the state; nothing without one, or an observer."""
    if estimate is None or not system.method.has_volume_row:
        return np.zeros(0)
    known = DisturbanceEstimate.unpack(estimate)
    return np.append(known.rate, known.error_bound_rate)


@cache
def _filter(plant: str, method: str, policy: InfeasiblePolicy) -> _Filter:
    limits: list[StateInputLimit] = []
    if plant == "blimp":
        model = ControlAffineModel.from_system(Blimp())
        inputs = InputSet.box([-0.25, -0.25, -0.02], [0.25, 0.25, 0.02])
        dimensions, position = 3, Blimp.position_indices
    else:
        model = ControlAffineModel.from_system(Car())
        inputs = InputSet.box([-3.0, -4.5], [3.0, 4.5])
        dimensions, position = 2, Car.position_indices
        limits = [*ackermann_limit(2.0, 0.1)]
    spheres = PerceivedSpheres(MOST_OBSTACLES, dimensions)
    obstacles = spheres.barriers(OBSTACLE_GAINS, position)
    system = SafetyFilter(
        model,
        [*obstacles, *limits],
        inputs,
        FilterSettings(method=method, infeasible=policy),
        bounds=DisturbanceBounds(0.1, 0.0, 0.0),
        estimate_gain=5.0,
        make_gate=BackupGate,
    )
    return _Filter(system, system.CreateDefaultContext(), spheres)


def _signals(
    rng: Generator, system: SafetyFilter, spheres: PerceivedSpheres
) -> dict[str, Array]:
    """Values of the filter's input ports."""
    inputs, k = system.input_set, spheres.dimensions
    n, m, q = (
        system.model.num_states,
        system.model.num_inputs,
        system.model.num_disturbances,
    )
    signals: dict[str, Array] = {
        "state": rng.uniform(-1.0, 1.0, n) * _size(rng),
        "reference": inputs.center + inputs.scale * rng.uniform(-2, 2, m) * _size(rng),
        "held_input": inputs.center + inputs.scale * rng.uniform(-1.5, 1.5, m),
    }
    if system.method.disturbance == "estimated":
        estimate = _size(rng) * rng.uniform(-0.1, 0.1, q)
        rate = rng.uniform(-0.1, 0.1, q)
        bound = _size(rng) * np.array(rng.uniform(0.0, 0.1))
        signals["estimate"] = DisturbanceEstimate(
            estimate, rate, bound, -bound, np.array(0.0), np.array(0.0)
        ).pack()
    count = int(rng.integers(0, MOST_OBSTACLES + 1))
    signals["obstacles"] = spheres.pack(
        rng.uniform(-2.0, 2.0, (count, k)),
        rng.uniform(-0.3, 0.3, (count, k)) * rng.integers(0, 2),
        rng.uniform(0.05, 1.0, count),
    )
    if count and rng.random() < 0.05:  # Right at an obstacle's centre.
        signals["state"][list(range(k))] = signals["obstacles"][:k]
    if rng.random() < 0.15:
        name = str(rng.choice(list(signals)))
        spoilt = signals[name]
        spoilt[int(rng.integers(spoilt.size))] = rng.choice([np.nan, np.inf, -np.inf])
    return signals


def _size(rng: Generator) -> float:
    """Mostly 1, at times anything."""
    return float(10.0 ** rng.uniform(-9.0, 9.0)) if rng.random() < 0.1 else 1.0
