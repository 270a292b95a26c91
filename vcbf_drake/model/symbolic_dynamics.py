"""The dynamics of a Drake System as symbolic expressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, TypeAlias

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression, Variable
from pydrake.systems.framework import Context, InputPort, PortDataType, System

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import Expressions
from vcbf_drake.model.declared import declared_states
from vcbf_drake.model.explained import explained, first_line
from vcbf_drake.model.graph import (
    ZERO,
    Nodes,
    gradients,
    substitute,
    variable,
    variables_of,
)
from vcbf_drake.model.massless_bodies import give_mass
from vcbf_drake.model.reading import Reader

# pydrake's classes carry no types that a checker can use.
Port: TypeAlias = Any
PortChoice: TypeAlias = InputPort | str | int | None


@dataclass(frozen=True)
class SymbolicDynamics:
    """The dynamics M(x) dx/dt = F(x, u, d) of a System; M is the identity for most.

    Attributes:
        name: What the System is called in messages.
        state_names: What its states are called, n names.
        variables: The state's variables in pydrake's terms, shape (n,).
        state: The variables x, shape (n,).
        input: The variables u, shape (m,).
        disturbance: The variables d, shape (q,).
        mass_matrix: M, shape (n, n), formulas of x.
        force: F, shape (n,), formulas of x, u and d.
        effort_limits: How large each input may be, shape (m,); infinite for most.
        rate: ``rate(x, u, d)`` is dx/dt, shape (n,), in plain numbers, by the System
            itself.
    """

    name: str
    state_names: tuple[str, ...]
    variables: Expressions
    state: Nodes
    input: Nodes
    disturbance: Nodes
    mass_matrix: Nodes
    force: Nodes
    effort_limits: Array
    rate: Callable[[Array, Array, Array], Array]


def symbolic_dynamics(
    system: System,
    input_port: PortChoice = None,
    disturbance_port: PortChoice = None,
    context: Context | None = None,
) -> SymbolicDynamics:
    """Derives the dynamics of a System, or Diagram, that converts to symbolic.

    They are read off the implicit form (CalcImplicitTimeDerivativesResidual), which is
    symbolic for a MultibodyPlant of several joints too; its explicit form is not.

    Args:
        system: The System; all its state must be continuous.
        input_port: The port of u: an InputPort, its name or its index; None for a
            MultibodyPlant's actuators, or the only vector input port beside the
            disturbance's.
        disturbance_port: The port of d, likewise; None for the port called
            "disturbance" if there is one, else q = 0.
        context: Holds the parameters, and values for the other input ports; None for
            the defaults. Other ports without a value are left unconnected if the
            System tolerates it, and held at 0 if not.

    Raises:
        ModelError: The System is not symbolic, has a state that is not continuous or
            none at all, depends on time, or its ports are not what is needed.
    """
    name = system.get_name() or system.GetSystemType()
    disturbance = find_disturbance_port(system, name, disturbance_port)
    input_ = find_input_port(system, name, input_port, disturbance)
    symbolic = _to_symbolic(system, name)
    target = default_context(symbolic, name)
    state_names = declared_states(system).names

    time = Variable("t")
    x = np.array([Variable(state) for state in state_names])
    rate = np.array([Variable(f"d{state}/dt") for state in state_names])
    u = _variables("u", input_.size())
    d = _variables("d", disturbance.size() if disturbance else 0)
    if context is not None:
        target.SetTimeStateAndParametersFrom(context)
        _copy_port_values(system, context, symbolic, target)
    target.SetTime(Expression(time))
    target.SetContinuousState(x)
    symbolic.get_input_port(input_.get_index()).FixValue(target, u)
    if disturbance:
        symbolic.get_input_port(disturbance.get_index()).FixValue(target, d)

    residual = _residual(symbolic, target, rate, name)
    named = dict(x=x, r=rate, u=u, d=d)
    nodes = {
        key: np.array([variable(f"{key}{i}") for i in range(len(each))], dtype=object)
        for key, each in named.items()
    }
    reader = Reader(
        {time: variable("t")}
        | {v: n for key in named for v, n in zip(named[key], nodes[key], strict=True)}
    )
    try:
        residual_nodes = reader.read(residual)
    except NotImplementedError as error:
        raise ModelError(f"{name}: its dynamics cannot be compiled: {error}") from None
    force, mass_matrix = _force_and_mass(residual_nodes, nodes["r"])
    _require_time_invariant(force, mass_matrix, state_names, name)
    limits = effort_limits_of(system, input_)
    own_rate = _own_rate(system, input_, disturbance, context)
    return SymbolicDynamics(
        name=name,
        state_names=state_names,
        variables=x,
        state=nodes["x"],
        input=nodes["u"],
        disturbance=nodes["d"],
        mass_matrix=mass_matrix,
        force=force,
        effort_limits=limits,
        rate=own_rate,
    )


def _force_and_mass(residual: Nodes, rate: Nodes) -> tuple[Nodes, Nodes]:
    """F and M of the residual M dx/dt - F, which is linear in the rates."""
    at_rest = dict.fromkeys(rate, ZERO)
    force = -np.array(substitute(residual, at_rest), dtype=object)
    # A rate in it is there only for want of simplification.
    mass = substitute(gradients(residual, rate).ravel(), at_rest)
    return force, np.array(mass, dtype=object).reshape(len(residual), len(rate))


def find_disturbance_port(system: System, name: str, choice: PortChoice) -> Port:
    """Returns the port of d; None where none is chosen and none is called so.

    Raises:
        ModelError: There is no such port, or it carries no vector.
    """
    if choice is None and not system.HasInputPort("disturbance"):
        return None
    return _chosen_port(system, name, "disturbance" if choice is None else choice)


def find_input_port(
    system: System, name: str, choice: PortChoice, disturbance: Port
) -> Port:
    """Returns the port of u.

    Raises:
        ModelError: There is no such port, it carries no vector or the disturbance, or
            there are several and none is chosen.
    """
    if choice is not None:
        port = _chosen_port(system, name, choice)
        if port is disturbance:
            raise ModelError(
                f"{name}: the port '{port.get_name()}' cannot be both the input and"
                " the disturbance"
            )
        return port
    if isinstance(system, MultibodyPlant) and system.num_actuated_dofs():
        return system.get_actuation_input_port()
    ports = [p for p in vector_ports(system) if p is not disturbance]
    if len(ports) != 1:
        raise ModelError(
            f"{name}: say which port is the input, by input_port; {_list_ports(system)}"
        )
    return ports[0]


def _chosen_port(system: System, name: str, choice: PortChoice) -> Port:
    if isinstance(choice, InputPort):
        if choice.get_system() is not system:
            raise ModelError(
                f"{name}: the port '{choice.get_name()}' belongs to another system;"
                f" {_list_ports(system)}"
            )
        port = choice
    elif isinstance(choice, str) and system.HasInputPort(choice):
        port = system.GetInputPort(choice)
    elif isinstance(choice, Integral) and 0 <= int(choice) < system.num_input_ports():
        port = system.get_input_port(int(choice))
    else:
        raise ModelError(
            f"{name}: there is no input port {choice!r}; {_list_ports(system)}"
        )
    if not _is_vector(port):
        raise ModelError(
            f"{name}: the port '{port.get_name()}' carries no vector;"
            f" {_list_ports(system)}"
        )
    return port


def _is_vector(port: Port) -> bool:
    return bool(port.get_data_type() == PortDataType.kVectorValued and port.size() > 0)


def vector_ports(system: System) -> list[Port]:
    """Returns the input ports that carry vectors."""
    ports = [system.get_input_port(i) for i in range(system.num_input_ports())]
    return [p for p in ports if _is_vector(p)]


def _list_ports(system: System) -> str:
    ports = [f"{p.get_name()} ({p.size()})" for p in vector_ports(system)]
    return "its vector input ports are " + (", ".join(ports) or "none")


def _to_symbolic(system: System, name: str) -> System:
    try:
        symbolic = system.ToSymbolic()
    except RuntimeError as error:
        raise ModelError(
            f"{name}: it does not convert to symbolic; write it as a template of its"
            f" scalar type (pydrake's TemplateSystem): {first_line(error)}"
        ) from None
    for actuator in _actuators(symbolic):
        actuator.set_effort_limit(np.inf)  # A clamped input is not affine.
    return symbolic


def _actuators(system: System) -> list[Any]:
    """The joint actuators of a MultibodyPlant; none of any other System."""
    if not hasattr(system, "GetJointActuatorIndices"):
        return []
    return [system.get_joint_actuator(i) for i in system.GetJointActuatorIndices()]


def effort_limits_of(system: System, port: Port) -> Array:
    """Returns how large inputs may be before a MultibodyPlant clamps them, (m,)."""
    actuators = _actuators(system)
    if actuators and port is not system.get_actuation_input_port():
        actuators = [
            each
            for each in actuators
            if port is system.get_actuation_input_port(each.model_instance())
        ]
    limits = [each.effort_limit() for each in actuators]
    return np.array(limits or [np.inf] * port.size())


def default_context(system: System, name: str) -> Context:
    """Returns the default context of a System whose state is continuous.

    Raises:
        ModelError: It has another state, or none.
    """
    context = system.CreateDefaultContext()
    if context.num_discrete_state_groups() or context.num_abstract_states():
        raise ModelError(
            f"{name}: it has discrete or abstract state; derive the model from its"
            " continuous twin (of a MultibodyPlant, the one with time_step=0) and give"
            " that as model"
        )
    if not context.num_continuous_states():
        raise ModelError(f"{name}: it has no continuous state")
    return context


def _copy_port_values(
    system: System, context: Context, symbolic: System, target: Context
) -> None:
    for port in vector_ports(system):
        if port.HasValue(context):
            value = port.Eval(context)
            symbolic.get_input_port(port.get_index()).FixValue(target, value)


def _own_rate(
    system: System, input_: Port, disturbance: Port, context: Context
) -> Callable[[Array, Array, Array], Array]:
    own = system.CreateDefaultContext()
    if context is not None:
        own.SetTimeStateAndParametersFrom(context)
        _copy_port_values(system, context, system, own)

    def rate(x: Array, u: Array, d: Array) -> Array:
        own.SetContinuousState(x)
        input_.FixValue(own, u)
        if disturbance:
            disturbance.FixValue(own, d)
        try:
            derivatives = system.EvalTimeDerivatives(own)
        except Exception:  # A System's own code may raise anything.
            unset = [p for p in vector_ports(system) if not p.HasValue(own)]
            if not unset:
                raise
            for port in unset:
                port.FixValue(own, np.zeros(port.size()))
            derivatives = system.EvalTimeDerivatives(own)
        values: Array = derivatives.CopyToVector()
        return values

    return rate


def _variables(prefix: str, size: int) -> Expressions:
    return np.array([Variable(f"{prefix}{i}") for i in range(size)], dtype=object)


# Expressions leave floating-point flags that NumPy takes for its own.
@np.errstate(invalid="ignore")
def _residual(
    system: System,
    context: Context,
    rate: Expressions,
    name: str,
    all_have_mass: bool = False,
) -> Expressions:
    """The residual M dx/dt - F; ports without a value are held at 0 if they must.

    And bodies without a mass are given one if they must have it.
    """
    derivatives = system.AllocateTimeDerivatives()
    derivatives.SetFromVector(rate)
    try:
        residual = system.CalcImplicitTimeDerivativesResidual(context, derivatives)
    except Exception as error:  # A System's own code may raise anything.
        if not all_have_mass and give_mass(system, context):
            return _residual(system, context, rate, name, all_have_mass=True)
        unset = [p for p in vector_ports(system) if not p.HasValue(context)]
        if not unset:
            raise ModelError(
                f"{name}: its dynamics do not evaluate on symbols: {explained(error)}"
            ) from None
    else:
        return np.asarray(residual, dtype=object)
    for port in unset:
        port.FixValue(context, np.zeros(port.size()))
    return _residual(system, context, rate, name, all_have_mass)


def _require_time_invariant(
    force: Nodes, mass_matrix: Nodes, state_names: tuple[str, ...], name: str
) -> None:
    for state, *row in zip(state_names, force, *mass_matrix.T, strict=True):
        if variable("t") in variables_of(row):
            raise ModelError(f"{name}: the derivative of {state} depends on time")
