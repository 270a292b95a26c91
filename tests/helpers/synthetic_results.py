"""Results made up without a simulation: smooth paths, random rows, known events."""

from __future__ import annotations

import numpy as np

from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.plants import BlimpVehicle, CarVehicle
from vcbf_drake.simulation import InputLimits, Scenario
from vcbf_drake.simulation.result import Result

OBSTACLES = [
    ([3.08, 0.19, 0.96], 0.67),
    ([3.31, -0.79, 1.01], 0.92),
    ([10.25, 2.07, 2.31], 0.54),
    ([3.39, -0.32, 0.24], 0.52),
    ([10.19, 2.14, 3.0], 0.86),
    ([7.38, 2.46, 1.33], 0.79),
]


def _summary(outcome, end, **times):
    keys = dict(reached_at=None, infeasible_at=None, collided_at=None)
    return {
        "outcome": outcome,
        "running_time": end,
        "final_distance": 0.3,
        **keys,
        **times,
    }


def _series(scenario, state, time, velocity, rng, empty):
    """A log whose polytope is the input box and one plausible row an obstacle."""
    ticks, inputs = len(time), len(scenario.input_set.lower)
    dims = len(scenario.target)
    lower, upper = map(np.array, (scenario.input_set.lower, scenario.input_set.upper))
    box = np.vstack([np.eye(inputs), -np.eye(inputs)])
    rows, bounds, barriers = [], [], []
    for obstacle in scenario.obstacles:
        center = np.array(obstacle.center) + np.outer(
            time, obstacle.velocity or np.zeros(dims)
        )
        offset = state[:, :dims] - center
        distance = np.linalg.norm(offset, axis=1)
        h = distance - obstacle.radius - obstacle.margin
        normal = offset / distance[:, None]
        row = np.zeros((ticks, inputs))
        row[:, 0], row[:, 1] = -normal[:, 0], -normal[:, -1]
        rows.append(row)
        rate = np.sum(normal * velocity[:, :dims], axis=1)
        bounds.append(0.12 * (3.0 * rate + 2.0 * h))
        barriers.append(h)
    A = np.concatenate(
        [np.broadcast_to(box, (ticks, *box.shape)), np.stack(rows, 1)], axis=1
    )
    limits = np.broadcast_to(np.concatenate([upper, -lower]), (ticks, 2 * inputs))
    b = np.concatenate([limits, np.stack(bounds, 1)], axis=1)
    b[:, 2 * inputs :] = np.maximum(b[:, 2 * inputs :], 0.1 * upper[0])
    b[:, 2 * inputs] = 0.2 * upper[0] * (1.5 + np.sin(time))
    volume = np.clip(0.02 + 0.9 * np.tanh(np.min(barriers, axis=0)), 0.01, 0.97)
    shape = np.einsum("t,ij->tij", np.cbrt(volume), np.diag(0.5 * (upper - lower)))
    center = np.broadcast_to(0.5 * (upper + lower), (ticks, inputs)).copy()
    if empty:
        b[-1, 2 * inputs] = -3.0 * np.abs(upper).max()
        volume[-1], shape[-1], center[-1] = np.nan, np.nan, np.nan
    reference = 0.5 * (upper + lower) + 0.7 * np.sin(
        np.outer(time, rng.uniform(0.5, 1.5, inputs))
    ) * (upper - lower)
    slack = np.zeros(ticks)
    return dict(
        time=time, state=state, reference=reference,
        input=np.clip(reference, lower, upper), slack=slack, volume=volume,
        barriers=np.stack(barriers, 1), status=np.ones(ticks, int),
        polytope_A=A, polytope_b=b, ellipsoid_shape=shape, ellipsoid_center=center,
    )  # fmt: skip


def _disturbance(time, channels):
    phases = np.arange(channels)
    true = 0.06 * np.sin(np.outer(time, 0.8 + 0.1 * phases) + phases)
    bound = 0.08 * np.exp(-0.9 * time) + 0.004
    estimate = true - 0.7 * bound[:, None] * np.exp(-0.4 * time[:, None])
    return dict(
        disturbance=true, disturbance_estimate=estimate,
        estimate_rate=np.gradient(estimate, axis=0), error_bound=bound,
    )  # fmt: skip


def blimp_result(method="dob-vcbf-qp", end=19.5, infeasible=False, seed=0, sway=1.0):
    """The blimp from the origin to (14, 3, 2.5), 50 ticks a second."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(end * 50) + 1) / 50.0
    s = np.clip(time / 19.5, 0.0, 1.0)
    s = s * s * (3.0 - 2.0 * s)
    bump = np.exp(-(((s - 0.23) / 0.09) ** 2)), np.exp(-(((s - 0.7) / 0.1) ** 2))
    position = np.stack(
        [
            14.0 * s,
            3.0 * s + sway * (1.1 * bump[0] - 0.9 * bump[1]),
            2.5 * s + sway * (0.5 * bump[0] - 0.7 * bump[1]),
        ],
        axis=1,
    )
    velocity = np.gradient(position, time, axis=0)
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0] + 1e-3)
    state = np.column_stack([position, yaw, velocity, np.gradient(yaw, time)])
    scenario = Scenario(
        name="blimp-multiple-obstacles",
        description="A blimp among spheres\nIts brakes are weak and the air is gusty.",
        vehicle=BlimpVehicle(),
        obstacles=[SphereObstacle(center, radius) for center, radius in OBSTACLES],
        input_set=InputLimits([-0.03, -0.11, -0.01], [0.11, 0.11, 0.01]),
        initial_state=state[0].tolist(),
        target=[14.0, 3.0, 2.5],
        method=method,
    )
    log = _series(scenario, state, time, velocity, rng, infeasible)
    times = {"infeasible_at": end} if infeasible else {"reached_at": end}
    outcome = "infeasible" if infeasible else "reached"
    return Result(
        scenario=scenario,
        summary=_summary(outcome, end, **times),
        log=log | _disturbance(time, 3),
    )


def car_result(
    method="dob-vcbf-qp", end=11.0, outcome="reached", bend=0.75, obstacles=None
):
    """The car from the origin to (5, 0) around three discs, one of them moving."""
    rng = np.random.default_rng(1)
    time = np.arange(int(end * 50) + 1) / 50.0
    s = np.clip(time / 11.0, 0.0, 1.0)
    s = s * s * (3.0 - 2.0 * s)
    position = np.stack([5.0 * s, bend * np.sin(2.0 * np.pi * s) * (1.0 - 0.4 * s)], 1)
    velocity = np.gradient(position, time, axis=0)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0] + 1e-3)
    state = np.column_stack([position, np.linalg.norm(velocity, axis=1), heading])
    scenario = Scenario(
        name="car-avoidance",
        description="A small car drives round discs",
        vehicle=CarVehicle(),
        obstacles=obstacles
        or [
            SphereObstacle([1.6, 0.05], 0.32, margin=0.12),
            SphereObstacle([3.3, 0.1], 0.33, margin=0.12),
            SphereObstacle([3.1, 1.6], 0.3, velocity=[0.05, -0.06], margin=0.1),
        ],
        input_set=InputLimits([-0.8, -0.7], [0.8, 0.7]),
        initial_state=state[0].tolist(),
        target=[5.0, 0.0],
        method=method,
    )
    log = _series(scenario, state, time, velocity, rng, outcome == "infeasible")
    key = {
        "reached": "reached_at",
        "collision": "collided_at",
        "infeasible": "infeasible_at",
    }
    times = {key[outcome]: end} if outcome in key else {}
    return Result(
        scenario=scenario,
        summary=_summary(outcome, end, **times),
        log=log | _disturbance(time, 1),
    )


def blimp_results():
    """Three methods in one scenario: two end early, the last arrives."""
    return [
        blimp_result("robust-cbf-qp", 16.0, seed=2, sway=1.8),
        blimp_result("dob-cbf-qp", 7.6, infeasible=True, seed=1, sway=0.8),
        blimp_result("dob-vcbf-qp", 19.5),
    ]
