"""What Drake asks of a tick in Python that does nothing: python drake_floor.py."""

import time
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator,
    SimulatorConfig,
)
from pydrake.systems.framework import DiagramBuilder, LeafSystem, ValueProducer
from pydrake.systems.primitives import LinearSystem, LogVectorOutput, ZeroOrderHold

_PERIOD, _TICKS = 0.01, 2000
_STATES, _INPUTS = 8, 3


class Plant(LeafSystem):
    """Stands still, in Python."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorInputPort("input", _INPUTS)
        self.DeclareStateOutputPort("state", self.DeclareContinuousState(_STATES))

    def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
        pass


class Filter(LeafSystem):
    """Says zero at every port, after a look at a cache entry."""

    def __init__(self, num_ports: int) -> None:
        super().__init__()
        state = self.DeclareVectorInputPort("state", _STATES)
        producer = ValueProducer(
            allocate=lambda: Value[object](),
            calc=lambda context, value: value.set_value(np.zeros(_INPUTS)),
        )
        entry = self.DeclareCacheEntry("decision", producer, {state.ticket()})
        for i in range(num_ports):
            self.DeclareVectorOutputPort(
                f"port_{i}",
                _INPUTS,
                lambda context, output: output.SetFromVector(entry.Eval(context)),
                {entry.ticket()},
            )


def tick_time(num_ports: int, plant_in_python: bool) -> float:
    """Returns the CPU time of a control tick [us], the least of five runs.

    Args:
        num_ports: How many ports of the filter are logged.
        plant_in_python: Whether the derivative is evaluated in Python.
    """
    builder = DiagramBuilder()
    A, B = np.zeros((_STATES, _STATES)), np.zeros((_STATES, _INPUTS))
    plant = builder.AddSystem(
        Plant() if plant_in_python else LinearSystem(A, B, np.eye(_STATES), B)
    )
    tick = builder.AddSystem(Filter(num_ports))
    hold = builder.AddSystem(ZeroOrderHold(_PERIOD, _INPUTS))
    builder.Connect(plant.get_output_port(), tick.get_input_port())
    builder.Connect(tick.get_output_port(0), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_input_port())
    for i in range(num_ports):
        LogVectorOutput(tick.get_output_port(i), builder, _PERIOD)
    diagram = builder.Build()
    spent = []
    for _ in range(5):
        simulator = Simulator(diagram)
        config = SimulatorConfig(
            integration_scheme="runge_kutta3",
            max_step_size=_PERIOD,
            use_error_control=False,
        )
        ApplySimulatorConfig(config, simulator)
        simulator.Initialize()
        started = time.thread_time()
        simulator.AdvanceTo(_TICKS * _PERIOD)
        spent.append(1e6 * (time.thread_time() - started) / _TICKS)
    return min(spent)


def main() -> None:
    """Prints the table of docs/results/performance.md."""
    print("| logged ports | plant | us a tick |\n| --- | --- | --- |")
    for num_ports, in_python in ((1, False), (1, True), (8, True), (16, True)):
        plant = "Python" if in_python else "C++"
        print(f"| {num_ports} | {plant} | {tick_time(num_ports, in_python):.0f} |")


if __name__ == "__main__":
    main()
