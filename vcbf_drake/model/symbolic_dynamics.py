"""The dynamics of a Drake System as symbolic expressions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydrake.multibody.tree import BodyIndex
from pydrake.symbolic import Expression, MakeVectorVariable, Variable
from pydrake.systems.framework import Context, System

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.formulas import (
    Expressions,
    compile_nodes,
    explained,
    first_line,
    read,
)
from vcbf_drake.model.graph import (
    ZERO,
    Node,
    Nodes,
    gradients,
    substitute,
    variable,
    variables_of,
)
from vcbf_drake.model.interface import (
    NOT_AFFINE,
    Ports,
    declared_states,
    name_of,
    with_ports_held,
)
from vcbf_drake.model.multibody_parts import actuators_of
from vcbf_drake.model.numeric_dynamics import constant_matrix

# A negligible mass, for massless bodies that newer Drake would divide by [kg].
_MASS = 1e-15


def symbolic_dynamics(ports: Ports) -> tuple[Expressions, Nodes, Nodes, Array]:
    """Derives the dynamics of a System, or Diagram, that converts to symbolic.

    They are derived from the implicit form (CalcImplicitTimeDerivativesResidual), which
    is symbolic for a MultibodyPlant of several joints too; its explicit form is not.

    Returns:
        The state's variables in pydrake's terms, shape (n,); f, shape (n,), and g,
        shape (n, m), formulas of x0, x1, ...; and E, shape (n, q).
    """
    system, name = ports.system, name_of(ports.system)
    symbolic = to_symbolic(system, name)
    target = ports.context_of(symbolic)
    state_names = declared_states(system).names

    time = Variable("t")
    x = np.array([Variable(state) for state in state_names])
    rate = MakeVectorVariable(len(x), "rate")
    u = MakeVectorVariable(ports.input.size(), "u")
    d = MakeVectorVariable(ports.num_disturbances, "d")
    target.SetTime(Expression(time))
    target.SetContinuousState(x)
    ports.of(symbolic).fix(target, u, d)

    try:
        residual = _residual(symbolic, target, rate)
    except Exception as error:  # A System's own code may raise anything.
        raise ModelError(
            f"{name}: its dynamics do not evaluate on symbols: {explained(error)}"
        ) from None
    known = {time: variable("t")}
    for key, symbols in dict(x=x, r=rate, u=u, d=d).items():
        known |= {v: variable(f"{key}{i}") for i, v in enumerate(symbols)}
    nodes, w = read(x, known), read([*u, *d], known)
    try:
        residual_nodes = read(residual, known)
    except NotImplementedError as error:
        raise ModelError(f"{name}: its dynamics cannot be compiled: {error}") from None
    force, mass_matrix = _force_and_mass(residual_nodes, read(rate, known))
    for state, row in zip(state_names, np.c_[force, mass_matrix], strict=True):
        if variable("t") in variables_of(row):
            raise ModelError(f"{name}: the derivative of {state} depends on time")
    parts = _solve(mass_matrix, _affine_parts(force, nodes, w, state_names, name))
    f, g, E = np.split(parts, [1, 1 + len(u)], axis=1)
    E_at = _numbers(E, [*nodes])
    return x, f[:, 0], g, constant_matrix(E_at, state_names, name)


def _force_and_mass(residual: Nodes, rate: Nodes) -> tuple[Nodes, Nodes]:
    """F and M of the residual M dx/dt - F, which is linear in the rates."""
    at_rest = dict.fromkeys(rate, ZERO)
    force = -np.array(substitute(residual, at_rest), dtype=object)
    # A rate in it remains only because it is not simplified.
    mass = substitute(gradients(residual, rate).ravel(), at_rest)
    return force, np.array(mass, dtype=object).reshape(len(residual), len(rate))


def _affine_parts(
    force: Nodes, x: Nodes, w: Nodes, state_names: Sequence[str], name: str
) -> Nodes:
    """The parts [F0, F1], shape (n, 1 + m + q), of F = F0(x) + F1(x) w, w = [u; d]."""
    rows = []
    for state, each in zip(state_names, force, strict=True):
        try:
            gradient = gradients([each], w).ravel()
            row = np.array(substitute([each, *gradient], dict.fromkeys(w, ZERO)))
            # A gradient may contain w only because it is not simplified.
            structural = variables_of(gradient).isdisjoint(w)
            is_affine = structural or _agree(each, row, [*x], [*w])
        except ValueError:
            is_affine = False
        if not is_affine:
            raise ModelError(f"{name}: the derivative of {state} {NOT_AFFINE}")
        rows.append(row)
    return np.array(rows)


def _agree(force: Node, row: Nodes, x: Sequence[Node], w: Sequence[Node]) -> bool:
    """Whether F(x, w) = row . [1; w] at random points, near and far."""
    random = np.random.default_rng(0)
    parts_at, errors = _numbers(np.array([force, *row]), [*x, *w]), []
    for scale in np.geomspace(1e-3, 1e3, 25):
        x_value = random.normal(size=len(x))
        w_value = scale * random.normal(size=len(w))
        F, *parts = parts_at(np.concatenate([x_value, w_value]))
        terms = np.array(parts) * [1.0, *w_value]
        errors.append(abs(F - terms.sum()) / (np.abs(terms).max() or 1.0))
    return bool(np.fmax.reduce(errors) < 1e-9)


def _solve(M: Nodes, R: Nodes) -> Nodes:
    """Solves M X = R for X, shape (n, k), by Gaussian elimination.

    Without pivoting: M is the identity, or a positive definite matrix of inertia.
    """
    M, X = M.copy(), np.array(R)
    for k in range(len(M)):
        for i in range(k + 1, len(M)):
            if M[i, k] is not ZERO:
                factor = M[i, k] / M[k, k]
                M[i, k + 1 :] = M[i, k + 1 :] - factor * M[k, k + 1 :]
                X[i] = X[i] - factor * X[k]
    for i in reversed(range(len(M))):
        X[i] = (X[i] - M[i, i + 1 :] @ X[i + 1 :]) / M[i, i]
    return X


def _numbers(nodes: Nodes, x: Sequence[Node]) -> Callable[[Array], Array]:
    """Nodes as a function of numbers, of their shape; nan where one is singular."""
    compiled = compile_nodes(x, nodes.ravel())

    def numbers_at(point: Array) -> Array:
        try:
            return np.reshape(compiled(*point.tolist()), nodes.shape)
        except (ArithmeticError, ValueError):
            return np.full(nodes.shape, np.nan)

    return numbers_at


def to_symbolic(system: System, name: str) -> Any:
    """Returns a System's symbolic twin, without effort limits."""
    try:
        symbolic = system.ToSymbolic()
    except RuntimeError as error:
        raise ModelError(
            f"{name}: it does not convert to symbolic; write it as a template of its"
            f" scalar type (pydrake's TemplateSystem): {first_line(error)}"
        ) from None
    for actuator in actuators_of(symbolic):
        actuator.set_effort_limit(np.inf)  # A clamped input is not affine.
    return symbolic


# Expressions leave floating-point flags that NumPy takes for its own.
@np.errstate(invalid="ignore")
def _residual(system: System, context: Context, rate: Expressions) -> Expressions:
    """The residual M dx/dt - F; bodies get a mass where they must have one."""
    derivatives = system.AllocateTimeDerivatives()
    derivatives.SetFromVector(rate)

    def calc() -> Any:
        return system.CalcImplicitTimeDerivativesResidual(context, derivatives)

    try:
        residual = with_ports_held(system, context, calc)
    except Exception:  # A System's own code may raise anything.
        if not give_mass(system, context):
            raise
        residual = calc()
    return np.asarray(residual, dtype=object)


def give_mass(system: Any, context: Any) -> bool:
    """Gives massless bodies of a symbolic System a negligible mass in its context.

    A body that only carries a frame, such as a tool's tip or a stand, often has none.

    Returns:
        Whether there was such a body.
    """
    if hasattr(system, "GetSystems"):
        inside = [
            give_mass(each, each.GetMyMutableContextFromRoot(context))
            for each in system.GetSystems()
        ]
        return any(inside)
    if not hasattr(system, "num_bodies"):
        return False
    bodies = [system.get_body(BodyIndex(i)) for i in range(1, system.num_bodies())]
    massless = [body for body in bodies if body.default_mass() == 0.0]
    for body in massless:
        body.SetMass(context, Expression(_MASS))
    return bool(massless)
