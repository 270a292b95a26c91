"""A disturbance that is not what was declared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vcbf_drake.simulation.faults import StepGust


class UndeclaredDisturbance(LeafSystem):
    """Scales a declared disturbance and adds gusts that come and go at once.

    .. pydrake_system::

        name: UndeclaredDisturbance
        input_ports:
        - declared
        output_ports:
        - disturbance
    """

    def __init__(self, size: int, ratio: float, gusts: Sequence[StepGust]) -> None:
        """Declares the ports.

        Args:
            size: q, of the disturbance.
            ratio: The true disturbance over the declared one.
            gusts: What comes on top.
        """
        super().__init__()
        self._ratio, self._gusts = ratio, tuple(gusts)
        self._declared = self.DeclareVectorInputPort("declared", size)
        self.DeclareVectorOutputPort("disturbance", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        t, total = context.get_time(), self._ratio * self._declared.Eval(context)
        for gust in self._gusts:
            if gust.start <= t < gust.start + gust.duration:
                total = total + np.array(gust.amplitude)
        output.SetFromVector(total)
