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
            input_set: What the actuators can do.
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
        center, scale = self._input_set.center, self._input_set.scale
        num_limits, anywhere = len(self._input_set.b), np.zeros(len(center))
        try:
            nearest_point(A * scale, b - A @ center, anywhere, num_limits)
        except EmptySetError as error:
            return tuple(self[row] for row in error.conflict)
        except SolverError:
            pass  # Neither could be verified: whoever asks for names goes on.
        return ()
