"""Functions that a user writes: as formulas, and compared with these in numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.symbolic import Expression, MakeVectorVariable, Variable

from vcbf_drake.barriers.barrier import Barrier, is_arithmetic
from vcbf_drake.barriers.chain import LEVEL, TIME, nodes
from vcbf_drake.barriers.limits import StateInputLimit
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.agreement import (
    FEW_SCALES,
    MANY_SCALES,
    require_agreement,
    sample_points,
)
from vcbf_drake.model.control_affine import ControlAffineModel
from vcbf_drake.model.formulas import Expressions, compile_nodes, explained, read
from vcbf_drake.model.graph import Node, Nodes, variable
from vcbf_drake.model.multibody_model import MultibodyModel
from vcbf_drake.model.position import PlantSymbols, PointCoordinate

if TYPE_CHECKING:
    from vcbf_drake.barriers.rows import RowFunctions

_FAILURES = AttributeError, IndexError, RuntimeError, TypeError, ValueError


class Symbols:
    """The arguments x, t and p of a barrier's or limit's function.

    Attributes:
        parameters: The nodes of p, shape (k,).
    """

    def __init__(self, model: ControlAffineModel, num_parameters: int) -> None:
        self._model, self._time = model, Variable("t")
        self._p = MakeVectorVariable(num_parameters, "p")
        self.parameters = nodes("p", num_parameters)
        self._x = as_expressions(model.state)
        if isinstance(model, MultibodyModel):
            self._x = PlantSymbols.of(model.plant, model.state)

    @property
    def points(self) -> dict[Node, PointCoordinate]:
        """The variables of the MultibodyPlant's points that the function depends on."""
        found = getattr(self._x, "points", {})
        return {variable(v.get_name()): point for point, v in found.items()}

    def call(self, function: Callable[..., Any], of_position: int | None = None) -> Any:
        """Returns function(x, t, p) in pydrake's expressions, or in nodes.

        An `arithmetic` function is evaluated in nodes. With `of_position` it takes that
        many coordinates of the position in place of x.
        """
        x, time, p = self._x, Expression(self._time), as_expressions(self._p)
        by_indices = of_position is None or not callable(self._model.position)
        if is_arithmetic(function) and by_indices:
            x = np.array(self._model.dynamics.x, dtype=object)
            p, time = np.array(self.parameters, dtype=object), TIME
        if of_position is not None:
            x = self._model.position_of(x, of_position)
        try:
            return function(x, time, p)
        except _FAILURES as error:
            raise ModelError(
                f"function(x, t, p) fails on symbols: {explained(error)}"
            ) from None

    def read(self, values: Any) -> Nodes:
        """Returns the values of a function as formulas, of the same shape.

        Raises:
            ModelError: A value is not an expression of x, t and p, or has no
                counterpart in plain Python.
        """
        known = dict(zip(self._model.state, self._model.dynamics.x, strict=True))
        known |= zip(self._p, self.parameters, strict=True)
        known[self._time] = TIME
        points = getattr(self._x, "points", {}).values()
        known |= {v: variable(v.get_name()) for v in points}
        try:
            return read(values, known)
        except (TypeError, ValueError):
            raise ModelError(
                "function(x, t, p) must return symbolic expressions or numbers"
            ) from None
        except (KeyError, NotImplementedError) as error:
            problem = f"function(x, t, p) cannot be compiled: {error.args[0]}"
            raise ModelError(problem) from None


def as_expressions(values: Any) -> Expressions:
    """Returns variables and numbers as expressions, shape (k,)."""
    found = [v if isinstance(v, Expression) else Expression(v) for v in values]
    return np.array(found, dtype=object)


def class_k_formula(function: Callable[[Any], Any] | None) -> Node | None:
    """Returns a barrier's class-K function as a formula of `LEVEL` (E10)."""
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


def require_same_numbers(
    model: ControlAffineModel,
    compiled: Iterable[tuple[Barrier | StateInputLimit, RowFunctions]],
) -> None:
    """Requires that compiled barriers have the values of their functions."""
    formulas, vectors = set(), set()
    for barrier, functions in compiled:
        # Closures of one code may differ in their cells, so each is looked at.
        code = getattr(barrier.function, "__code__", type(barrier.function))
        formula = functions.value, functions.row, code
        vector = functions.row, *formula, barrier.function, functions.parameters
        if vector not in vectors:
            # A formula at many points once, with other parameters at a few.
            scales = FEW_SCALES if formula in formulas else MANY_SCALES
            _compare(model, barrier, functions, scales)
        formulas.add(formula)
        vectors.add(vector)


def _compare(
    model: ControlAffineModel,
    barrier: Barrier | StateInputLimit,
    functions: RowFunctions,
    scales: Sequence[float],
) -> None:
    is_barrier = isinstance(barrier, Barrier)
    compiled = functions.value if is_barrier else functions.row
    size = 1 if is_barrier else model.num_inputs + 1
    parameters = functions.parameters

    def derived(point: Array) -> list[float]:
        *x, t = point.tolist()
        return compiled(*x, abs(t), *parameters)[:size]

    def written(point: Array) -> list[Any]:
        x: Any = point[:-1]
        if isinstance(barrier, Barrier) and barrier.of_position is not None:
            x = model.position_of(x, barrier.of_position)
        return _written(barrier, x, abs(point[-1]))

    def describe(point: Array) -> str:
        x = ", ".join(f"{value:.6g}" for value in point[:-1])
        return f"x = [{x}], t = {abs(point[-1]):.6g}"

    kind = "barrier" if is_barrier else "limit"
    points = sample_points(model.num_states + 1, parameters, scales)
    name = f"{kind} '{barrier.name}': function(x, t, p)"
    require_agreement(derived, written, points, describe, [name])


def _written(barrier: Barrier | StateInputLimit, x: Array, t: float) -> list[Any]:
    """The values of ``function(x, t, p)`` itself: h, or a limit's row and bound."""
    function, p = barrier.function, barrier.parameters
    try:
        values = function(np.array(x), np.float64(t), np.array(p))
    except (AttributeError, TypeError, RuntimeError):
        # The function takes expressions only; without variables they are numbers.
        values = function(as_expressions(x), Expression(t), as_expressions(p))
    if isinstance(barrier, Barrier):
        return [np.asarray(values, dtype=object).item()]
    row, bound = values
    return [*row, bound]
