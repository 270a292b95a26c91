"""Which ports of a plant take its input and give its state."""

from __future__ import annotations

from typing import Any

from pydrake.systems.framework import InputPort, OutputPort

from vcbf_drake.checks import require
from vcbf_drake.model.symbolic_dynamics import vector_ports


def input_port_of(plant: Any) -> InputPort:
    """Returns the port ``input`` or ``actuation``, or the only one but ``disturbance``.

    Raises:
        InvalidValueError: There is none of these.
    """
    for name in ("input", "actuation"):  # The latter is a MultibodyPlant's.
        if plant.HasInputPort(name):
            return plant.GetInputPort(name)
    ports = [port for port in vector_ports(plant) if port.get_name() != "disturbance"]
    names = [port.get_name() for port in ports]
    rule = "a system with one input, or the port that it is: plant.GetInputPort(name)"
    require(len(ports) == 1, "plant", names, rule)
    return ports[0]


def state_port_of(plant: Any) -> OutputPort:
    """Returns the port ``state``, or the only output.

    Raises:
        InvalidValueError: There is none of these.
    """
    if plant.HasOutputPort("state"):
        return plant.GetOutputPort("state")
    ports = [plant.get_output_port(i) for i in range(plant.num_output_ports())]
    names = [port.get_name() for port in ports]
    require(len(ports) == 1, "state", names, "the output port that is the state")
    return ports[0]
