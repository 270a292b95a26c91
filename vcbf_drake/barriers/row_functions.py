"""Barriers and limits compiled to fast functions, once for each formula."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from pydrake.symbolic import Expression, Jacobian, MakeVectorVariable, Variable

from vcbf_drake.barriers.barrier import Barrier, EarlyDisturbance
from vcbf_drake.barriers.formula import Formula, Symbols, as_expressions
from vcbf_drake.barriers.input_limits import StateInputLimit
from vcbf_drake.barriers.lie_derivatives import LieDerivatives, drift_rate
from vcbf_drake.barriers.relative_degree import check_relative_degree
from vcbf_drake.barriers.robust_chain import RobustChain
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import (
    CompiledFunction,
    Expressions,
    compile_expressions,
)
from vcbf_drake.model.control_affine import ControlAffineModel


@dataclass(frozen=True)
class RowFunctions:
    """One barrier's or limit's numbers as functions of plain floats.

    Attributes:
        row: ``row(*x, t, *constants)`` returns a flat list: the entries [A, b, w]
            (m + 1 + q), then for a barrier phi^0, ..., phi^(r-1).
        gradient: ``gradient(*x, t, *constants)`` returns the entries' derivatives by
            [x; t] in C order.
        constants: What follows x and t: gains, decay rates and the like, parameters.
        value: ``value(*x, t, *parameters)`` returns [h]; [] for a limit.
        parameters: What follows x and t there.
        relative_degree: r; 0 for a limit.
    """

    row: CompiledFunction
    gradient: CompiledFunction
    constants: tuple[float, ...]
    value: CompiledFunction
    parameters: tuple[float, ...]
    relative_degree: int

    def with_parameters(self, parameters: tuple[float, ...]) -> RowFunctions:
        """Returns the same barrier's functions with other parameters."""
        fixed = self.constants[: len(self.constants) - len(self.parameters)]
        constants = (*fixed, *parameters)
        return replace(self, constants=constants, parameters=parameters)


def no_row(model: ControlAffineModel) -> RowFunctions:
    """Returns the functions of a row that every input satisfies, 0 u <= 1."""
    symbols = Symbols.of(model, 0)
    always = [*np.zeros(model.num_inputs), 1.0]
    row, gradient = _compile_limit(symbols.formula(always))
    return RowFunctions(row, gradient, (), _no_value, (), 0)


def barrier_functions(model: ControlAffineModel, barrier: Barrier) -> RowFunctions:
    """Returns a barrier's functions, its relative degree checked.

    Raises:
        ModelError: The barrier's function cannot be derived or compiled, or its
            relative degree is not r.
    """
    parameters = tuple(barrier.parameters.tolist())
    symbols = Symbols.of(model, len(parameters))
    h = np.asarray(symbols.call(barrier.function), dtype=object)
    if h.shape != ():
        raise ModelError(
            f"function(x, t, p) must return one scalar expression, got shape {h.shape}"
        )
    early = barrier.early_disturbance
    try:
        formula = symbols.formula([h.item()])
        if early is None:
            derivatives = _derive(formula, barrier.relative_degree)
            check_relative_degree(derivatives, barrier.parameters)
            row, gradient, value = _compile_barrier(derivatives)
        else:
            rates = tuple(barrier.decay_rates.tolist())
            _check_robust(formula, rates, early, barrier.parameters)
            row, gradient, value = _compile_robust(formula, barrier.relative_degree)
    except RuntimeError as error:  # pydrake's word for what has no derivative.
        raise ModelError(
            "function(x, t, p) cannot be differentiated as often as needed: write it"
            f" without abs and without the root of a square ({error})"
        ) from error
    rates = barrier.decay_rates.tolist()
    fixed = (
        (*barrier.gains.tolist(), *rates)
        if early is None
        else (*rates, early.bound, early.smoothing)
    )
    constants = (*fixed, *parameters)
    return RowFunctions(
        row, gradient, constants, value, parameters, barrier.relative_degree
    )


def limit_functions(model: ControlAffineModel, limit: StateInputLimit) -> RowFunctions:
    """Returns a limit's functions.

    Raises:
        ModelError: The limit's function cannot be derived or compiled.
    """
    parameters = tuple(limit.parameters.tolist())
    symbols = Symbols.of(model, len(parameters))
    result = symbols.call(limit.function)
    shapes = [np.shape(part) for part in result] if isinstance(result, tuple) else None
    if shapes != [(model.num_inputs,), ()]:
        raise ModelError(
            f"function(x, t, p) must return a row of shape ({model.num_inputs},) and a"
            f" scalar bound, got {'no pair' if shapes is None else shapes}"
        )
    row, bound = result
    compiled, gradient = _compile_limit(symbols.formula([*row, bound]))
    return RowFunctions(compiled, gradient, parameters, _no_value, parameters, 0)


@lru_cache(maxsize=64)
def _derive(formula: Formula, order: int) -> LieDerivatives:
    (h,) = formula.expressions
    return LieDerivatives.of(h, formula.symbols, order)


@lru_cache(maxsize=64)
def _compile_barrier(
    derivatives: LieDerivatives,
) -> tuple[CompiledFunction, CompiledFunction, CompiledFunction]:
    """Returns `row`, `gradient`, `value` of RowFunctions, for any gains, parameters."""
    symbols = derivatives.symbols
    gains = MakeVectorVariable(derivatives.order, "k")
    decay_rates = MakeVectorVariable(derivatives.order, "lambda")
    entries = derivatives.row(gains)
    state_and_time = [*symbols.model.state, symbols.time]
    arguments = [*state_and_time, *gains, *decay_rates, *symbols.parameters]
    outputs = [*entries, *derivatives.chain(decay_rates)]
    row = _compile(arguments, outputs, "barrier_row")
    gradient = _compile(arguments, _gradient(entries, symbols), "barrier_gradient")
    value = _compile(symbols.variables, derivatives.expressions[:1], "barrier_value")
    return row, gradient, value


def _check_robust(
    formula: Formula,
    decay_rates: Sequence[float],
    early: EarlyDisturbance,
    parameters: Array,
) -> None:
    """Checks that the input enters the last level's derivative first."""
    (h,) = formula.expressions
    rates = as_expressions(decay_rates)
    bound, smoothing = Expression(early.bound), Expression(early.smoothing)
    chain = RobustChain.of(h, formula.symbols, rates, bound, smoothing)
    levels = np.append(chain.levels, drift_rate(chain.levels[-1], formula.symbols))
    check_relative_degree(
        LieDerivatives(formula.symbols, levels), parameters, robust=True
    )


@lru_cache(maxsize=64)
def _compile_robust(
    formula: Formula, order: int
) -> tuple[CompiledFunction, CompiledFunction, CompiledFunction]:
    """Returns `row`, `gradient`, `value`, for any rates, bound and parameters."""
    (h,), symbols = formula.expressions, formula.symbols
    decay_rates = MakeVectorVariable(order, "lambda")
    bound, smoothing = MakeVectorVariable(2, "bound")
    chain = RobustChain.of(h, symbols, decay_rates, bound, smoothing)
    entries = chain.row()
    state_and_time = [*symbols.model.state, symbols.time]
    constants = [*decay_rates, bound, smoothing, *symbols.parameters]
    arguments = [*state_and_time, *constants]
    row = _compile(arguments, [*entries, *chain.levels], "barrier_row")
    gradient = _compile(arguments, _gradient(entries, symbols), "barrier_gradient")
    value = _compile(symbols.variables, [h], "barrier_value")
    return row, gradient, value


@lru_cache(maxsize=64)
def _compile_limit(formula: Formula) -> tuple[CompiledFunction, CompiledFunction]:
    """Returns `row` and `gradient` of RowFunctions."""
    symbols = formula.symbols
    no_disturbance = as_expressions(np.zeros(symbols.model.num_disturbances))
    entries = np.append(formula.expressions, no_disturbance)
    gradient = _gradient(entries, symbols)
    return (
        _compile(symbols.variables, entries, "limit_row"),
        _compile(symbols.variables, gradient, "limit_gradient"),
    )


def _gradient(entries: Expressions, symbols: Symbols) -> list[Expression]:
    """Returns the entries' derivatives by xbar = [x; t], in C order."""
    xbar = np.append(symbols.model.state, symbols.time)
    return list(Jacobian(entries, xbar).flat)


def _compile(
    arguments: list[Variable], outputs: Iterable[Expression], name: str
) -> CompiledFunction:
    try:
        return compile_expressions(arguments, outputs, name)
    except (NotImplementedError, ValueError) as error:
        raise ModelError(f"function(x, t, p) cannot be compiled: {error}") from error


def _no_value(*_: float) -> list[float]:
    return []
