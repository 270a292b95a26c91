"""What a run promises, watched at every tick and judged at the end."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import math
from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.errors import Array
from vcbf_drake.safety import (
    Assumption,
    DisturbanceKnowledge,
    FilterStatus,
    SafetyFilter,
    disturbance_margin,
)

# What each element of the port `margins` is the margin of, in their order.
PROMISES = {
    "estimate": "|d - dhat| <= error bound (E39)",
    "disturbance term": "Lambda <= w'd in every row (E16)",
    "row": "chi >= 0: the true rows hold under the chosen input",
    "barrier": "h >= 0 at the ticks",
    "chain": "phi_1, ..., phi_(r-1) >= 0 at the ticks (E3)",
    "volume": "V_v >= 0 (Theorem 2)",
    "slack": "the volume row never gave way (Theorem 3)",
    "feasible": "some input satisfies the barrier rows",
    "solver": "every answer was verified",
    "input": "the input is finite and inside its limits",
}
# What the theorems ask of a run rather than promise of it.
CONDITIONS = ("slack", "feasible", "solver")
BETWEEN_TICKS = "barrier between ticks"
VOLUME_DECREASE = "volume decrease"
AUTHORITY = "authority"

# What rounding may take from a margin that is exactly 0.
_ROUNDING = 1e-9
# A row that the whole input range moves by less than this is out of reach.
LEAST_AUTHORITY = 1e-6


class Audit(LeafSystem):
    """Watches, with the truth that only a simulation knows, what the filter promises.

    .. pydrake_system::

        name: Audit
        input_ports:
        - state
        - disturbance
        - disturbance_estimate (optional)
        - error_bound (optional)
        - input
        - volume
        - slack
        - status
        output_ports:
        - margins

    | port | size | what |
    | --- | --- | --- |
    | ``state`` | n | the true state |
    | ``disturbance`` | q | the true disturbance [m/s^2] |
    | ``margins`` | | of each of `PROMISES`: negative where it is broken, nan where |
    | | | the method does not promise it |

    The other ports are the filter's and the observer's; a method without an observer
    has none of its ports. A broken yes-or-no promise has the margin -1. The system is
    pure, and costs nothing where nobody asks for its output.
    """

    def __init__(
        self,
        safety_filter: SafetyFilter,
        barriers: BarrierSet,
        bounds: DisturbanceBounds,
    ) -> None:
        """Declares the ports.

        Args:
            safety_filter: The filter that is watched.
            barriers: What is truly there, whatever the filter perceives.
            bounds: What is declared of the disturbance.
        """
        super().__init__()
        self._barriers = barriers
        self._input_set = safety_filter.input_set
        self._method = method = safety_filter.method
        model = safety_filter.model
        q = model.num_disturbances
        bound = bounds.delta1 if method.disturbance == "worst_case" else 0.0
        self._without_observer = DisturbanceKnowledge.constant(q, bound)
        sizes = {
            "state": model.num_states,
            "disturbance": q,
            "input": model.num_inputs,
            "volume": 1,
            "slack": 1,
            "status": 1,
        }
        if method.disturbance == "estimated":
            sizes |= {"disturbance_estimate": q, "error_bound": 1}
        self._ports: dict[str, InputPort] = {
            name: self.DeclareVectorInputPort(name, size)
            for name, size in sizes.items()
        }
        self.DeclareVectorOutputPort("margins", len(PROMISES), self._calc_margins)

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the input ports."""
        return tuple(self._ports)

    def _calc_margins(self, context: Context, output: BasicVector) -> None:
        seen = {name: port.Eval(context) for name, port in self._ports.items()}
        known, d, u = self._known(seen), seen["disturbance"], seen["input"]
        rows = self._barriers.rows(seen["state"], context.get_time())
        status, along = seen["status"][0], rows.w @ d
        volume = slack = math.nan
        if self._method.volume:
            volume, slack = seen["volume"][0], seen["slack"][0]
            # Promised, but it could not be found.
            volume = -math.inf if math.isnan(volume) else volume
        output.SetFromVector(
            [
                known.bound - float(np.linalg.norm(d - known.estimate)),
                _least(along - disturbance_margin(rows, known)),
                _least(rows.b + along - rows.A @ u),
                _least(rows.value),
                _least([phi for chain in rows.chain for phi in chain[1:].tolist()]),
                volume,
                slack,
                _yes_or_no(status != FilterStatus.INFEASIBLE),
                _yes_or_no(status != FilterStatus.FAILED),
                _yes_or_no(self._input_set.contains(u)),
            ]
        )

    def _known(self, seen: Mapping[str, Array]) -> DisturbanceKnowledge:
        if "error_bound" not in seen:
            return self._without_observer
        estimate, bound = seen["disturbance_estimate"], float(seen["error_bound"][0])
        return DisturbanceKnowledge(estimate, np.zeros_like(estimate), bound, 0.0, 0.0)


def audit_findings(
    log: Mapping[str, Array], path_time: Array, heights: Array, volume_gain: float
) -> dict[str, dict[str, Any]]:
    """Returns each watched promise: held or not, worst margin, when it first broke.

    A finding has ``statement``, ``held`` (None for what no proof promises), ``worst``
    (the least margin), ``worst_at`` and ``first_violation`` [s], None without one, and
    ``violations``, how many samples broke it.

    Args:
        log: The arrays of the log, one row a control tick.
        path_time: Times of the integrator's steps, shape (S,) [s].
        heights: Every h there, shape (S, N).
        volume_gain: lambda_Vv [1/s].
    """
    times = log["time"]
    found = {
        name: _finding(statement, times, margins)
        for (name, statement), margins in zip(
            PROMISES.items(), log["audit"].T, strict=True
        )
        if not np.isnan(margins[0])
    }
    found[BETWEEN_TICKS] = _finding(
        "h >= 0 at every integrator step", path_time, _least_of_each(heights)
    )
    if "volume" in found and len(times) > 1:
        found[VOLUME_DECREASE] = _information(
            "(V_v(t + T) - V_v(t) exp(-lambda_Vv T)) / T [1/s]: Theorem 2 up to O(T)",
            times[:-1],
            _decrease_margin(times, log["volume"], volume_gain),
        )
    found[AUTHORITY] = _information(
        "every row has an input that moves it (R33)",
        times,
        _least_of_each(authority(log)) - LEAST_AUTHORITY,
    )
    return found


def authority(log: Mapping[str, Array]) -> Array:
    """Returns how far the inputs moved each row, infinite for a slot without obstacle.

    Args:
        log: The arrays of the log, one row a control tick.
    """
    moved = log["authority"]
    is_empty = (moved == 0.0) & np.isnan(log["barriers"])
    return np.where(is_empty, np.inf, moved)


def reasons_against(
    assumptions: Iterable[Assumption],
    findings: Mapping[str, Mapping[str, Any]],
    collided: bool,
) -> list[str]:
    """Returns why a run is not guaranteed; empty when it is.

    Args:
        assumptions: The hypotheses at the start.
        findings: What `audit_findings` returns.
        collided: Whether the run ended in a collision.
    """
    hypotheses = [
        f"hypothesis: {each.name}" for each in assumptions if each.holds is False
    ]
    broken = [
        f"audit: {name}" for name, each in findings.items() if each["held"] is False
    ]
    return hypotheses + broken + ["collision"] * collided


def _decrease_margin(times: Array, volume: Array, gain: float) -> Array:
    """By how much V_v(t + T) exceeds what the row at t lets it fall to, per second."""
    elapsed = np.diff(times)
    margin = (volume[1:] - volume[:-1] * np.exp(-gain * elapsed)) / elapsed
    return np.nan_to_num(margin, nan=np.inf)


def _finding(statement: str, times: Array, margins: Array) -> dict[str, Any]:
    broken = np.flatnonzero(margins < -_ROUNDING)
    worst = int(np.argmin(margins))
    return {
        "statement": statement,
        "held": len(broken) == 0,
        "worst": float(margins[worst]) if np.isfinite(margins[worst]) else None,
        "worst_at": float(times[worst]),
        "first_violation": float(times[broken[0]]) if len(broken) else None,
        "violations": len(broken),
    }


def _information(statement: str, times: Array, margins: Array) -> dict[str, Any]:
    return _finding(statement, times, margins) | {"held": None}


def _yes_or_no(kept: bool) -> float:
    return 0.0 if kept else -1.0


def _least(values: Array | Sequence[float]) -> float:
    """The least number; infinite when there is none."""
    return float(np.fmin.reduce(np.asarray(values, dtype=float), initial=np.inf))


def _least_of_each(values: Array) -> Array:
    """The least number of every row; infinite when there is none."""
    least: Array = np.fmin.reduce(values, axis=1, initial=np.inf)
    return least
