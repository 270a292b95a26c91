"""Several barriers and limits of one model, evaluated together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cached_property
import math

import numpy as np

from vcbf_drake.barriers.barrier import Barrier, Changes
from vcbf_drake.barriers.functions import require_same_numbers
from vcbf_drake.barriers.limits import EarlyInputLimit, StateInputLimit
from vcbf_drake.barriers.moving import Slot
from vcbf_drake.barriers.rows import (
    BarrierRows,
    RowFunctions,
    RowsAlong,
    barrier_functions,
    early_functions,
    limit_functions,
    no_row,
)
from vcbf_drake.barriers.shapes import Followed
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel
from vcbf_drake.model.formulas import CompiledFunction
from vcbf_drake.typed import typed


class BarrierSet:
    """The N rows of barriers and limits, in the order given.

    A barrier that an input enters before its last derivative has a further row for that
    level, after the rows of all given barriers and limits (E8a).

    Attributes:
        barriers: The given barriers and limits, then the limits of early levels (E8a).
        early: The indices of the rows of early levels.
        names: The N names of the rows; equal names are numbered.
        obstacles_size: The number of numbers that describe the perceived obstacles.
        followed: The names of the barriers that follow a trajectory.
        num_entries: The number of entries [A, b, w] of a row, m + 1 + q.
    """

    @typed
    def __init__(
        self,
        model: ControlAffineModel,
        barriers: Sequence[Barrier | StateInputLimit],
        *,
        by_chains: bool = True,
    ) -> None:
        """Derives and compiles the rows that are not in the cache.

        Args:
            model: The plant.
            barriers: Barriers and limits.
            by_chains: Whether the rows of their chains enforce them.

        Raises:
            ModelError: A barrier's function does not suit the model, or the input or
                the disturbance enters it at another derivative than its gains say, or
                pydrake's expressions differ from it in numbers.
            ValueError: One of them is neither a barrier nor a limit; or perceived
                obstacles of different capacities or dimensions.
        """
        self._model = model
        self._num_states = model.num_states
        self._num_inputs = model.num_inputs
        self.num_entries = model.num_inputs + 1 + model.num_disturbances
        self._functions = [_functions(model, barrier) for barrier in barriers]
        require_same_numbers(model, zip(barriers, self._functions, strict=True))
        early = [
            EarlyInputLimit(barrier, level, i)
            for i, (barrier, functions) in enumerate(
                zip(barriers, self._functions, strict=True)
            )
            if isinstance(barrier, Barrier)
            for level in functions.early_levels
            if by_chains
        ]
        self._functions += [early_functions(model, limit) for limit in early]
        self.early = tuple(range(len(barriers), len(self._functions)))
        self.barriers = (*barriers, *early)
        self.names = _numbered([barrier.name for barrier in self.barriers])
        behind = [getattr(each, "barrier", each) for each in self.barriers]
        self._changing: list[tuple[int, Changes]] = [
            (i, barrier.changes)
            for i, barrier in enumerate(behind)
            if isinstance(barrier, Barrier) and barrier.changes is not None
        ]
        self.followed = tuple(
            self.names[i] for i, each in self._changing if isinstance(each, Followed)
        )
        self.obstacles_size = _obstacles_size([each for _, each in self._changing])
        # Of a row that limits the input itself, 0.
        self.degrees = tuple(each.relative_degree for each in self._functions)
        start = self.num_entries
        self._chains = [
            (i, slice(start, start + r)) for i, r in enumerate(self.degrees)
        ]
        self._width = start + max(self.degrees, default=0) + 1

    @property
    def size(self) -> int:
        """The number N of rows."""
        return len(self._functions)

    def rows(self, x: Array, t: float, obstacles: Array | None = None) -> BarrierRows:
        """Returns every row at one state x (n,) and time t [s].

        A row is nan where its barrier is singular, as at the centre of an obstacle. An
        empty slot's row is 0 u <= 1, its h nan. The obstacles perceived at that time
        have the shape (obstacles_size,).

        Raises:
            ValueError: x or obstacles has another shape.
        """
        point, functions = self._point(x, t), self.functions_at(t, obstacles)
        numbers = np.reshape(self._numbers(point, functions), (self.size, self._width))
        numbers.flags.writeable = False
        A, b, w, levels = self._split(numbers)
        return BarrierRows(
            value=levels[:, 0],
            chain=tuple([numbers[chain] for chain in self._chains]),
            A=A,
            b=b,
            w=w,
            num_states=self._num_states,
            gradients=lambda rows: self._gradients(functions, point, numbers, rows),
            early=self.early,
        )

    def _numbers(
        self, point: list[float], functions: Sequence[RowFunctions]
    ) -> list[list[float]]:
        """The entries [A, b, w] and levels of every row at one point [x; t]."""
        return [
            _evaluate(each.row, (*point, *each.constants), self._width)
            for each in functions
        ]

    def _split(self, numbers: Array) -> tuple[Array, Array, Array, Array]:
        m, e = self._num_inputs, self.num_entries
        return (
            numbers[..., :m],
            numbers[..., m],
            numbers[..., m + 1 : e],
            numbers[..., e:],
        )

    def _gradients(
        self,
        functions: Sequence[RowFunctions],
        point: list[float],
        numbers: Array,
        rows: Sequence[int],
    ) -> Array:
        """The derivatives of some rows' entries at one point [x; t]."""
        shape = len(rows), self.num_entries, self._num_states + 1
        lists = []
        for each in map(functions.__getitem__, rows):
            arguments = (*point, *each.constants)
            lists.append(_evaluate(each.gradient, arguments, shape[1] * shape[2]))
        gradients = np.array(lists, dtype=float).reshape(shape)
        for gradient, row in zip(gradients, rows, strict=True):
            if math.isnan(numbers[row, 0]):
                gradient[:] = np.nan
        gradients.flags.writeable = False
        return gradients

    def values(self, x: Array, t: float, obstacles: Array | None = None) -> Array:
        """Returns every h(x, t), shape (N,); arguments and errors as of `rows`.

        It is nan for a limit, at a singular point and in an empty slot.
        """
        functions = self.functions_at(t, obstacles)
        return np.array(self._values(self._point(x, t), functions), dtype=float)

    def values_along(self, x: Array, t: Array, obstacles: Array | None = None) -> Array:
        """Returns every h along a trajectory of T states (T, n), shape (T, N).

        Raises:
            ValueError: x, t (T,) or obstacles (T, obstacles_size) has another shape.
        """
        found = [self._values(*each) for each in self._along(x, t, obstacles)]
        return np.reshape(np.array(found, dtype=float), (len(t), self.size))

    def rows_along(
        self, x: Array, t: Array, obstacles: Array | None = None
    ) -> RowsAlong:
        """Returns every row along a trajectory; arguments as of `values_along`."""
        found = [self._numbers(*each) for each in self._along(x, t, obstacles)]
        numbers = np.array(found, dtype=float)
        numbers = numbers.reshape(len(t), self.size, self._width)
        A, b, w, levels = self._split(numbers)
        return RowsAlong(levels, A, b, w)

    def _along(
        self, x: Array, t: Array, obstacles: Array | None
    ) -> Iterator[tuple[list[float], list[RowFunctions]]]:
        """Yields the points of a trajectory and all rows' functions there."""
        if np.ndim(t) != 1 or np.shape(x) != (len(t), self._num_states):
            raise ValueError(
                f"expected states of shape (T, {self._num_states}) and T times,"
                f" got shapes {np.shape(x)} and {np.shape(t)}"
            )
        perceived = [None] * len(t) if obstacles is None else obstacles
        for state, time, seen in zip(x, t, perceived, strict=True):
            yield self._point(state, time), self.functions_at(float(time), seen)

    def _point(self, x: Array, t: float) -> list[float]:
        x = np.asarray(x, dtype=float)
        if x.shape != (self._num_states,):
            raise ValueError(
                f"expected a state of shape ({self._num_states},), got {x.shape}"
            )
        return [*x.tolist(), float(t)]

    def _values(
        self, point: list[float], functions: Sequence[RowFunctions]
    ) -> list[float]:
        return [
            _evaluate(each.value, (*point, *each.parameters), 1)[0]
            for each in functions
        ]

    @cached_property
    def _no_row(self) -> RowFunctions:
        return no_row(self._model)

    def functions_at(
        self, t: float, obstacles: Array | None = None
    ) -> list[RowFunctions]:
        """Returns every row's functions, with the perceived obstacles' parameters."""
        if not self._changing:
            return self._functions
        functions = self._functions.copy()
        for i, changes in self._changing:
            parameters = changes.parameters_at(t, obstacles)
            functions[i] = (
                self._no_row
                if parameters is None
                else functions[i].with_parameters(parameters)
            )
        return functions


# pydrake's expressions set the floating-point flag "invalid" in exact arithmetic.
@np.errstate(invalid="ignore")
def _functions(
    model: ControlAffineModel, barrier: Barrier | StateInputLimit
) -> RowFunctions:
    try:
        if isinstance(barrier, Barrier):
            return barrier_functions(model, barrier)
        return limit_functions(model, barrier)
    except ModelError as error:
        kind = "barrier" if isinstance(barrier, Barrier) else "limit"
        raise ModelError(f"{kind} '{barrier.name}': {error}") from None


def _numbered(names: Sequence[str]) -> tuple[str, ...]:
    """The names, numbered where they occur more than once."""
    many, seen = Counter(names), Counter[str]()
    numbered = []
    for name in names:
        seen[name] += 1
        numbered.append(f"{name} {seen[name]}" if many[name] > 1 else name)
    return tuple(numbered)


def _obstacles_size(changes: Sequence[Changes]) -> int:
    ports = {
        (each.spheres.size, each.spheres.dimensions)
        for each in changes
        if isinstance(each, Slot)
    }
    if len(ports) > 1:
        raise ValueError(
            "perceived obstacles come by one port: their capacity and dimensions must"
            " be the same in every PerceivedSpheres"
        )
    return max(ports, default=(0, 0))[0]


def _evaluate(
    function: CompiledFunction, arguments: tuple[float, ...], size: int
) -> list[float]:
    """Returns the function's numbers, filled up with nan; all nan where singular."""
    try:
        numbers = function(*arguments)
    except (ArithmeticError, ValueError):
        numbers = []
    return numbers + [math.nan] * (size - len(numbers))
