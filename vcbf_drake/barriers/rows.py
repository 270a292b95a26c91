"""Barrier rows: their numbers, and the functions that compute them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.chain import (
    Chain,
    ChainFunctions,
    Formula,
    compiled_chain,
    compiled_row,
    early_levels,
)
from vcbf_drake.barriers.functions import Symbols, class_k_formula
from vcbf_drake.barriers.limits import EarlyInputLimit, StateInputLimit
from vcbf_drake.barriers.multibody_rows import multibody_functions
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel, Dynamics
from vcbf_drake.model.formulas import CompiledFunction
from vcbf_drake.model.graph import Node, number
from vcbf_drake.model.multibody_model import MultibodyModel


@dataclass(frozen=True)
class BarrierRows:
    """N rows ``A u <= b + w d`` and their derivatives by xbar = [x; t], read-only.

    Few rows touch the ellipsoid at a time: derivatives are evaluated on demand. Rows of
    a barrier are (E7), (E45); rows of a limit on the input have w = 0 and no
    value. A row is not finite where its barrier is singular.

    Attributes:
        value: h, shape (N,); nan for a limit.
        chain: phi^0, ..., phi^(r-1) of (E3) for each row, shapes (r_i,); empty for a
            limit.
        A: -L_g L_f^(r-1) h, shape (N, m).
        b: K' eta + L_f^r h, shape (N,).
        w: E' grad_x L_f^(r-1) h, shape (N, q).
        num_states: n.
        gradients: ``gradients(rows)`` returns the derivatives of the entries [A, b, w]
            of the rows with these indices, shape (len(rows), m + 1 + q, n + 1).
        early: Which rows keep an early level; the zero input satisfies them (E8a).
    """

    value: Array
    chain: tuple[Array, ...]
    A: Array
    b: Array
    w: Array
    num_states: int
    gradients: Callable[[Sequence[int]], Array]
    early: tuple[int, ...] = ()

    def authority(self, scale: Array) -> Array:
        """Returns how far the input moves each row, |A diag(scale)|, shape (N,).

        Infinite for the rows of early levels, which need not be moved.
        """
        authority: Array = np.linalg.norm(self.A * scale, axis=1)
        authority[list(self.early)] = np.inf
        return authority


class RowsAlong(NamedTuple):
    """The rows of `BarrierRows` along a trajectory of T states.

    Attributes:
        chain: phi^0 = h, phi^1, ..., shape (T, N, r + 1) with the largest r; nan beyond
            a row's own phi^(r-1).
        A: Shape (T, N, m).
        b: Shape (T, N).
        w: Shape (T, N, q).
    """

    chain: Array
    A: Array
    b: Array
    w: Array


@dataclass(frozen=True)
class RowFunctions:
    """The row of one barrier or limit as functions of plain floats.

    Attributes:
        row: As in `ChainFunctions`, like `gradient` and `value`; a limit has no levels
            after its entries, and no value, [].
        gradient: Likewise.
        value: Likewise.
        constants: The arguments of a row after x and t: decay rates and the like, then
            parameters.
        parameters: The arguments of a value after x and t.
        relative_degree: r; 0 for a limit.
        early_levels: Which derivatives of h below the r-th an input enters (E8a).
    """

    row: CompiledFunction
    gradient: CompiledFunction
    value: CompiledFunction
    constants: tuple[float, ...]
    parameters: tuple[float, ...]
    relative_degree: int
    early_levels: tuple[int, ...] = ()

    def with_parameters(self, parameters: tuple[float, ...]) -> RowFunctions:
        """Returns the same barrier's functions with other parameters."""
        fixed = self.constants[: len(self.constants) - len(self.parameters)]
        constants = (*fixed, *parameters)
        return replace(self, constants=constants, parameters=parameters)


def no_row(model: ControlAffineModel) -> RowFunctions:
    """Returns the functions of a row that every input satisfies, 0 u <= 1."""
    always = tuple(number(value) for value in (*np.zeros(model.num_inputs), 1.0))
    return RowFunctions(*_limit(always, model.dynamics, ()), (), (), 0)


def barrier_functions(model: ControlAffineModel, barrier: Barrier) -> RowFunctions:
    """Returns a barrier's functions, its relative degree checked."""
    parameters, constants = tuple(barrier.parameters.tolist()), barrier.constants
    r, early = barrier.relative_degree, tuple[int, ...]()
    symbols, written = _read(model, barrier)
    if isinstance(model, MultibodyModel):
        functions = multibody_functions(model, written, symbols.points, constants)
    else:
        early = early_levels(model, Chain.of(written), barrier)
        x = written.dynamics.x
        functions = compiled_chain(written, x, x)
    return RowFunctions(*functions, constants, parameters, r, early)


def early_functions(model: ControlAffineModel, limit: EarlyInputLimit) -> RowFunctions:
    """Returns the functions of the row of an early level (E8a)."""
    barrier, k = limit.barrier, limit.level
    formula = barrier_formula(model, barrier)
    chain, dynamics = Chain.of(formula), formula.dynamics
    entries = (*-dynamics.input_rates(chain.levels[k - 1]), chain.levels[k])
    compiled = _limit(entries, dynamics, chain.constants)
    parameters = tuple(barrier.parameters.tolist())
    return RowFunctions(*compiled, barrier.constants, parameters, 0)


def barrier_formula(model: ControlAffineModel, barrier: Barrier) -> Formula:
    """Returns the formula that a barrier's rows are derived from."""
    return _read(model, barrier)[1]


# As in `BarrierSet`: pydrake's expressions set the flag "invalid" in exact arithmetic.
@np.errstate(invalid="ignore")
def _read(model: ControlAffineModel, barrier: Barrier) -> tuple[Symbols, Formula]:
    symbols = Symbols(model, len(barrier.parameters))
    h = symbols.call(barrier.function, barrier.of_position)
    h = np.asarray(h, dtype=object)
    if h.shape != ():
        raise ModelError(
            f"function(x, t, p) must return one scalar expression, got shape {h.shape}"
        )
    formula = Formula(
        symbols.read(h).item(),
        model.dynamics,
        symbols.parameters,
        barrier.relative_degree,
        barrier.early_disturbance is not None,
        class_k_formula(barrier.class_k),
    )
    return symbols, formula


def limit_functions(model: ControlAffineModel, limit: StateInputLimit) -> RowFunctions:
    """Returns a limit's functions; errors as for a barrier's."""
    parameters = tuple(limit.parameters.tolist())
    symbols = Symbols(model, len(parameters))
    result = symbols.call(limit.function)
    shapes = [np.shape(part) for part in result] if isinstance(result, tuple) else None
    if shapes != [(model.num_inputs,), ()]:
        raise ModelError(
            f"function(x, t, p) must return a row of shape ({model.num_inputs},) and a"
            f" scalar bound, got {'no pair' if shapes is None else shapes}"
        )
    row, bound = result
    entries = tuple(symbols.read([*row, bound]))
    compiled = _limit(entries, model.dynamics, symbols.parameters)
    return RowFunctions(*compiled, parameters, parameters, 0)


def _limit(
    entries: tuple[Node, ...], dynamics: Dynamics, constants: tuple[Node, ...]
) -> ChainFunctions:
    """Returns the functions of a row without a chain, which has no value."""
    no_disturbance = map(number, np.zeros(len(dynamics.E[0])))
    row = compiled_row((*entries, *no_disturbance), (), dynamics.x, constants)
    return ChainFunctions(*row, _no_value)


def _no_value(*_: float) -> list[float]:
    return []
