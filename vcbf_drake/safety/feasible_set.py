"""The inputs a QP may choose from: input limits and robust barrier rows together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.safety.certified_ellipsoid import symmetric
from vcbf_drake.safety.input_set import InputSet


@dataclass(frozen=True)
class DisturbanceKnowledge:
    """What is known of the disturbance d at one time: ``|d - estimate| <= bound``.

    Attributes:
        estimate: The estimate, shape (q,) [m/s^2].
        rate: The part of its time derivative that does not depend on the unknown
            error, shape (q,) [m/s^3].
        bound: The bound on the error's norm [m/s^2].
        bound_rate: The bound's time derivative [m/s^3].
        gain: How strongly the unknown error drives the estimate [1/s]:
            d(estimate)/dt = rate + gain (d - estimate).
    """

    estimate: Array
    rate: Array
    bound: float
    bound_rate: float
    gain: float

    @staticmethod
    def of(
        estimate: DisturbanceEstimate, margin: float, gain: float
    ) -> DisturbanceKnowledge:
        """Returns what an observer's estimate says while an input is held.

        Args:
            estimate: At the tick.
            margin: What the error can grow by until the next one [m/s^2].
            gain: The observer's `estimate_gain` [1/s].
        """
        return DisturbanceKnowledge(
            estimate.disturbance,
            estimate.rate,
            float(estimate.error_bound) + margin,
            float(estimate.error_bound_rate),
            gain,
        )

    @staticmethod
    def constant(num_disturbances: int, bound: float) -> DisturbanceKnowledge:
        """Returns what is known without an observer: a fixed ball around zero."""
        zero = np.zeros(num_disturbances)
        return DisturbanceKnowledge(zero, zero, bound, 0.0, 0.0)


@dataclass(frozen=True)
class FeasibleSet:
    """The polytope ``{u : A u <= b}`` of (E46), with the barrier rows it came from.

    The first rows are the input set's, then follows one row per barrier. The same set
    in normalised inputs v, u = center + scale * v, is ``{v : A_v v <= b_v}``.

    Attributes:
        A_v: The rows in normalised inputs, shape (k + N, m).
        b_v: Their right-hand sides, the disturbance's margin included, shape (k + N,).
        rows: The barrier rows.
        bound: The right-hand side of each with its margin, b + Lambda, shape (N,).
        known: What they take as known of the disturbance.
        weights: How much a violation of each barrier row counts, shape (N,).
        input_set: What limits the input whatever the state.
        penalties: For soft barrier rows the penalty of their squared slack, else
            infinity, shape (N,). The set takes no notice of soft rows: on their right
            there is infinity.
        linear_penalties: For soft rows the penalty of the slack itself, shape (N,).
        cutting: Indices of the rows that can matter: the input set's limits, and the
            barrier rows that cut its bounding box. The others hold for every input.
    """

    A_v: Array
    b_v: Array
    rows: BarrierRows
    bound: Array
    known: DisturbanceKnowledge
    weights: Array
    input_set: InputSet
    penalties: Array
    linear_penalties: Array
    cutting: NDArray[np.intp]

    @property
    def A(self) -> Array:
        """The rows, shape (k + N, m)."""
        return np.concatenate([self.input_set.A, self.rows.A])

    @property
    def b(self) -> Array:
        """Their right-hand sides, shape (k + N,)."""
        b = np.where(np.isinf(self.penalties), self.bound, np.inf)
        return np.concatenate([self.input_set.b, b])

    @property
    def num_input_rows(self) -> int:
        """The number k of rows that limit the input whatever the state."""
        return len(self.input_set.b)

    def tightened(self, reserve: Array) -> FeasibleSet:
        """Returns the inputs of this set that leave every barrier row a reserve (E88).

        Args:
            reserve: Shape (N,), not negative.
        """
        k = self.num_input_rows
        b_v = self.b_v.copy()
        b_v[k:] -= reserve
        cutting = cutting_rows(self.input_set, self.A_v, b_v)
        return replace(self, b_v=b_v, bound=self.bound - reserve, cutting=cutting)

    @cached_property
    def is_finite(self) -> bool:
        """Whether every number in the rows is finite."""
        return bool(np.isfinite(self.A_v).all() and np.isfinite(self.bound).all())

    def cutting_barriers(self, widening: float = 1.0) -> NDArray[np.intp]:
        """Returns the barrier rows that cut the bounding box, taken so many times."""
        k, bounds = self.num_input_rows, self.b_v
        cutting = self.cutting
        if widening != 1.0:
            bounds = np.concatenate([bounds[:k], bounds[k:] / widening])
            cutting = cutting_rows(self.input_set, self.A_v, bounds)
        return cutting[len(self.input_set.limits) :] - k

    def soft_slack(self, row: int, u: Array) -> float:
        """Returns how far a soft barrier row has to give way at an input; else > 0."""
        return float(self.bound[row]) - float(self.rows.A[row] @ u)

    @cached_property
    def soft(self) -> NDArray[np.intp]:
        """Indices of the soft barrier rows, among the barriers'."""
        return np.isfinite(self.penalties).nonzero()[0]


def disturbance_margin(rows: BarrierRows, known: DisturbanceKnowledge) -> Array:
    """Returns Lambda, the certified lower bound of w'd per row (E44), shape (N,)."""
    w_norm = np.sqrt(np.vecdot(rows.w, rows.w))
    return rows.w @ known.estimate - w_norm * known.bound


def feasible_set(
    input_set: InputSet,
    rows: BarrierRows,
    known: DisturbanceKnowledge,
    weights: Array | None = None,
    penalties: Array | None = None,
    linear_penalties: Array | None = None,
) -> FeasibleSet:
    """Returns the feasible set of (E46): A u <= b + Delta b.

    Args:
        input_set: The inputs the actuators can produce.
        rows: The barriers' rows at one state and time.
        known: What is known of the disturbance there.
        weights: How much a violation of each barrier row counts, shape (N,); ones by
            default.
        penalties: Of soft rows, and infinity for the others, shape (N,); by default no
            row is soft.
        linear_penalties: Of soft rows, beside them, shape (N,); zeros by default.
    """
    bound = rows.b + disturbance_margin(rows, known)
    distance = bound - rows.A @ input_set.center
    if penalties is None:
        penalties = np.full(len(bound), np.inf)
    if linear_penalties is None:
        linear_penalties = np.zeros(len(bound))
    distance[np.isfinite(penalties)] = np.inf
    A_v = np.concatenate([input_set.A_normalised, rows.A * input_set.scale])
    b_v = np.concatenate([input_set.b_normalised, distance])
    return FeasibleSet(
        A_v=A_v,
        b_v=b_v,
        rows=rows,
        bound=bound,
        known=known,
        weights=np.ones(len(rows.b)) if weights is None else weights,
        input_set=input_set,
        penalties=penalties,
        linear_penalties=linear_penalties,
        cutting=cutting_rows(input_set, A_v, b_v),
    )


def cutting_rows(input_set: InputSet, A_v: Array, b_v: Array) -> NDArray[np.intp]:
    """Returns the rows that can matter; see `FeasibleSet.cutting`.

    Args:
        input_set: The input set, whose rows are the first.
        A_v: All rows in normalised inputs, shape (n, m).
        b_v: Their right-hand sides, shape (n,).
    """
    k = len(input_set.b)
    cut = (b_v[k:] < input_set.farthest(A_v[k:])).nonzero()[0]
    return np.concatenate([input_set.limits, k + cut])


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


def pack_feasible_set(A: Array, b: Array, frame: Array, center: Array) -> Array:
    """Returns a feasible set and an ellipsoid {frame v + center} as one vector.

    The frame need not be symmetric; `unpack_feasible_set` makes it so, of a whole log
    at once.
    """
    return np.concatenate([A.ravel(), b, frame.ravel(), center])


def unpack_feasible_set(
    packed: Array, num_rows: int, num_inputs: int
) -> PackedFeasibleSet:
    """Takes apart one value, or an array of values, of the ``feasible_set`` port.

    Args:
        packed: Shape (..., size of the port).
        num_rows: Rows of the set.
        num_inputs: m.
    """
    rows, m, lead = num_rows, num_inputs, packed.shape[:-1]
    A, b, frame, center = np.split(packed, np.cumsum([rows * m, rows, m * m]), axis=-1)
    shape = symmetric(frame.reshape(*lead, m, m))
    return PackedFeasibleSet(A.reshape(*lead, rows, m), b, shape, center)
