"""The system that ends a simulation when a barrier becomes negative."""

from __future__ import annotations

import math
from typing import Any

from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    PublishEvent,
    ValueProducer,
    WitnessFunction,
    WitnessFunctionDirection,
)

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.model.interface import state_port_of

# A barrier nearer to 0 than this is touched, not crossed, in its unit. A robot may rest
# at a limit for long; rounding and an integrator's steps know its h no better.
TOUCH = 1e-7
COLLISION_MONITOR = "collision_monitor"


class CollisionMonitor(LeafSystem):
    """Ends the simulation when the least barrier value becomes negative.

    .. pydrake_system::

        name: CollisionMonitor
        input_ports:
        - state
        - obstacles (where some are perceived)

    A witness function finds the instant of the crossing between integrator steps, so
    that a log of every step has it; another ends the simulation once h < -`TOUCH`. The
    root context needs an accuracy (`Context.SetAccuracy`) for them to be isolated.

    Attributes:
        barrier_set: The barriers it looks at.
    """

    def __init__(self, barriers: BarrierSet, num_states: int) -> None:
        """Declares the witness on the least of the barriers that have a value."""
        super().__init__()
        self.barrier_set = barriers
        self._state = self.DeclareVectorInputPort("state", num_states)
        needs = {self._state.ticket(), self.time_ticket()}
        self._obstacles: InputPort | None = None
        if barriers.obstacles_size:
            self._obstacles = self.DeclareVectorInputPort(
                "obstacles", barriers.obstacles_size
            )
            needs.add(self._obstacles.ticket())
        # The witness is asked at the end of a step and at the start of the next.
        self._least = self.DeclareCacheEntry(
            "least barrier value",
            ValueProducer(allocate=lambda: Value[float](), calc=self._calc_least),
            needs,
        )
        stop = PublishEvent(
            system_callback=lambda system, context, event: (
                EventStatus.ReachedTermination(system, "collision")
            )
        )
        falls = WitnessFunctionDirection.kPositiveThenNonPositive
        self._witnesses = [
            self.MakeWitnessFunction("crossing", falls, self.least_barrier),
            self.MakeWitnessFunction(
                "beyond touching", falls, lambda c: self.least_barrier(c) + TOUCH, stop
            ),
        ]

    def least_barrier(self, context: Context) -> float:
        """Returns the least h over the barriers; infinite when there are none."""
        least: float = self._least.Eval(context)
        return least

    def _calc_least(self, context: Context, least: Any) -> None:
        x, t = self._state.Eval(context), context.get_time()
        seen = None if self._obstacles is None else self._obstacles.Eval(context)
        values = self.barrier_set.values(x, t, seen)
        numbers = [h for h in values.tolist() if not math.isnan(h)]
        least.set_value(min(numbers, default=math.inf))

    def DoGetWitnessFunctions(self, context: Context) -> list[WitnessFunction]:  # noqa: D102
        return self._witnesses


def add_collision_monitor(
    builder: DiagramBuilder,
    plant: LeafSystem,
    barrier_set: BarrierSet,
    seen: OutputPort | None = None,
) -> None:
    """Adds the monitor that ends a simulation when a barrier becomes negative."""
    state = state_port_of(plant)
    monitor = builder.AddNamedSystem(
        COLLISION_MONITOR, CollisionMonitor(barrier_set, state.size())
    )
    builder.Connect(state, monitor.GetInputPort("state"))
    if seen is not None and monitor.HasInputPort("obstacles"):
        builder.Connect(seen, monitor.GetInputPort("obstacles"))
