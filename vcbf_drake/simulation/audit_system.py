"""Audit: what a run promises, at the tick that is now, as a Drake system."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceEstimate
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.simulation.audit import PROMISES, audit_margins


class Audit(LeafSystem):
    """Watches, with the truth that only a simulation knows, what the filter promises.

    .. pydrake_system::

        name: Audit
        input_ports:
        - state
        - disturbance
        - estimate (optional)
        - input
        - volume
        - slack
        - least_chi
        - status
        output_ports:
        - margins

    | port | size | what |
    | --- | --- | --- |
    | ``state`` | n | the true state |
    | ``disturbance`` | q | the true disturbance [m/s^2] |
    | ``margins`` | | of each of `PROMISES`: see `audit_margins` |

    The other ports are the filter's and the observer's; a method without an observer
    has no port ``estimate``. The system is pure, and costs nothing where nobody asks
    for its output: `simulate` finds the same margins for all ticks at once, from the
    log.
    """

    def __init__(
        self,
        safety_filter: SafetyFilter,
        barriers: BarrierSet,
        bounds: DisturbanceBounds,
    ) -> None:
        """Declares the ports.

        Args:
            safety_filter: The filter that is watched.
            barriers: What is truly there, whatever the filter perceives.
            bounds: What is declared of the disturbance.
        """
        super().__init__()
        self._safety_filter, self._barriers = safety_filter, barriers
        self._bounds = bounds
        model = safety_filter.model
        sizes = {
            "state": model.num_states,
            "disturbance": model.num_disturbances,
            "input": model.num_inputs,
            "volume": 1,
            "slack": 1,
            "least_chi": 1,
            "status": 1,
        }
        if safety_filter.method.disturbance == "estimated":
            sizes["estimate"] = DisturbanceEstimate.packed_size(model.num_disturbances)
        self._ports: dict[str, InputPort] = {
            name: self.DeclareVectorInputPort(name, size)
            for name, size in sizes.items()
        }
        self.DeclareVectorOutputPort("margins", len(PROMISES), self._calc_margins)

    def _calc_margins(self, context: Context, output: BasicVector) -> None:
        tick = {name: port.Eval(context)[None] for name, port in self._ports.items()}
        for name in ("volume", "slack", "least_chi", "status"):
            tick[name] = tick[name][:, 0]
        if "estimate" in tick:
            estimate = DisturbanceEstimate.unpack(tick.pop("estimate"))
            tick |= estimate.log_arrays()
        tick["time"] = np.array([context.get_time()])
        margins = audit_margins(tick, self._safety_filter, self._barriers, self._bounds)
        output.SetFromVector(margins[0])
