"""The inputs that a filter could choose from at one tick, and its choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.safety.polytope import emptiness_certificate
from vcbf_drake.viz.runs import Run

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import InputLimits


@dataclass(frozen=True)
class FeasibleSet:
    """The feasible set ``{u : A u <= b}`` of one tick, and the choice from it.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        limits: How many leading rows are the input set's.
        low: The least inputs to show, shape (m,): the limits where they are finite.
        high: The greatest inputs to show, shape (m,).
        shape: The inscribed ellipsoid's matrix, shape (m, m); nan when there is none.
        center: Its centre, shape (m,).
        reference: The reference input, shape (m,).
        input: The chosen input, shape (m,).
        corners: The corners of the set between low and high, shape (k, m).
        volume: The volume barrier V_v; nan when the filter did not know it.
        decay: By how much barriers decay faster than A and b say (E69); 1: they do not.
    """

    A: Array
    b: Array
    limits: int
    low: Array
    high: Array
    shape: Array
    center: Array
    reference: Array
    input: Array
    corners: Array
    volume: float
    decay: float

    @property
    def empty(self) -> bool:
        """Whether there is nothing to choose from."""
        return len(self.corners) == 0

    @property
    def has_choice(self) -> bool:
        """Whether an input satisfies the rows, at faster decay rates perhaps."""
        return not self.empty or self.decay > 1.0

    @property
    def conflict(self) -> list[int]:
        """The rows that exclude each other when the set is empty."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        certificate = emptiness_certificate(self.A * half, self.b - self.A @ middle)
        return [] if certificate is None else [int(row) for row in certificate.rows]


def feasible_set_at(run: Run, time: float) -> FeasibleSet:
    """The feasible set at the last tick that is not after a time [s]."""
    tick = max(int(np.searchsorted(run.time, time + 1e-9)) - 1, 0)
    return feasible_set_of_tick(run.result.log, run.result.scenario.input_set, tick)


def moment(runs: Sequence[Run], time: float) -> str:
    """A time for a title, with the run of which it is the last feasible tick."""
    last = [run for run in runs if _is_last_feasible(run, time)]
    words = f"$t$ = {time:.2f} s"
    return f"{words}, the last feasible\ntick of {last[0].label}" if last else words


def _is_last_feasible(run: Run, time: float) -> bool:
    failed_at = run.result.summary["infeasible_at"]
    if failed_at is None:
        return False
    before = run.time[run.time < failed_at - 1e-9]
    return len(before) > 0 and abs(before[-1] - time) < 1e-9


def feasible_set_of_tick(
    log: Mapping[str, Array], limits: InputLimits, tick: int
) -> FeasibleSet:
    """The feasible set of a log's tick, counted from 0."""
    A, b = log["polytope_A"][tick], log["polytope_b"][tick]
    # At an obstacle's very centre its row is not finite; an infinite limit is none.
    finite = np.isfinite(A).all(axis=1) & np.isfinite(b)
    low, high = shown_inputs(log, limits)
    return FeasibleSet(
        A=A[finite],
        b=b[finite],
        limits=int(finite[: 2 * len(limits.lower) + len(limits.b)].sum()),
        low=low,
        high=high,
        shape=log["ellipsoid_shape"][tick],
        center=log["ellipsoid_center"][tick],
        reference=log["reference"][tick],
        input=log["input"][tick],
        corners=polytope_vertices(A[finite], b[finite], low, high),
        volume=float(log["volume"][tick]),
        decay=float(log["decay"][tick]) if "decay" in log else 1.0,
    )


def in_plane(one: FeasibleSet) -> FeasibleSet:
    """A set of a single input as a band in the plane, for the eye; others as it is."""
    if one.A.shape[1] != 1:
        return one
    band = [[u, v] for (u,) in one.corners.tolist() for v in (-0.5, 0.5)]
    return replace(
        one,
        A=np.pad(one.A, ((0, 0), (0, 1))),
        low=np.append(one.low, -1.0),
        high=np.append(one.high, 1.0),
        shape=np.diag([one.shape[0, 0], 0.5]),
        center=np.append(one.center, 0.0),
        reference=np.append(one.reference, 0.0),
        input=np.append(one.input, 0.0),
        corners=np.array(band).reshape(-1, 2),
    )


def shadow(shape: Array) -> Array:
    """The shadow of ``{B v : |v| <= 1}`` on the plane of two inputs, of a flat one too.

    Args:
        shape: B, shape (m, m), m >= 2.

    Returns:
        L with L L' = (B B')[:2, :2], lower triangular, its diagonal not negative.
    """
    triangle: Array = np.linalg.qr(shape[:2].T)[1].T
    return triangle * np.where(np.diag(triangle) < 0.0, -1.0, 1.0)


def shown_inputs(log: Mapping[str, Array], limits: InputLimits) -> tuple[Array, Array]:
    """The least and the greatest inputs to show, shape (m,) each.

    They are the input's limits; where these are infinite, what the run asked for and
    got, with as much again on either side.
    """
    low, high = np.array(limits.lower, float), np.array(limits.upper, float)
    seen = np.vstack([log["reference"], log["input"]])
    least, most = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    room = np.maximum(most - least, 1e-3 + 0.1 * np.abs(most))
    return (
        np.where(np.isfinite(low), low, least - room),
        np.where(np.isfinite(high), high, most + room),
    )


def telling_times(runs: Sequence[Run]) -> list[float]:
    """Two seconds, the tick before the first infeasible one, and that tick [s].

    Where every run stays feasible: two seconds, the middle, and three quarters.
    """
    failures = [
        event.time for run in runs for event in run.events if event.kind == "infeasible"
    ]
    if not failures:
        end = min(float(run.time[-1]) for run in runs)
        return [min(2.0, 0.25 * end), 0.5 * end, 0.75 * end]
    first = min(failures)
    period = float(runs[-1].result.scenario.period)
    return sorted({min(2.0, 0.5 * first), first - period, first})


def polytope_vertices(A: Array, b: Array, low: Array, high: Array) -> Array:
    """The corners of ``{u : A u <= b, low <= u <= high}``, found by Drake's Qhull.

    Rows that no point of the box violates are dropped first: among a thousand
    obstacles a few cut.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        low: The box's least corner, shape (m,), finite.
        high: Its greatest corner, shape (m,), finite.

    Returns:
        Shape (k, m), no corner twice; k is 0 when the set is empty.
    """
    # Importing Drake takes time that a table in a terminal need not spend.
    from pydrake.geometry.optimization import HPolyhedron, VPolytope

    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    scale = np.where(half > 0.0, half, 1.0)  # A fixed input has no width.
    rows, sides, box = A * scale, b - A @ middle, half / scale
    cuts = sides < np.abs(rows) @ box
    size = np.linalg.norm(rows, axis=1)
    if np.any(sides[cuts & (size == 0.0)] < 0.0):
        return np.empty((0, len(low)))
    cuts &= size > 0.0
    axes = np.eye(len(low))
    rows = np.vstack([axes, -axes, rows[cuts] / size[cuts, None]])
    sides = np.concatenate([box, box, sides[cuts] / size[cuts]])
    corners = VPolytope(HPolyhedron(rows, sides)).vertices().T
    return np.asarray(middle + scale * corners)
