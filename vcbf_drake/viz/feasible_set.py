"""The inputs that a filter could choose from at one tick, and what it chose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.safety.emptiness import emptiness_certificate
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.vertices import polytope_vertices


@dataclass(frozen=True)
class FeasibleSet:
    """What a filter may choose at one tick, and what it chose.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        limits: How many leading rows are the input set's.
        low: The least inputs, shape (m,).
        high: The greatest inputs, shape (m,).
        shape: The inscribed ellipsoid's matrix, shape (m, m); nan when there is none.
        center: Its centre, shape (m,).
        reference: The reference input, shape (m,).
        input: The chosen input, shape (m,).
        corners: The polytope's corners, shape (k, m).
        volume: The volume barrier V_v; nan when the filter did not know it.
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

    @property
    def empty(self) -> bool:
        """Whether there is nothing to choose from."""
        return len(self.corners) == 0

    @property
    def conflict(self) -> list[int]:
        """The rows that exclude each other when the set is empty."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        certificate = emptiness_certificate(self.A * half, self.b - self.A @ middle)
        return [] if certificate is None else [int(row) for row in certificate.rows]


def feasible_set_at(run: Run, time: float) -> FeasibleSet:
    """The feasible set at the last tick that is not after a time [s]."""
    log, limits = run.result.log, run.result.scenario.input_set
    tick = max(int(np.searchsorted(run.time, time + 1e-9)) - 1, 0)
    A, b = log["polytope_A"][tick], log["polytope_b"][tick]
    # At an obstacle's very centre its row is not finite.
    finite = np.isfinite(A).all(axis=1) & np.isfinite(b)
    A, b = A[finite], b[finite]
    return FeasibleSet(
        A=A,
        b=b,
        limits=2 * len(limits.lower) + len(limits.b),
        low=np.array(limits.lower),
        high=np.array(limits.upper),
        shape=log["ellipsoid_shape"][tick],
        center=log["ellipsoid_center"][tick],
        reference=log["reference"][tick],
        input=log["input"][tick],
        corners=polytope_vertices(A, b),
        volume=float(log["volume"][tick]),
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
