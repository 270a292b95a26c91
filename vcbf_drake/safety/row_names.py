"""RowNames: the rows of a filter's feasible set by name, and those in conflict."""

from __future__ import annotations

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.projection import nearest_point


class RowNames(tuple[str, ...]):
    """The name of every row: the input's limits, then the barriers."""

    _input_set: InputSet

    @staticmethod
    def of(input_set: InputSet, barriers: tuple[str, ...]) -> RowNames:
        """Returns the names.

        Args:
            input_set: The inputs that the actuators can deliver.
            barriers: The barriers' names.
        """
        m, sides = input_set.num_inputs, ("upper", "lower")
        limits = [f"input limit {i}" for i in range(len(input_set.b))]
        if input_set.is_box:
            limits = [f"{side} limit of input {j}" for side in sides for j in range(m)]
        names = RowNames((*limits, *barriers))
        names._input_set = input_set
        return names

    def in_conflict(self, A: Array, b: Array) -> tuple[str, ...]:
        """Returns the names of rows that exclude each other; none where none surely do.

        Args:
            A: The rows of a feasible set, shape (rows, m).
            b: Their right-hand sides, shape (rows,).
        """
        scale, num_limits = self._input_set.scale, len(self._input_set.b)
        limiting = np.isfinite(b).nonzero()[0]
        # Beside a very large limit, rows are negligible: the size rescales them.
        for origin, size in (
            (self._input_set.center, 1.0),
            _place_and_size(self._input_set, A[num_limits:], b[num_limits:]),
        ):
            try:
                nearest_point(
                    A[limiting] * scale,
                    (b - A @ origin)[limiting] / size,
                    np.zeros(len(origin)),
                    int(np.sum(limiting < num_limits)),
                )
            except EmptySetError as error:
                return tuple(self[limiting[row]] for row in error.conflict)
            except SolverError:
                pass  # Neither could be verified: no row is named.
        return ()


def _place_and_size(input_set: InputSet, A: Array, b: Array) -> tuple[Array, float]:
    """The input nearest to 0, and how far from it barrier rows are at least."""
    origin = input_set.project(np.zeros(input_set.num_inputs))
    length = np.linalg.norm(A * input_set.scale, axis=1)
    distance = np.abs(b - A @ origin)
    matters = (length > 0.0) & (distance > 0.0) & np.isfinite(distance)
    sizes = distance[matters] / length[matters]
    return origin, float(np.min(sizes, initial=1.0))
