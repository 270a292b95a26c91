"""Two cars as one plant."""

from __future__ import annotations

from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, Multiplexer

from vcbf_drake.plants import Car


def paired_cars() -> Diagram:
    """Returns two cars whose states (8) and inputs (4) are stacked."""
    builder = DiagramBuilder()
    state = builder.AddSystem(Multiplexer([4, 4]))
    split = builder.AddSystem(Demultiplexer([2, 2]))
    for i in range(2):
        car = builder.AddNamedSystem(f"car_{i}", Car())
        builder.Connect(split.get_output_port(i), car.GetInputPort("input"))
        builder.Connect(car.GetOutputPort("state"), state.get_input_port(i))
    builder.ExportInput(split.get_input_port(), "input")
    builder.ExportOutput(state.get_output_port(), "state")
    return builder.Build()
