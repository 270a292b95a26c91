"""The system that ends a simulation when the filter's QP has no solution."""

from __future__ import annotations

from pydrake.systems.framework import Context, EventStatus, LeafSystem

from vcbf_drake.safety.qp import FilterStatus


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
