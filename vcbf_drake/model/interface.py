"""A System's interface: its ports and declared states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
from numbers import Integral
from typing import Any, TypeAlias, TypeVar

import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    InputPort,
    OutputPort,
    PortDataType,
    System,
)

from vcbf_drake.checks import Array
from vcbf_drake.errors import InvalidValueError, ModelError

# pydrake's classes carry no types that a checker can use.
Port: TypeAlias = Any
PortChoice: TypeAlias = InputPort | str | int | None
# The end of a message about the derivative of a state.
NOT_AFFINE = (
    "is not affine in the input and the disturbance; choose a port behind what is not,"
    " and give limits to the InputSet (a MultibodyPlant in a Diagram drops its own by"
    " RemoveAllJointActuatorEffortLimits)"
)
_T = TypeVar("_T")
_SCALAR = "_\N{MATHEMATICAL BOLD SCRIPT CAPITAL T}"  # Begins a template's arguments.


@dataclass(frozen=True)
class Ports:
    """The ports of a System that a model is derived from.

    A twin is the System itself, or the same in another scalar type.

    Attributes:
        input: The port of u.
        disturbance: The port of d; None for none.
        context: Holds the parameters, and values for the other input ports; None for
            the defaults.
    """

    input: Port
    disturbance: Port
    context: Context | None

    @property
    def system(self) -> Any:
        """The System."""
        return self.input.get_system()

    @property
    def num_disturbances(self) -> int:
        """The number q of disturbances."""
        return 0 if self.disturbance is None else int(self.disturbance.size())

    def context_of(self, twin: System) -> Any:
        """Returns a twin's context with the time, parameters and values of `context`.

        Raises:
            ModelError: Its state is not continuous.
        """
        found = twin.CreateDefaultContext()
        if found.num_discrete_state_groups() or found.num_abstract_states():
            raise ModelError(
                f"{name_of(twin)}: it has discrete or abstract state; derive the model"
                " from its continuous twin (of a MultibodyPlant, the one with"
                " time_step=0) and give that as model"
            )
        if not found.num_continuous_states():
            raise ModelError(f"{name_of(twin)}: it has no continuous state")
        if self.context is not None:
            found.SetTimeStateAndParametersFrom(self.context)
            for port in vector_ports(self.system):
                if port.HasValue(self.context):
                    value = port.Eval(self.context)
                    twin.get_input_port(port.get_index()).FixValue(found, value)
        return found

    def of(self, twin: System) -> Ports:
        """Returns the ports of a twin."""
        input, d = twin.get_input_port(self.input.get_index()), self.disturbance
        d = None if d is None else twin.get_input_port(d.get_index())
        return Ports(input, d, self.context)

    def fix(self, context: Context, u: Any, d: Any) -> None:
        """Sets u and d in a context of the System."""
        self.input.FixValue(context, u)
        if self.disturbance is not None:
            self.disturbance.FixValue(context, d)


@dataclass(frozen=True)
class DeclaredStates:
    """The description of a System's continuous states by its attributes.

    Attributes:
        names: ``state_names``, or a MultibodyPlant's, or x0, x1, ...
        periods: ``wrapped_states``: the period of each of these states.
        position: ``position_indices``: the indices of the position; None if the System
            names none.
        velocities: The indices of Drake's generalized velocities v.
    """

    names: tuple[str, ...]
    periods: Mapping[str, Any]
    position: Any
    velocities: tuple[int, ...] = ()


def declared_states(system: System) -> DeclaredStates:
    """Returns the declarations of a System, or of the Systems in a Diagram.

    If several of these have states, their names precede those of the states.
    """
    if isinstance(system, Diagram) and not hasattr(system, "state_names"):
        parts = [each for each in system.GetSystems() if each.num_continuous_states()]
        found = [declared_states(each) for each in parts]
        if len(found) == 1:
            return found[0]
        names: list[str] = []
        periods: dict[str, Any] = {}
        velocities: list[int] = []
        for part, states in zip(parts, found, strict=True):
            prefix = f"{part.get_name()}_"
            velocities += [len(names) + i for i in states.velocities]
            names += [prefix + name for name in states.names]
            periods |= {prefix + name: p for name, p in states.periods.items()}
        return DeclaredStates(tuple(names), periods, None, tuple(velocities))
    position = getattr(system, "position_indices", None)
    kinds = system.AllocateTimeDerivatives()
    first, size = kinds.num_q(), kinds.num_v()
    return DeclaredStates(
        _state_names(system),
        wrapping(getattr(system, "wrapped_states", ())),
        None if position is None else tuple(position),
        tuple(range(first, first + size)),
    )


def wrapping(wrapped_states: Any) -> Mapping[str, Any]:
    """Returns the periods of wrapped states: 2 pi where only names are given."""
    if isinstance(wrapped_states, Mapping):
        return wrapped_states
    return dict.fromkeys(wrapped_states, 2.0 * math.pi)


def _state_names(system: Any) -> tuple[str, ...]:
    names = getattr(system, "state_names", None)
    if names is None and hasattr(system, "GetStateNames"):
        names = system.GetStateNames()
    return tuple(names or (f"x{i}" for i in range(system.num_continuous_states())))


def unit_quaternions(x: Array, names: Sequence[str]) -> Array:
    """Returns a state (n,) with its quaternions, as Drake names them, made unit."""
    x = x.copy()
    for i, name in enumerate(names):
        if name.endswith("_qw"):
            x[i : i + 4] /= np.linalg.norm(x[i : i + 4])
    return x


def name_of(system: System) -> str:
    """Returns a System's name in messages, or its class without the scalar type."""
    return str(system.get_name()) or type(system).__name__.partition(_SCALAR)[0]


def find_input_port(
    system: System, choice: PortChoice = None, disturbance: Port = None
) -> Port:
    """Returns the port of u.

    Without a choice it is the port called ``input``, or ``actuation`` as a
    MultibodyPlant's is, or the only vector port but the disturbance's.

    Raises:
        ModelError: There is no such port, or none of several is chosen.
    """
    disturbance = disturbance or find_disturbance_port(system)
    if choice is not None:
        port = _chosen_port(system, choice)
        if port is disturbance:
            raise ModelError(
                f"{name_of(system)}: the port '{port.get_name()}' cannot be both the"
                " input and the disturbance"
            )
        return port
    ports = [port for port in vector_ports(system) if port is not disturbance]
    named = [p for p in ports if p.get_name() in ("input", "actuation")]
    if len(named or ports) != 1:
        problem = (
            "say which port is the input, by input_port, or as the plant:"
            " plant.GetInputPort(name)"
        )
        raise InvalidValueError((), _with_ports(system, problem))
    return (named or ports)[0]


def find_disturbance_port(system: System, choice: PortChoice = None) -> Port:
    """Returns the port of d; None if none is chosen or named ``disturbance``."""
    if choice is None and not system.HasInputPort("disturbance"):
        return None
    return _chosen_port(system, "disturbance" if choice is None else choice)


def state_port_of(plant: System) -> OutputPort:
    """Returns the port ``state``, or the only output."""
    if plant.HasOutputPort("state"):
        return plant.GetOutputPort("state")
    ports = [plant.get_output_port(i) for i in range(plant.num_output_ports())]
    if len(ports) != 1:
        there = ", ".join(port.get_name() for port in ports) or "none"
        problem = f"{name_of(plant)}: no output port is called state; there are {there}"
        raise InvalidValueError((), problem)
    return ports[0]


def vector_ports(system: System) -> list[Port]:
    """Returns the input ports that carry vectors."""
    ports = [system.get_input_port(i) for i in range(system.num_input_ports())]
    vector = PortDataType.kVectorValued
    return [p for p in ports if p.get_data_type() == vector and p.size() > 0]


def _chosen_port(system: System, choice: PortChoice) -> Port:
    port: Port = choice if isinstance(choice, InputPort) else None
    if isinstance(choice, str) and system.HasInputPort(choice):
        port = system.GetInputPort(choice)
    elif isinstance(choice, Integral) and 0 <= int(choice) < system.num_input_ports():
        port = system.get_input_port(int(choice))
    if port is None:
        problem = f"there is no input port {choice!r}"
    elif port.get_system() is not system:
        problem = f"the port '{port.get_name()}' belongs to another system"
    elif port not in vector_ports(system):
        problem = f"the port '{port.get_name()}' carries no vector"
    else:
        return port
    raise ModelError(_with_ports(system, problem))


def _with_ports(system: System, problem: str) -> str:
    """A message that ends with the ports that there are."""
    ports = [f"{p.get_name()} ({p.size()})" for p in vector_ports(system)]
    there = ", ".join(ports) or "none"
    return f"{name_of(system)}: {problem}; its vector input ports are {there}"


def with_ports_held(system: System, context: Context, calc: Callable[[], _T]) -> _T:
    """Returns a System's result, with unconnected ports held at 0 if it needs them."""
    try:
        return calc()
    except Exception:  # A System's own code may raise anything.
        unset = [p for p in vector_ports(system) if not p.HasValue(context)]
        if not unset:
            raise
    for port in unset:
        port.FixValue(context, np.zeros(port.size()))
    return calc()
