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
            standard_deviation: Of each state, shape (n,) [the state's unit].
            period: How long one sample lasts [s].
            seed: Of the generator.
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


class DelayedMeasurement(LeafSystem):
    """Delivers the newest sample of a signal that is old enough.

    .. pydrake_system::

        name: DelayedMeasurement
        input_ports:
        - state
        output_ports:
        - measured_state

    Until one is, it delivers the first one. Samples carry their times, so the output is
    the same before and after the tick's own sample is stored.
    """

    def __init__(self, size: int, period: float, delay: float) -> None:
        """Declares ports and memory.

        Args:
            size: n, of the state.
            period: Time between samples [s].
            delay: How old the output is at least [s].
        """
        super().__init__()
        self._delay, self._spare = delay, _TO_SPARE * period
        self._width = 1 + size
        samples = 1 - tick_number(-delay, period)
        self._state = self.DeclareVectorInputPort("state", size)
        self.DeclareDiscreteState(np.full(samples * self._width, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store)
        self.DeclareVectorOutputPort("measured_state", size, self._calc)

    def _samples(self, context: Context) -> Array:
        """The samples, the oldest first; nan where there was none yet."""
        stored = context.get_discrete_state_vector().CopyToVector()
        samples: Array = stored.reshape(-1, self._width)
        return samples

    def _store(self, context: Context, discrete: DiscreteValues) -> None:
        sample = np.concatenate([[context.get_time()], self._state.Eval(context)])
        samples = np.vstack([self._samples(context)[1:], sample])
        discrete.set_value(samples.ravel())

    def _calc(self, context: Context, output: BasicVector) -> None:
        samples = self._samples(context)
        samples = samples[~np.isnan(samples[:, 0])]
        if len(samples) == 0:
            output.SetFromVector(self._state.Eval(context))
            return
        latest = context.get_time() - self._delay + self._spare
        old_enough = int(np.sum(samples[:, 0] <= latest))
        output.SetFromVector(samples[max(old_enough - 1, 0), 1:])


class LostMeasurements(LeafSystem):
    """Delivers the last sample again at ticks whose own is lost.

    .. pydrake_system::

        name: LostMeasurements
        input_ports:
        - state
        output_ports:
        - measured_state

    The first one is never lost. Which ones are depends on the seed and the tick alone.
    """

    def __init__(self, size: int, period: float, probability: float, seed: int) -> None:
        """Declares ports and memory.

        Args:
            size: n, of the state.
            period: Time between samples [s].
            probability: That a sample is lost.
            seed: Of the generator.
        """
        super().__init__()
        self._period, self._probability, self._seed = period, probability, seed
        self._state = self.DeclareVectorInputPort("state", size)
        self.DeclareDiscreteState(np.full(size, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store)
        self.DeclareVectorOutputPort("measured_state", size, self._calc)

    def _delivered(self, context: Context) -> Array:
        last: Array = context.get_discrete_state_vector().CopyToVector()
        tick = tick_number(context.get_time(), self._period)
        lost = chance(self._seed, tick) < self._probability
        if lost and not np.isnan(last).any():
            return last
        received: Array = self._state.Eval(context)
        return received

    def _store(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value(self._delivered(context))

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._delivered(context))


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
            obstacles: What is there.
            spheres: How it is reported, one slot an obstacle.
            num_states: n.
            positions: From states (T, n) to positions (T, k) [m].
            sight: The distance from which a surface is seen [m].
        """
        super().__init__()
        motions = [each.moving_center for each in obstacles]
        self._centers = np.array([each.start for each in motions])
        self._velocities = np.array([each.velocity for each in motions])
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
        slots[:, -1] = seen
        output.SetFromVector(slots.ravel())
