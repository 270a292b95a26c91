"""The hypotheses behind the guarantees, each with its numbers at one start."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from vcbf_drake.barriers import Barrier, BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceObserver, RiseObserver
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.polytope import recession_direction
from vcbf_drake.safety.safety_filter import SafetyFilter


@dataclass(frozen=True)
class Assumption:
    """One hypothesis of the lemmas and theorems.

    Attributes:
        name: A short name.
        statement: What has to hold, in words and symbols.
        holds: Whether it does; None when it is information that no proof needs.
        numbers: The quantities that decide it.
        consequence: What is lost when it does not hold.
    """

    name: str
    statement: str
    holds: bool | None
    numbers: dict[str, float] = field(default_factory=dict)
    consequence: str = ""


def assumptions(
    safety_filter: SafetyFilter,
    filter_context: Context,
    observer: DisturbanceObserver,
    period: float,
    noise: float = 0.0,
) -> tuple[Assumption, ...]:
    """Returns every hypothesis with its numbers, at the state the context holds.

    Args:
        safety_filter: The filter.
        filter_context: Its context, input ports connected, at the start.
        observer: The observer that feeds it.
        period: The control period [s].
        noise: Largest standard deviation of the noise on the disturbed states
            [m/s].
    """
    method = safety_filter.method
    found: list[Assumption] = [_bounded_inputs(safety_filter)]
    if method.disturbance == "ignored":
        found.append(_no_disturbance(observer))
    if method.disturbance == "estimated":
        found.extend(_observer_conditions(observer))
        found.append(_known_start(noise))
    found.extend(_equations_as_proven(safety_filter))
    found.append(_disturbance_relative_degree(safety_filter))
    found.extend(_barriers_at_start(safety_filter, filter_context))
    found.append(_authority_at_start(safety_filter, filter_context))
    found.append(_volume_at_start(safety_filter, filter_context))
    if method.disturbance == "estimated" and isinstance(observer, RiseObserver):
        found.extend(_rate_orders(safety_filter, observer))
    found.append(_sampling(safety_filter, filter_context, period))
    return tuple(found)


def _bounded_inputs(safety_filter: SafetyFilter) -> Assumption:
    inputs = safety_filter.input_set
    return Assumption(
        "bounded input set",
        "U = {u : A_m u <= b_m} is bounded and has an interior",
        recession_direction(inputs.A) is None and bool(np.all(inputs.scale > 0.0)),
        {"smallest half-width": float(inputs.scale.min())},
        "the largest inscribed ellipsoid (E20) would not exist",
    )


def _no_disturbance(observer: DisturbanceObserver) -> Assumption:
    delta1 = observer.bounds.delta1
    return Assumption(
        "no disturbance",
        "d = 0: this method's rows ignore it",
        delta1 == 0.0,
        {"delta1": delta1},
        "a barrier may become negative",
    )


def _observer_conditions(observer: DisturbanceObserver) -> Iterator[Assumption]:
    for condition in observer.gain_conditions():
        yield Assumption(
            f"observer gain: {condition.name}",
            "Lemma 2 (E13) in sampled time",
            condition.holds,
            {"left": condition.left, "right": condition.right},
            "the error bound is the worst case, 2 delta1 (E94): the volume row is not"
            " certified",
        )
    if observer.basis == "calibrated":
        yield Assumption(
            "proven error bound",
            "the error bound is proven, not calibrated by simulations (E39)",
            False,
            consequence="an estimate may be off by more than its bound says",
        )


def _known_start(noise: float) -> Assumption:
    return Assumption(
        "known start",
        "the observer starts at the true state: xtil(0) = 0 (R8)",
        noise == 0.0,
        {"measurement noise": noise},
        "the error bound is calibrated, not proven",
    )


def _equations_as_proven(safety_filter: SafetyFilter) -> Iterator[Assumption]:
    """What the published equations leave out and a proof needs."""
    method, applied = safety_filter.method, safety_filter.settings.corrections
    if method.disturbance != "estimated":
        return
    if not applied.error_floor:
        yield Assumption(
            "floor of the error bound",
            "the error bound contains what sampling costs (E39), (R49)",
            False,
            consequence="no sampled observer meets the published bound (E13)",
        )
    if method.volume and not applied.total_derivative:
        yield Assumption(
            "total derivative of the volume",
            "the volume row counts that the estimate moves (E28), (R30)",
            False,
            consequence="Theorem 2 is false for the published row",
        )


def _disturbance_relative_degree(safety_filter: SafetyFilter) -> Assumption:
    return Assumption(
        "disturbance relative degree",
        "no barrier meets the disturbance before the input (R2)",
        True,
        {"barriers": float(safety_filter.barrier_set.size)},
        "h' and phi_1 would be unknown (checked when the filter is built)",
    )


def _barriers_at_start(
    safety_filter: SafetyFilter, context: Context
) -> Iterator[Assumption]:
    rows, names = (
        safety_filter.feasible_set(context).rows,
        safety_filter.barrier_set.names,
    )
    for name, chain, is_empty in zip(names, rows.chain, _are_empty(rows), strict=True):
        if len(chain) == 0 or is_empty:
            continue
        yield Assumption(
            f"start inside: {name}",
            "phi_k(0) >= 0 for every k (E3), the largest decay rate first (R21)",
            bool(np.all(chain >= 0.0)),
            {f"phi_{k}": float(value) for k, value in enumerate(chain)},
            "Theorem 1 does not apply to this barrier: it may become negative",
        )


def _authority_at_start(safety_filter: SafetyFilter, context: Context) -> Assumption:
    rows = safety_filter.feasible_set(context).rows
    authority = np.linalg.norm(rows.A * safety_filter.input_set.scale, axis=1)
    least = float(authority[~_are_empty(rows)].min(initial=np.inf))
    return Assumption(
        "input authority",
        "every row has an input that moves it: L_g L_f^(r-1) h != 0 (R33)",
        least > 1e-9,
        {"least authority": least},
        "a row without authority is infeasible as soon as its right side is negative",
    )


def _are_empty(rows: BarrierRows) -> NDArray[np.bool_]:
    """Which rows are those of slots without an obstacle: no value, and no condition."""
    says_nothing = ~rows.A.any(axis=1) & (rows.b >= 0.0)
    has_levels = np.array([len(chain) > 0 for chain in rows.chain], dtype=bool)
    return np.isnan(rows.value) & says_nothing & has_levels


def _volume_at_start(safety_filter: SafetyFilter, context: Context) -> Assumption:
    v = safety_filter.volume(context)
    value = np.nan if v is None else v.value
    holds = bool(value > 0.0)
    return Assumption(
        "volume at the start",
        "V_v(0) > 0 (Theorem 2)",
        holds if safety_filter.method.volume else None,
        {"V_v(0)": value, "threshold": safety_filter.settings.volume.threshold},
        "the feasible set starts smaller than the volume barrier wants it",
    )


def _rate_orders(
    safety_filter: SafetyFilter, observer: RiseObserver
) -> Iterator[Assumption]:
    decay = observer.decay_rate
    slowest = min(
        (b.decay_rates[-1] for b in safety_filter.barriers if isinstance(b, Barrier)),
        default=np.nan,
    )
    yield Assumption(
        "lambda_V >= lambda_r",
        "asked for by Theorem 1 as printed; its proof does not need it (R21)",
        None,
        {"lambda_V": decay, "lambda_r": float(slowest)},
        "nothing",
    )
    if safety_filter.method.volume:
        yield Assumption(
            "lambda_V >= lambda_Vv",
            "asked for by Theorem 2 as printed; its proof does not need it (R36)",
            None,
            {"lambda_V": decay, "lambda_Vv": safety_filter.settings.volume.gain},
            "nothing",
        )


def _sampling(
    safety_filter: SafetyFilter, context: Context, period: float
) -> Assumption:
    if safety_filter.held_rows is not None:
        x = safety_filter.GetInputPort("state").Eval(context)
        u, model = safety_filter.input_set.center, safety_filter.model
        is_enclosed = safety_filter.held_rows.can_enclose(x, u)
        return Assumption(
            "sampled input",
            "inputs are chosen to keep the rows until the next tick (Theorem 4, E77),"
            " which takes a motion that can be enclosed: T abs(df/dx) below about 1",
            is_enclosed and safety_filter.certified_hold >= period,
            {"period": period, "T abs(df/dx)": period * _slope(model, x, u)},
            "between_ticks: certified does nothing there: barriers may dip between"
            " ticks. Take a shorter period",
        )
    return Assumption(
        "sampled input",
        "the theorems are for continuous time, the input is held over a period: a run"
        " says what that can have cost (E76), between_ticks: certified prevents it",
        None,
        {"period": period},
        "barriers may dip between ticks by an amount of the order of the period",
    )


def _slope(model: ControlAffineModel, x: Array, u: Array) -> float:
    """Returns the spectral radius of abs(df/dx): 1 / T is where boxes grow for ever."""
    steps = 1e-6 * (1.0 + np.abs(x))
    rate = model.nominal_rate(x, u)
    columns = [
        (model.nominal_rate(x + step * unit, u) - rate) / step
        for step, unit in zip(steps.tolist(), np.eye(len(x)), strict=True)
    ]
    return float(np.max(np.abs(np.linalg.eigvals(np.abs(columns)))))
