"""Derivatives of barrier rows, one array for A, b and w each."""

from typing import NamedTuple

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array


class RowGradients(NamedTuple):
    """The derivatives of N rows by xbar = [x; t].

    Attributes:
        A: Shape (N, m, n + 1).
        b: Shape (N, n + 1).
        w: Shape (N, q, n + 1).
    """

    A: Array
    b: Array
    w: Array


def row_gradients(rows: BarrierRows) -> RowGradients:
    """Returns the derivatives of all rows."""
    num_inputs, found = rows.A.shape[1], rows.gradients(range(len(rows.b)))
    return RowGradients(
        found[:, :num_inputs], found[:, num_inputs], found[:, num_inputs + 1 :]
    )
