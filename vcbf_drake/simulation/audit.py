"""The audit of a run: its promises, compared with the true states at every tick."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.between_ticks import known_along
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceObserver
from vcbf_drake.safety import Assumption, FilterStatus, InputSet, SafetyFilter
from vcbf_drake.safety.decay import DecayRates
from vcbf_drake.simulation.collision_monitor import TOUCH

# The promises of `audit_margins`, in its order.
PROMISES = {
    "estimate": "|d - dhat| <= error bound (E28)",
    "disturbance term": "Lambda <= w'd in every row (E44)",
    "row": "chi >= 0: the true rows hold under the chosen input",
    "row between ticks": "chi >= 0 until the next tick, by its bound (E88)",
    "barrier": "h >= 0 at the ticks",
    "chain": "phi_1, ..., phi_(r-1) >= 0 at the ticks (E3)",
    "volume": "V_v >= 0 (Theorem 2)",
    "slack": "the volume row never gave way (Theorem 3)",
    "feasible": "some input satisfies the barrier rows",
    "plan": "a certified way to safety follows on every input (Theorem 5)",
    "disturbance": "|d| <= delta1, all that plan knows of it",
    "solver": "every answer was verified",
    "input": "the input is finite and inside its limits",
}
# Conditions of the theorems on a run, in contrast to their promises.
CONDITIONS = ("row between ticks", "slack", "feasible", "solver")
MEASUREMENT = "measurement"
QUADRATURE = "quadrature"
# The conditions of an error bound that a run shows; a certificate needs all.
KNOWLEDGE = ("estimate", MEASUREMENT, QUADRATURE)
BETWEEN_TICKS = "barrier between ticks"
# The conditions and promises of Theorem 5, and its hypotheses, without faults.
FEASIBILITY = ("plan", "disturbance", "barrier", BETWEEN_TICKS, "input")
FEASIBILITY_HYPOTHESES = ("certified plan", "exact state", "declared obstacles")
VOLUME_DECREASE = "volume decrease"
AUTHORITY = "authority"

# The tolerances of a margin that is exactly 0, for rounding, and of one that depends on
# the state, for integration.
ROUNDING = 1e-9
_TOLERANCES = {"barrier": TOUCH, "chain": TOUCH}
# A row that the whole input range moves by less than this is out of reach.
LEAST_AUTHORITY = 1e-6


def audit_margins(
    log: Mapping[str, Array],
    safety_filter: SafetyFilter,
    barriers: BarrierSet,
    bounds: DisturbanceBounds,
) -> Array:
    """Compares the filter's promises with the true states of a simulation.

    Returns the margin of each of `PROMISES` at every tick, shape (T, P): negative where
    it is broken, nan where the method does not promise it. A broken yes-or-no promise
    has the margin -1.

    Args:
        log: The arrays of the log, one row a control tick.
        safety_filter: The filter that is watched.
        barriers: The true barriers, whatever the filter perceives.
        bounds: The declared bounds of the disturbance.
    """
    estimate, bound = known_along(log, safety_filter, bounds.delta1)
    seen = log["obstacles"] if barriers.obstacles_size else None
    rows = barriers.rows_along(log["state"], log["time"], seen)
    status, error = log["status"], log["disturbance"] - estimate
    along, w_norm = _each(rows.w, log["disturbance"]), np.linalg.norm(rows.w, axis=2)
    certified = _each(rows.w, estimate) - w_norm * bound[:, None]
    chi = rows.b + along - _each(rows.A, log["input"])
    chain = _least_of_each(rows.chain[:, :, 1:])
    if safety_filter.backup_rows is not None:
        # It asks nothing of the barriers' own chains.
        chi[:] = chain[:] = np.inf
    if safety_filter.method.feasibility == "decay":
        # The law promises phi' >= -omega lambda phi, for any allowed omega.
        period, watched = safety_filter.settings.period, barriers.barriers
        chi += [DecayRates.at(each, watched, period).room for each in rows.chain]
    volume = slack = lasting = plan = within = np.full(len(status), np.nan)
    if safety_filter.method.has_volume_row:
        volume = _certain(log["volume"])
        slack = log["slack"]
    if safety_filter.certified_hold:
        lasting = _certain(log["least_chi"])
    if safety_filter.gate is not None:
        plan = _yes_or_no(log["backup"][:, 1] > 0.0)
        within = bounds.delta1 - np.linalg.norm(log["disturbance"], axis=1)
        # The rows ask nothing of an input that gave way to a manoeuvre's.
        chi[log["backup"][:, 0] > 0.0] = np.inf
    margins = [
        bound - np.linalg.norm(error, axis=1),
        _least_of_each(along - certified),
        _least_of_each(chi),
        lasting,
        _least_of_each(rows.chain[:, :, 0]),
        chain,
        volume,
        slack,
        _yes_or_no(status != FilterStatus.INFEASIBLE),
        plan,
        within,
        _yes_or_no(status != FilterStatus.FAILED),
        _yes_or_no(_are_inside(log["input"], safety_filter.input_set)),
    ]
    return np.column_stack(margins)


def audit_findings(
    log: Mapping[str, Array],
    path: Mapping[str, Array],
    volume_gain: float,
    observer: DisturbanceObserver | None = None,
) -> dict[str, dict[str, Any]]:
    """Returns the finding of each promise: held or not, worst margin, first violation.

    A finding has ``statement``, ``held`` (None for what no proof promises), ``worst``
    (the least margin), ``worst_at`` and ``first_violation`` [s], None without one, and
    ``violations``, how many samples broke it.

    Args:
        log: The arrays of the log, one row a control tick.
        path: The motion at the integrator's steps: ``time`` (S,) [s], ``least_height``.
        volume_gain: lambda_Vv [1/s].
        observer: The observer of the method; None where it has none.
    """
    times = log["time"]
    found = {
        name: finding(statement, times, margins, _TOLERANCES.get(name, ROUNDING))
        for (name, statement), margins in zip(
            PROMISES.items(), log["audit"].T, strict=True
        )
        if not np.isnan(margins[0])
    }
    if observer is not None:
        found |= _of_measurements(log, observer)
    found[BETWEEN_TICKS] = finding(
        "h >= 0 at every integrator step", path["time"], path["least_height"], TOUCH
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


def _of_measurements(
    log: Mapping[str, Array], observer: DisturbanceObserver
) -> dict[str, dict[str, Any]]:
    """The findings on an error bound that only a run's measurements can show."""
    refused = np.diff(log["refused_intervals"], prepend=0.0)
    largest = log["quadrature_error"]
    distinct, which = np.unique(largest, return_inverse=True)
    spare = [
        min((c.left - c.right for c in observer.gain_conditions(q)), default=np.inf)
        for q in distinct.tolist()
    ]
    return {
        MEASUREMENT: finding(
            "no interval's mean disturbance was refused as impossible (E43)",
            log["time"],
            _yes_or_no(refused <= 0.0),
        ),
        QUADRATURE: finding(
            "the observer's gains allow for the error of the means (E42)",
            log["time"],
            np.array(spare)[which],
        ),
    }


def authority(log: Mapping[str, Array]) -> Array:
    """Returns how far the inputs moved each row; infinite for a slot that is empty."""
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
        assumptions: The hypotheses at the start: for its inputs alone, Theorem 5's.
        findings: The findings of `audit_findings`: for its inputs alone, those of
            `FEASIBILITY`.
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
    """The margin of V_v(t + T) above the least that the row at t allows, per second."""
    elapsed = np.diff(times)
    margin = (volume[1:] - volume[:-1] * np.exp(-gain * elapsed)) / elapsed
    return np.nan_to_num(margin, nan=np.inf)


def finding(
    statement: str, times: Array, margins: Array, tolerance: float = ROUNDING
) -> dict[str, Any]:
    """Returns the finding of one promise from its margins (T,), as `audit_findings`."""
    broken = np.flatnonzero(margins < -tolerance)
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
    return finding(statement, times, margins) | {"held": None}


def _each(rows: Array, vectors: Array) -> Array:
    """Every tick's rows (T, N, k) times its vector (T, k): shape (T, N)."""
    return np.einsum("tnk,tk->tn", rows, vectors)


@np.errstate(invalid="ignore")
def _are_inside(inputs: Array, input_set: InputSet) -> NDArray[np.bool_]:
    v = input_set.normalised(inputs)
    reach = v @ input_set.A_normalised.T
    inside: NDArray[np.bool_] = np.all(
        reach <= input_set.b_normalised + ROUNDING, axis=1
    )
    return inside


def _certain(promised: Array) -> Array:
    """A promised quantity, with -inf where it could not be computed."""
    return np.where(np.isnan(promised), -np.inf, promised)


def _yes_or_no(kept: ArrayLike) -> Array:
    return np.where(kept, 0.0, -1.0)


def _least_of_each(values: Array) -> Array:
    """The least number of every tick, (T,); infinite when there is none."""
    flat = values.reshape(len(values), -1)
    least: Array = np.fmin.reduce(flat, axis=1, initial=np.inf)
    return least
