"""The inputs that rows leave which hang on nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.safety import DisturbanceKnowledge, InputSet
from vcbf_drake.safety.qp import FeasibleSet, RowCosts, feasible_set


def normalised(feasible: FeasibleSet) -> tuple[Array, Array]:
    """All rows of a set, those of the input set first, in normalised inputs.

    Args:
        feasible: The set.
    """
    inputs = feasible.input_set
    return (
        np.concatenate([inputs.A_normalised, feasible.normals]),
        np.concatenate([inputs.b_normalised, feasible.distance]),
    )


def fixed_set(
    input_set: InputSet,
    A: Any,
    b: Any,
    penalties: Array | None = None,
    linear_penalties: Array | None = None,
) -> FeasibleSet:
    """The inputs of a set with A u <= b, at any state of one number, undisturbed.

    Args:
        input_set: The inputs that there are.
        A: The rows' coefficients, (n, m).
        b: The rows' right sides, (n,).
        penalties: Of rows that give way, squared, (n,); infinite for the others.
        linear_penalties: The same, of the excess itself.
    """
    A = np.atleast_2d(np.array(A, dtype=float))
    n, m = A.shape
    rows = BarrierRows(
        value=np.ones(n),
        chain=(),
        A=A,
        b=np.array(b, dtype=float),
        w=np.zeros((n, 1)),
        num_states=1,
        gradients=lambda rows: np.zeros((len(rows), m + 2, 2)),
    )
    known = DisturbanceKnowledge.constant(1, 0.0)
    costs = RowCosts.equal(n)
    if penalties is not None:
        costs = replace(costs, penalties=penalties)
    if linear_penalties is not None:
        costs = replace(costs, linear_penalties=linear_penalties)
    return feasible_set(input_set, rows, known, costs)
