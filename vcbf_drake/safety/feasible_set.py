"""The inputs a QP may choose from: input limits and robust barrier rows together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.safety.ellipsoid import symmetric
from vcbf_drake.safety.input_set import InputSet


class DisturbanceKnowledge(NamedTuple):
    """The knowledge of the disturbance d at one time: ``|d - estimate| <= bound``.

    Attributes:
        estimate: The estimate, shape (q,) [m/s^2].
        rate: The part of its time derivative that does not depend on the unknown
            error, shape (q,) [m/s^3].
        bound: The bound on the error's norm [m/s^2].
        bound_rate: The bound's time derivative [m/s^3].
        gain: The gain from the unknown error to the estimate's rate [1/s]:
            d(estimate)/dt = rate + gain (d - estimate).
    """

    estimate: Array
    rate: Array
    bound: float
    bound_rate: float
    gain: float

    @staticmethod
    def constant(num_disturbances: int, bound: float) -> DisturbanceKnowledge:
        """Returns the knowledge without an observer: a fixed ball around zero."""
        zero = np.zeros(num_disturbances)
        return DisturbanceKnowledge(zero, zero, bound, 0.0, 0.0)


@dataclass(frozen=True)
class RowCosts:
    """The costs of violated barrier rows.

    Attributes:
        weights: The weight of each violation where not all rows can hold, shape (N,).
        penalties: For soft rows the penalty of their squared slack, else infinity,
            shape (N,).
        linear_penalties: For soft rows the penalty of the slack itself, shape (N,).
    """

    weights: Array
    penalties: Array
    linear_penalties: Array

    @staticmethod
    def equal(num_rows: int) -> RowCosts:
        """Returns the costs of hard rows that count alike.

        Args:
            num_rows: N.
        """
        ones = np.ones(num_rows)
        return RowCosts(ones, np.full(num_rows, np.inf), 0.0 * ones)

    @cached_property
    def soft(self) -> list[int]:
        """Indices of the soft rows."""
        return np.flatnonzero(np.isfinite(self.penalties)).tolist()


class FeasibleSet(NamedTuple):
    """The polytope ``{u : A u <= b}`` of (E46), with the barrier rows it came from.

    The first rows are the input set's, then follows one row per barrier.

    Attributes:
        input_set: The input limits, for every state.
        rows: The barrier rows.
        bound: The right-hand side of each with its margin, b + Lambda, shape (N,).
        known: The knowledge of the disturbance in the rows.
        costs: The costs of violated rows.
        normals: The barrier rows in normalised inputs v, u = center + scale v, (N, m).
        distance: Their right-hand sides, shape (N,). The set takes no notice of soft
            rows: there is infinity.
        farthest: Their most on the inputs' bounding box, shape (N,).
        cut: Indices of those that cut it; the others hold for every input.
        is_finite: Whether every number in the rows is finite.
    """

    input_set: InputSet
    rows: BarrierRows
    bound: Array
    known: DisturbanceKnowledge
    costs: RowCosts
    normals: Array
    distance: Array
    farthest: Array
    cut: NDArray[np.intp]
    is_finite: bool

    @property
    def A(self) -> Array:
        """The rows, shape (k + N, m)."""
        return np.concatenate([self.input_set.A, self.rows.A])

    @property
    def b(self) -> Array:
        """Their right-hand sides, shape (k + N,)."""
        b = np.where(np.isinf(self.costs.penalties), self.bound, np.inf)
        return np.concatenate([self.input_set.b, b])

    @property
    def num_input_rows(self) -> int:
        """The number k of rows that limit the input whatever the state."""
        return len(self.input_set.b)

    @property
    def cutting(self) -> NDArray[np.intp]:
        """Indices of the rows that matter: the limits, and barrier rows that cut."""
        return np.concatenate([self.input_set.limits, self.num_input_rows + self.cut])

    def tightened(self, reserve: Array) -> FeasibleSet:
        """Returns the subset that leaves every barrier row a reserve (E88).

        Args:
            reserve: Shape (N,), not negative.
        """
        return _of_bound(
            self.input_set, self.rows, self.bound - reserve, self.known, self.costs
        )

    def cut_by(self, widening: float) -> tuple[NDArray[np.intp], Array, Array]:
        """Returns the barrier rows that cut the bounding box, taken so many times.

        Their indices, and the rows in v / widening: normals (k, m), distances (k,).
        """
        cut, distance = self.cut, self.distance
        if widening != 1.0:
            distance = distance / widening
            cut = (distance < self.farthest).nonzero()[0]
        return cut, self.normals[cut], distance[cut]


def disturbance_margin(rows: BarrierRows, known: DisturbanceKnowledge) -> Array:
    """Returns Lambda, the certified lower bound of w'd per row (E44), shape (N,)."""
    w_norm = np.sqrt(np.vecdot(rows.w, rows.w))
    return rows.w @ known.estimate - w_norm * known.bound


def feasible_set(
    input_set: InputSet,
    rows: BarrierRows,
    known: DisturbanceKnowledge,
    costs: RowCosts | None = None,
) -> FeasibleSet:
    """Returns the feasible set of (E46): A u <= b + Delta b.

    Args:
        input_set: The inputs the actuators can produce.
        rows: The barriers' rows at one state and time.
        known: The knowledge of the disturbance there.
        costs: The costs of violated rows; by default all are hard.
    """
    bound = rows.b + disturbance_margin(rows, known)
    return _of_bound(input_set, rows, bound, known, costs or RowCosts.equal(len(bound)))


def _of_bound(
    input_set: InputSet,
    rows: BarrierRows,
    bound: Array,
    known: DisturbanceKnowledge,
    costs: RowCosts,
) -> FeasibleSet:
    normals = rows.A * input_set.scale
    distance = bound - rows.A @ input_set.center
    if costs.soft:
        distance[costs.soft] = np.inf
    farthest = input_set.farthest(normals)
    # Sums, for what is not finite stays so in them.
    total = float(np.add.reduce(normals, axis=None) + np.add.reduce(bound))
    return FeasibleSet(
        input_set=input_set,
        rows=rows,
        bound=bound,
        known=known,
        costs=costs,
        normals=normals,
        distance=distance,
        farthest=farthest,
        cut=(distance < farthest).nonzero()[0],
        is_finite=math.isfinite(total),
    )


class PackedFeasibleSet(NamedTuple):
    """The ``feasible_set`` port's value, taken apart; leading axes are kept.

    Attributes:
        A: Rows in physical inputs, (..., rows, m).
        b: Right-hand sides, (..., rows).
        shape: The largest ellipsoid's symmetric B, (..., m, m); nan when empty.
        center: Its center, (..., m); nan when empty.
    """

    A: Array
    b: Array
    shape: Array
    center: Array


def unpack_feasible_set(packed: Array, num_inputs: int) -> PackedFeasibleSet:
    """Takes apart one value, or an array of values, of the ``feasible_set`` port.

    A value is A, b, F with F F' = B^2, and the center, one after the other.

    Args:
        packed: Shape (..., size of the port).
        num_inputs: m.
    """
    *lead, size = packed.shape
    m, rows = num_inputs, size // (num_inputs + 1) - num_inputs
    A, b, frame, center = np.split(packed, np.cumsum([rows * m, rows, m * m]), axis=-1)
    shape = symmetric(frame.reshape(*lead, m, m))
    return PackedFeasibleSet(A.reshape(*lead, rows, m), b, shape, center)
