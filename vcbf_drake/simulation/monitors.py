"""Systems that end a simulation, each with a sentence that says why."""

from __future__ import annotations

import math

from pydrake.systems.framework import (
    Context,
    EventStatus,
    LeafSystem,
    PublishEvent,
    WitnessFunction,
    WitnessFunctionDirection,
)

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.safety import FilterStatus


class CollisionMonitor(LeafSystem):
    """Ends the simulation at the instant the least barrier value becomes negative.

    .. pydrake_system::

        name: CollisionMonitor
        input_ports:
        - state

    A witness function finds the instant between integrator steps; the root context
    needs an accuracy (`Context.SetAccuracy`) for it to be isolated.
    """

    def __init__(self, barriers: BarrierSet, num_states: int) -> None:
        """Declares the witness on the least of the barriers that have a value."""
        super().__init__()
        self._barriers = barriers
        self._state = self.DeclareVectorInputPort("state", num_states)
        stop = PublishEvent(
            system_callback=lambda system, context, event: (
                EventStatus.ReachedTermination(system, "collision")
            )
        )
        self._witness = self.MakeWitnessFunction(
            "least barrier value",
            WitnessFunctionDirection.kPositiveThenNonPositive,
            self.least_barrier,
            stop,
        )

    def least_barrier(self, context: Context) -> float:
        """Returns the least h over the barriers; infinite when there are none."""
        values = self._barriers.values(self._state.Eval(context), context.get_time())
        return min((h for h in values.tolist() if not math.isnan(h)), default=math.inf)

    def DoGetWitnessFunctions(self, context: Context) -> list[WitnessFunction]:  # noqa: D102
        return [self._witness]


class InfeasibilityMonitor(LeafSystem):
    """Ends the simulation at the first tick whose barrier rows have no solution.

    .. pydrake_system::

        name: InfeasibilityMonitor
        input_ports:
        - status
    """

    def __init__(self, period: float) -> None:
        """Declares the check, once per control period [s]."""
        super().__init__()
        self._status = self.DeclareVectorInputPort("status", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._check)

    def _check(self, context: Context) -> EventStatus:
        if int(self._status.Eval(context)[0]) == FilterStatus.INFEASIBLE:
            return EventStatus.ReachedTermination(self, "no feasible input")
        return EventStatus.Succeeded()
