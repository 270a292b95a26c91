"""Sensors that are noisy, late, unreliable or short-sighted."""

from __future__ import annotations

from functools import lru_cache
import math
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vcbf_drake.barriers import PerceivedSpheres
from vcbf_drake.checks import Array, require

if TYPE_CHECKING:
    from vcbf_drake.simulation.faults import Faults
    from vcbf_drake.simulation.scenario import Scenario
    from vcbf_drake.simulation.sections import MeasurementNoise

# Ticks are compared with this part of a period to spare.
_TO_SPARE = 1e-6


def tick_number(t: float, period: float) -> int:
    """Returns how many whole periods have passed at a time.

    Args:
        t: The time [s].
        period: The time between ticks [s].
    """
    return math.floor(t / period + _TO_SPARE)


@lru_cache(maxsize=4096)
def chance(*seeds: int) -> float:
    """Returns a number in [0, 1) that depends on the seeds alone, such as a tick's."""
    return float(np.random.default_rng(seeds).random())


class Sensor(LeafSystem):
    """Measures a state: with noise and a bias, late, and not at every tick.

    .. pydrake_system::

        name: Sensor
        input_ports:
        - state
        output_ports:
        - measured_state

    The output is the newest sample that is old enough and was not lost; until one is
    old enough, the first one, which is never lost. Noise and losses depend on their
    seeds and the tick alone, and samples carry their times: so the output is the same
    before and after the tick's own sample is stored.
    """

    def __init__(
        self, size: int, period: float, noise: MeasurementNoise, faults: Faults
    ) -> None:
        """Declares ports and memory.

        Args:
            size: n, of the state.
            period: Time between samples [s].
            noise: A new sample of it every period.
            faults: The faults of the measurement.
        """
        super().__init__()
        self._period, self._noise, self._faults = period, noise, faults
        self._deviation = np.array(noise.std or np.zeros(size))
        self._bias = np.array(faults.measurement_bias or np.zeros(size))
        self._kept = 1 - tick_number(-faults.measurement_delay, period)
        self._state = self.DeclareVectorInputPort("state", size)
        self.DeclareDiscreteState(np.full(self._kept * (1 + size), np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store)
        self.DeclareVectorOutputPort("measured_state", size, self._calc)

    def _received(self, context: Context) -> Array:
        """The samples that arrive sooner or later, each behind its time; oldest first.

        Where there are fewer than are kept, rows of nan come before them.
        """
        t = context.get_time()
        memory = context.get_discrete_state_vector().CopyToVector()
        samples: Array = memory.reshape(self._kept, -1)
        tick = tick_number(t, self._period)
        is_lost = chance(self._faults.seed, tick) < self._faults.measurement_loss
        if is_lost and not np.isnan(samples[-1]).any():
            return samples
        generator = np.random.default_rng([self._noise.seed, tick])
        noise = self._deviation * generator.standard_normal(len(self._deviation))
        return np.vstack(
            [samples, [t, *self._state.Eval(context) + noise + self._bias]]
        )

    def _store(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value(self._received(context)[-self._kept :].ravel())

    def _calc(self, context: Context, output: BasicVector) -> None:
        samples = self._received(context)
        delay = self._faults.measurement_delay
        latest = context.get_time() - delay + _TO_SPARE * self._period
        is_old = np.flatnonzero(samples[:, 0] <= latest)
        first = np.flatnonzero(~np.isnan(samples[:, 0]))[0]
        output.SetFromVector(samples[is_old[-1] if len(is_old) else first, 1:])


class ObstaclesInSight(LeafSystem):
    """Reports the obstacles whose surface is near enough to be seen.

    .. pydrake_system::

        name: ObstaclesInSight
        input_ports:
        - state
        output_ports:
        - obstacles

    The output is what `PerceivedSpheres` describes; an obstacle keeps its slot, and its
    radius there contains its margin.
    """

    def __init__(self, scenario: Scenario, spheres: PerceivedSpheres) -> None:
        """Declares the ports.

        Args:
            scenario: With its spheres, its vehicle's position, and its fault of sight.
            spheres: The format of the port, with a slot for each.
        """
        super().__init__()
        obstacles = scenario.spheres
        rule = f"at least {len(obstacles)}, the number of spheres"
        where = ("hardware", "most_obstacles")
        require(spheres.capacity >= len(obstacles), where, spheres.capacity, rule)
        motions = np.array([each.motion for each in obstacles])
        self._centers, self._velocities = motions[:, 0], motions[:, 1]
        self._surfaces = np.array([each.radius for each in obstacles])
        self._radii = np.array([each.safety_distance for each in obstacles])
        self._spheres, self._sight = spheres, scenario.faults.sight
        self._positions = scenario.vehicle.positions
        n = len(scenario.initial_state)
        self._state = self.DeclareVectorInputPort("state", n)
        self.DeclareVectorOutputPort("obstacles", spheres.size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        centers = self._centers + context.get_time() * self._velocities
        away = self._positions(self._state.Eval(context)[None]) - centers
        seen = np.linalg.norm(away, axis=1) - self._surfaces <= self._sight
        slots = self._spheres.pack(centers, self._velocities, self._radii)
        slots = slots.reshape(-1, self._spheres.slot_size)
        slots[: len(seen), -1] = seen
        output.SetFromVector(slots.ravel())
