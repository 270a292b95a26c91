"""The chain of a barrier: its levels up to the derivative that the input enters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.symbolic import Expression, MakeVectorVariable, Variable

from vcbf_drake.barriers.barrier import is_arithmetic
from vcbf_drake.errors import ModelError
from vcbf_drake.model.agreement import require_agreement, sample_points
from vcbf_drake.model.control_affine import ControlAffineModel, Dynamics
from vcbf_drake.model.formulas import (
    CompiledFunction,
    Expressions,
    compile_nodes,
    explained,
    read,
)
from vcbf_drake.model.graph import (
    ZERO,
    Node,
    Nodes,
    gradients,
    substitute,
    variable,
)
from vcbf_drake.model.multibody_model import MultibodyModel
from vcbf_drake.model.position import PlantSymbols, PointCoordinate

TIME, LEVEL = variable("t"), variable("level")


class Symbols:
    """The arguments x, t and p of a barrier's or limit's function.

    Attributes:
        model: The model, whose state is x.
        parameters: The nodes of p, shape (k,).
    """

    def __init__(self, model: ControlAffineModel, num_parameters: int) -> None:
        """Makes the symbols for a function of the model."""
        self.model = model
        self.parameters = _nodes("p", num_parameters)
        self._time = Variable("t")
        self._parameters = MakeVectorVariable(num_parameters, "p")
        self._outputs = (
            PlantSymbols.of(model.plant, model.state)
            if isinstance(model, MultibodyModel)
            else None
        )

    @property
    def points(self) -> dict[Node, PointCoordinate]:
        """The variables of the MultibodyPlant's points that the function depends on."""
        found = {} if self._outputs is None else self._outputs.points
        return {variable(v.get_name()): output for output, v in found.items()}

    def call(self, function: Callable[..., Any], of_position: int | None = None) -> Any:
        """Returns function(x, t, p) in pydrake's expressions, or in nodes.

        An `arithmetic` function is evaluated in nodes, which share common
        subexpressions where expressions repeat them.

        Args:
            function: The function of a barrier or a limit.
            of_position: The number of coordinates of the position that it takes in
                place of x; None for x.

        Raises:
            ModelError: It raises.
        """
        x: Expressions = as_expressions(self.model.state)
        x = x if self._outputs is None else self._outputs
        p = as_expressions(self._parameters)
        time: Any = Expression(self._time)
        by_indices = of_position is None or not callable(self.model.position)
        if is_arithmetic(function) and by_indices:
            nodes = (self.model.dynamics.x, self.parameters)
            (x, p), time = (np.array(each, dtype=object) for each in nodes), TIME
        if of_position is not None:
            x = self.model.position_of(x, of_position)
        return called(function, x, time, p)

    def read(self, values: Any) -> Nodes:
        """Returns the values of a function as formulas, of the same shape.

        Raises:
            ModelError: A value is not an expression of x, t and p, or has no
                counterpart in plain Python.
        """
        points = {} if self._outputs is None else self._outputs.points
        variables = [*self.model.state, self._time, *self._parameters, *points.values()]
        nodes = [*self.model.dynamics.x, TIME, *self.parameters, *self.points]
        try:
            return read(values, dict(zip(variables, nodes, strict=True)))
        except (TypeError, ValueError):
            raise ModelError(
                "function(x, t, p) must return symbolic expressions or numbers"
            ) from None
        except KeyError as error:
            raise ModelError(
                "function(x, t, p) cannot be compiled: not among its arguments:"
                f" {error.args[0]}"
            ) from None
        except NotImplementedError as error:
            raise ModelError(f"function(x, t, p) cannot be compiled: {error}") from None


def called(function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns a barrier's or limit's function, evaluated with symbols.

    Raises:
        ModelError: It raises.
    """
    try:
        return function(*arguments)
    except (AttributeError, IndexError, RuntimeError, TypeError, ValueError) as error:
        raise ModelError(
            f"function(x, t, p) fails on symbols: {explained(error)}"
        ) from None


def as_expressions(values: Any) -> Expressions:
    """Returns variables and numbers as expressions, shape (k,)."""
    found = [v if isinstance(v, Expression) else Expression(v) for v in values]
    return np.array(found, dtype=object)


def _nodes(prefix: str, size: int) -> tuple[Node, ...]:
    return tuple(variable(f"{prefix}{i}") for i in range(size))


def class_k_formula(function: Callable[[Any], Any] | None) -> Node | None:
    """Returns a barrier's class-K function as a formula of `LEVEL` (E10).

    Raises:
        ModelError: It does not accept symbols, or its values differ with them.
    """
    if function is None:
        return None
    level = Variable("level")
    try:
        written = function(Expression(level))
        node: Node = read(written, {level: LEVEL}).item()
    except Exception as error:  # A user's own code may raise anything.
        raise ModelError(f"class_k fails on symbols: {explained(error)}") from None
    compiled = compile_nodes([LEVEL], [node], "class_k")
    require_agreement(
        lambda point: compiled(*point.tolist()),
        lambda point: [function(point[0])],
        sample_points(1),
        lambda point: f"{point[0]:.6g}",
        ["class_k"],
    )
    return node


class Formula(NamedTuple):
    """The formula that a barrier's chain is derived from; equal for equal barriers.

    Attributes:
        h: The barrier.
        dynamics: The model's.
        parameters: The parameters of h.
        order: The relative degree r.
        robust: Whether the disturbance may enter before the input (E8).
        class_k: The class-K function (E10), a formula of `LEVEL`; None for lambda_r
            phi.
    """

    h: Node
    dynamics: Dynamics
    parameters: tuple[Node, ...]
    order: int
    robust: bool
    class_k: Node | None = None


@contextmanager
def _derived() -> Iterator[None]:
    """Explains, in an error, that a formula has too few derivatives.

    Raises:
        ModelError: A derivative is missing.
    """
    try:
        yield
    except ValueError as error:
        raise ModelError(
            "function(x, t, p) cannot be differentiated as often as needed: write it"
            f" without abs and without the root of a square ({error})"
        ) from None


@dataclass(frozen=True, eq=False)
class Chain:
    """The functions phi^0 = h, ..., phi^(r-1); the input enters the last one's rate.

    Each is the previous one's rate along the extended drift plus lambda times it (E3);
    a robust chain subtracts the worst case of a bounded disturbance (E8). The plain
    chain is the robust one with the bound 0.

    Attributes:
        formula: The formula that it was derived from.
        levels: phi^0, ..., phi^(r-1).
        constants: The numbers that they depend on beside x and t: the decay rates
            lambda_i, the bound and the smoothing of a robust chain, the parameters.
    """

    formula: Formula
    levels: tuple[Node, ...]
    constants: tuple[Node, ...]

    @staticmethod
    @lru_cache(maxsize=64)
    @_derived()
    def of(formula: Formula) -> Chain:
        """Derives the chain.

        Raises:
            ModelError: The barrier has too few derivatives.
        """
        dynamics, robust = formula.dynamics, formula.robust
        rates = _nodes("lambda", formula.order)
        disturbance = (variable("bound"), variable("smoothing")) if robust else ()
        levels = [formula.h]
        for rate in rates[:-1]:
            level = levels[-1]
            worst = ZERO
            if disturbance:
                bound, smoothing = disturbance
                w = [e for e in dynamics.disturbance_rates(level) if e is not ZERO]
                squares = sum((e * e for e in w), start=smoothing * smoothing)
                worst = bound * squares**0.5 if w else ZERO
            levels.append(dynamics.drift_rate(level, TIME) - worst + rate * level)
        constants = (*rates, *disturbance, *formula.parameters)
        return Chain(formula, tuple(levels), constants)

    def row(self) -> Nodes:
        """Returns [A, b, w] of the last level's row (E5), (E9), shape (m + 1 + q,).

        Raises:
            ValueError: The last level has no derivative.
        """
        dynamics, last = self.formula.dynamics, self.levels[-1]
        pull = self.constants[self.formula.order - 1] * last
        if self.formula.class_k is not None:
            (pull,) = substitute([self.formula.class_k], {LEVEL: last})
        A = -dynamics.input_rates(last)
        b = dynamics.drift_rate(last, TIME) + pull
        return np.array([*A, b, *dynamics.disturbance_rates(last)], dtype=object)

    def compiled(
        self, outputs: Any, name: str, variables: Sequence[Node] = ()
    ) -> CompiledFunction:
        """Returns a function of x, t and the constants.

        Args:
            outputs: The outputs of the function.
            name: Its name.
            variables: The variables that replace x.
        """
        x = variables or self.formula.dynamics.x
        return compile_nodes([*x, TIME, *self.constants], outputs, name)

    @cached_property
    @_derived()
    def slopes(self) -> CompiledFunction:
        """A function of x, t and the constants: every level's gradient by x."""
        slopes = gradients(self.levels, self.formula.dynamics.x)
        return self.compiled(slopes.ravel(), "barrier_slopes")

    @cached_property
    def written(self) -> NDArray[np.bool_]:
        """Whether each level's rate contains each channel, shape (r, m + q)."""
        dynamics = self.formula.dynamics
        rates = [
            [*dynamics.input_rates(level), *dynamics.disturbance_rates(level)]
            for level in self.levels
        ]
        return np.array([[rate is not ZERO for rate in row] for row in rates])


class ChainFunctions(NamedTuple):
    """A barrier's chain as functions of plain floats.

    Attributes:
        row: ``row(*x, t, *constants)`` returns [A, b, w], then phi^0, ..., phi^(r-1).
        gradient: ``gradient(*x, t, *constants)`` returns the derivatives of [A, b, w]
            by [x; t], in C order.
        value: ``value(*x, t, *parameters)`` returns [h].
    """

    row: CompiledFunction
    gradient: CompiledFunction
    value: CompiledFunction


@lru_cache(maxsize=64)
@_derived()
def compiled_chain(
    formula: Formula, moving: tuple[Node, ...], of_h: tuple[Node, ...]
) -> ChainFunctions:
    """Returns the functions of a barrier's chain, for any constants.

    Args:
        formula: The barrier's.
        moving: The x of `row` and `gradient`: the state, or the jets of its outputs.
        of_h: The x of `value`.

    Raises:
        ModelError: The barrier has too few derivatives.
    """
    chain = Chain.of(formula)
    entries = chain.row()
    slopes = gradients(entries, [*moving, TIME]).ravel()
    arguments = [*of_h, TIME, *formula.parameters]
    return ChainFunctions(
        chain.compiled([*entries, *chain.levels], "barrier_row", moving),
        chain.compiled(slopes, "barrier_gradient", moving),
        compile_nodes(arguments, [formula.h], "barrier_value"),
    )
