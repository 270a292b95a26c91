"""Sensors that are noisy, late, unreliable or short-sighted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
import math
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vcbf_drake.barriers import PerceivedSpheres
from vcbf_drake.checks import Array

if TYPE_CHECKING:
    from vcbf_drake.barriers import SphereObstacle

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


class MeasurementNoise(LeafSystem):
    """Adds white noise to the state, a new sample every control period.

    .. pydrake_system::

        name: MeasurementNoise
        input_ports:
        - state
        output_ports:
        - measured_state

    Sample k depends on the seed and k alone, so the system needs no state and every
    run with the same seed sees the same noise.
    """

    def __init__(self, standard_deviation: Array, period: float, seed: int) -> None:
        """Declares the ports.

        Args:
            standard_deviation: Standard deviation of each state, shape (n,) [its unit].
            period: Time between samples [s].
            seed: Seed of the generator.
        """
        super().__init__()
        self._deviation = np.asarray(standard_deviation, dtype=float)
        self._period, self._seed = period, seed
        n = len(self._deviation)
        self._state = self.DeclareVectorInputPort("state", n)
        self.DeclareVectorOutputPort("measured_state", n, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        tick = tick_number(context.get_time(), self._period)
        generator = np.random.default_rng([self._seed, tick])
        sample = generator.standard_normal(len(self._deviation))
        output.SetFromVector(self._state.Eval(context) + self._deviation * sample)


class UnreliableSensor(LeafSystem):
    """Delivers the newest sample of a signal that is old enough and was not lost.

    .. pydrake_system::

        name: UnreliableSensor
        input_ports:
        - state
        output_ports:
        - measured_state

    Until one is old enough, it delivers the first one, which is never lost. Which are
    lost depends on the seed and the tick alone, and samples carry their times: so the
    output is the same before and after the tick's own sample is stored.
    """

    def __init__(
        self,
        size: int,
        period: float,
        delay: float = 0.0,
        loss: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Declares ports and memory.

        Args:
            size: n, of the state.
            period: Time between samples [s].
            delay: The least age of the output [s].
            loss: Probability that a sample is lost.
            seed: Seed of the losses.
        """
        super().__init__()
        self._period, self._delay, self._loss, self._seed = period, delay, loss, seed
        self._kept = 1 - tick_number(-delay, period)
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
        is_lost = chance(self._seed, tick) < self._loss
        if is_lost and not np.isnan(samples[-1]).any():
            return samples
        return np.vstack([samples, [t, *self._state.Eval(context)]])

    def _store(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value(self._received(context)[-self._kept :].ravel())

    def _calc(self, context: Context, output: BasicVector) -> None:
        samples = self._received(context)
        latest = context.get_time() - self._delay + _TO_SPARE * self._period
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

    def __init__(
        self,
        obstacles: Sequence[SphereObstacle],
        spheres: PerceivedSpheres,
        num_states: int,
        positions: Callable[[Array], Array],
        sight: float,
    ) -> None:
        """Declares the ports.

        Args:
            obstacles: The obstacles.
            spheres: The format of the port, one slot per obstacle.
            num_states: n.
            positions: From states (T, n) to positions (T, k) [m].
            sight: The distance from which a surface is seen [m].
        """
        super().__init__()
        motions = np.array([each.motion for each in obstacles])
        self._centers, self._velocities = motions[:, 0], motions[:, 1]
        self._surfaces = np.array([each.radius for each in obstacles])
        self._radii = np.array([each.safety_distance for each in obstacles])
        self._spheres, self._positions, self._sight = spheres, positions, sight
        self._state = self.DeclareVectorInputPort("state", num_states)
        self.DeclareVectorOutputPort("obstacles", spheres.size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        centers = self._centers + context.get_time() * self._velocities
        away = self._positions(self._state.Eval(context)[None]) - centers
        seen = np.linalg.norm(away, axis=1) - self._surfaces <= self._sight
        slots = self._spheres.pack(centers, self._velocities, self._radii)
        slots = slots.reshape(-1, self._spheres.slot_size)
        slots[: len(seen), -1] = seen
        output.SetFromVector(slots.ravel())
