"""A plant for disturbance observers, and runs of an observer beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceEstimate,
    DisturbanceObserver,
    ObserverSettings,
    RiseGains,
    RiseObserver,
)
from vcbf_drake.model import ControlAffineModel


class DragModel(ControlAffineModel):
    """A point mass in q dimensions with drag that grows with speed; state (p, v)."""

    def __init__(self, q: int = 2, linear: float = 0.4, cubic: float = 0.2) -> None:
        self.name = "drag"
        self.num_states, self.num_inputs, self.num_disturbances = 2 * q, q, q
        self.linear, self.cubic = linear, cubic
        self.disturbance_matrix = np.vstack([np.zeros((q, q)), np.eye(q)])
        self.input_matrix = 1.3 * self.disturbance_matrix

    def drift_and_input_matrix(self, x: Array) -> tuple[Array, Array]:
        v = x[self.num_inputs :]
        drag = (self.linear + self.cubic * (v @ v)) * v
        return np.concatenate((v, -drag)), self.input_matrix

    def difference(self, x_1: Array, x_0: Array) -> Array:
        return x_1 - x_0

    def nominal_rate(self, x: Array, u: Array) -> Array:
        f, g = self.drift_and_input_matrix(x)
        return f + g @ u


def rise(
    model: DragModel,
    period: float,
    bounds: DisturbanceBounds,
    gains: RiseGains | None = None,
    *,
    noise: float = 0.0,
    floor: bool = True,
    longest_interval: float | None = None,
    **chosen: object,
) -> RiseObserver:
    """A RISE observer whose settings are keywords."""
    return RiseObserver(
        model,
        period,
        bounds,
        ObserverSettings(**(vars(gains) if gains else {}), **chosen),
        noise=noise,
        floor=floor,
        longest_interval=longest_interval,
    )


@dataclass
class Run:
    """What an observer's ports said at each tick, before its update."""

    time: Array
    disturbance: Array
    estimate: Array
    rate: Array
    bound: Array
    bound_rate: Array

    @property
    def error(self) -> Array:
        return np.linalg.norm(self.disturbance - self.estimate, axis=1)


class Bench:
    """An observer with its input ports fixed and its clock set by hand."""

    def __init__(self, observer: DisturbanceObserver) -> None:
        self.observer = observer
        self.context = observer.CreateDefaultContext()
        self.measure(0.0, np.zeros(observer.GetInputPort("state").size()))
        self.hold(np.zeros(observer.GetInputPort("input").size()))

    def measure(self, time: float, state: Array) -> None:
        self.context.SetTime(time)
        self.observer.GetInputPort("state").FixValue(self.context, state)

    def hold(self, u: Array) -> None:
        self.observer.GetInputPort("input").FixValue(self.context, u)

    def output(self, name: str) -> Array:
        return self.observer.GetOutputPort(name).Eval(self.context)

    def estimate(self) -> DisturbanceEstimate:
        return DisturbanceEstimate.unpack(self.output("estimate"))

    def update(self) -> None:
        self.context.SetDiscreteState(
            self.observer.EvalUniquePeriodicDiscreteUpdate(self.context)
        )


def run(
    observer: DisturbanceObserver,
    model: DragModel,
    disturbance: Callable[[float], Array],
    duration: float,
    *,
    start: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
) -> Run:
    """Drives the plant by RK4 under random inputs, and the observer by its states."""
    generator = np.random.default_rng(seed)
    bench, dt = Bench(observer), observer.period
    x, u, logs = generator.normal(size=model.num_states), np.zeros(model.num_inputs), []
    for k in range(round(duration / dt) + 1):
        t = start + k * dt
        bench.measure(t, x + noise * generator.normal(size=x.shape))
        logs.append((t, disturbance(t), *bench.estimate()[:4]))
        bench.update()
        u = np.clip(u + 0.3 * generator.normal(size=u.shape), -1.0, 1.0)
        bench.hold(u)
        x = _rk4(model, disturbance, x, u, t, dt)
    time, d, estimate, rate, bound, bound_rate = map(np.array, zip(*logs, strict=True))
    return Run(time, d, estimate, rate, bound, bound_rate)


def _rk4(
    model: DragModel,
    disturbance: Callable[[float], Array],
    x: Array,
    u: Array,
    t: float,
    dt: float,
) -> Array:
    steps = max(1, round(dt / 2.5e-3))
    h = dt / steps

    def rate(s: float, y: Array) -> Array:
        return model.nominal_rate(y, u) + model.disturbance_matrix @ disturbance(s)

    for i in range(steps):
        s = t + i * h
        k1 = rate(s, x)
        k2 = rate(s + h / 2, x + h / 2 * k1)
        k3 = rate(s + h / 2, x + h / 2 * k2)
        k4 = rate(s + h, x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
