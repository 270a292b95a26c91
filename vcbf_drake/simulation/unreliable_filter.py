"""A safety filter whose solvers fail at random ticks."""

from __future__ import annotations

from typing import Any

from pydrake.systems.framework import Context

from vcbf_drake.safety import FilterDecision, FilterStatus, SafetyFilter
from vcbf_drake.safety.filter_qp import failed_decision
from vcbf_drake.simulation.sensor_faults import chance


class UnreliableSafetyFilter(SafetyFilter):
    """Answers at random ticks as a filter does whose solvers failed.

    .. pydrake_system::

        name: UnreliableSafetyFilter

    Its ports are the filter's. Which ticks depends on the seed and the tick alone.
    """

    def __init__(
        self,
        *arguments: Any,
        probability: float,
        period: float,
        seed: int,
        **keywords: Any,
    ) -> None:
        """Declares what a `SafetyFilter` declares.

        Args:
            *arguments: The filter's.
            probability: That a tick's solvers fail.
            period: The control period [s].
            seed: Of the generator.
            **keywords: The filter's.
        """
        super().__init__(*arguments, **keywords)
        self._probability, self._period, self._seed = probability, period, seed

    def _calc_decision(self, context: Context) -> FilterDecision:
        decision = super()._calc_decision(context)
        fails = chance(self._seed, context.get_time(), self._period) < self._probability
        if decision.status is FilterStatus.FAILED or not fails:
            return decision
        inputs = self.input_set
        reference = (self._reference.Eval(context) - inputs.center) / inputs.scale
        held = self._held_input.Eval(context)
        return failed_decision(self.feasible_set(context), reference, held, inputs)
