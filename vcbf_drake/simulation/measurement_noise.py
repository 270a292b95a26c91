"""Noise on the measured state."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vcbf_drake.checks import Array


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
        self.DeclareVectorOutputPort("measured_state", n, self._calc_measured_state)

    def _calc_measured_state(self, context: Context, output: BasicVector) -> None:
        tick = int(np.floor(context.get_time() / self._period + 1e-9))
        sample = np.random.default_rng([self._seed, tick]).standard_normal(
            len(self._deviation)
        )
        output.SetFromVector(self._state.Eval(context) + self._deviation * sample)
