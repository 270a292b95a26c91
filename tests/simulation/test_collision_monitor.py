"""Touching a limit is no collision; crossing it is, from when it was crossed."""

from __future__ import annotations

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
import pytest

from vcbf_drake import Barrier, ControlAffineModel
from vcbf_drake.barriers import BarrierSet
from vcbf_drake.plants import Car
from vcbf_drake.simulation.collision_monitor import CollisionMonitor


class Dip(LeafSystem):
    """A car's state whose x dips below 0 at time 1 and comes back."""

    def __init__(self, depth: float) -> None:
        super().__init__()

        def calc(context, output) -> None:
            x = (context.get_time() - 1.0) ** 2 - depth
            output.SetFromVector([x, 0.0, 0.0, 0.0])

        self.DeclareVectorOutputPort("state", 4, calc, {self.time_ticket()})


@pytest.mark.parametrize(
    ("depth", "ends"), [(1e-9, 3.0), (4e-9, 3.0), (1e-4, 0.99), (0.25, 0.5)]
)
def test_only_what_goes_beyond_touching_ends_a_run(depth: float, ends: float) -> None:
    model = ControlAffineModel.from_system(Car())
    barriers = BarrierSet(model, [Barrier(lambda x, t, p: x[0], [2.0, 1.0])])
    builder = DiagramBuilder()
    state = builder.AddSystem(Dip(depth))
    monitor = builder.AddSystem(CollisionMonitor(barriers, 4))
    builder.Connect(state.get_output_port(), monitor.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.get_mutable_context().SetAccuracy(1e-4)
    simulator.Initialize()
    for end in np.arange(0.01, 3.001, 0.01):  # The steps of an integrator.
        if simulator.AdvanceTo(end).return_time() < end:
            break
    assert simulator.get_context().get_time() == pytest.approx(ends, abs=2e-5)
