"""Sensors that are late, lose measurements or see no farther than they can."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vcbf_drake.barriers import PerceivedSpheres
from vcbf_drake.checks import Array
from vcbf_drake.simulation.scenario import Obstacle

# Ticks are compared with this part of a period to spare.
_TO_SPARE = 1e-6


def chance(seed: int, t: float, period: float) -> float:
    """Returns a number in [0, 1) that depends on the seed and the tick alone.

    Args:
        seed: Of the generator.
        t: The time [s].
        period: The time between ticks [s].
    """
    tick = math.floor(t / period + _TO_SPARE)
    return float(np.random.default_rng([seed, tick]).random())


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
        samples = math.ceil(delay / period - _TO_SPARE) + 1
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
        lost = chance(self._seed, context.get_time(), self._period) < self._probability
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
        obstacles: Sequence[Obstacle],
        spheres: PerceivedSpheres,
        num_states: int,
        position: Sequence[int],
        sight: float,
    ) -> None:
        """Declares the ports.

        Args:
            obstacles: What is there.
            spheres: How it is reported, one slot an obstacle.
            num_states: n.
            position: Which states are the position.
            sight: The distance from which a surface is seen [m].
        """
        super().__init__()
        zero = [0.0] * spheres.dimensions
        self._centers = np.array([each.center for each in obstacles])
        self._velocities = np.array([each.velocity or zero for each in obstacles])
        self._radii = np.array([each.radius + each.margin for each in obstacles])
        self._spheres, self._position, self._sight = spheres, list(position), sight
        self._state = self.DeclareVectorInputPort("state", num_states)
        self.DeclareVectorOutputPort("obstacles", spheres.size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        centers = self._centers + context.get_time() * self._velocities
        away = self._state.Eval(context)[self._position] - centers
        seen = np.linalg.norm(away, axis=1) - self._radii <= self._sight
        slots = self._spheres.pack(centers, self._velocities, self._radii)
        slots = slots.reshape(-1, self._spheres.slot_size)
        slots[:, -1] = seen
        output.SetFromVector(slots.ravel())
