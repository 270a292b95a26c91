"""The hypotheses behind the guarantees, each with its numbers at one start."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import Context

from vcbf_drake.barriers import Barrier
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceObserver, RiseObserver
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.volume import least_threshold

if TYPE_CHECKING:
    from vcbf_drake.safety.safety_filter import SafetyFilter

# The least effect of the inputs on a row, in the unit of its last derivative.
_LEAST_AUTHORITY = 1e-9


@dataclass(frozen=True)
class Assumption:
    """One hypothesis of the lemmas and theorems.

    Attributes:
        name: A short name.
        statement: The condition, in words and symbols.
        holds: Whether it does; None when it is information that no proof needs.
        numbers: The quantities that decide it.
        consequence: The loss when it does not hold, and the remedy.
    """

    name: str
    statement: str
    holds: bool | None
    numbers: dict[str, float] = field(default_factory=dict)
    consequence: str = ""

    @property
    def verdict(self) -> str:
        """Name, verdict and numbers in a few words."""
        verdict = {True: "holds", False: "does not hold", None: "is no condition"}
        numbers = ", ".join(f"{name} = {n:.3g}" for name, n in self.numbers.items())
        words = f"{self.name} {verdict[self.holds]}"
        return f"{words} ({numbers})" if numbers else words


def assumptions(
    safety_filter: SafetyFilter,
    filter_context: Context,
    observer: DisturbanceObserver,
    noise: float = 0.0,
) -> tuple[Assumption, ...]:
    """Returns every hypothesis with its numbers, at the state the context holds.

    Args:
        safety_filter: The filter.
        filter_context: Its context, input ports connected, at the start.
        observer: The observer that feeds it.
        noise: Largest standard deviation of the noise on the disturbed states
            [m/s].
    """
    ports = {
        name: safety_filter.GetOutputPort(name).Eval(filter_context)
        for name in ("levels", "authority", "volume", "backup")
        if safety_filter.HasOutputPort(name)
    }
    xi = safety_filter.threshold(filter_context)
    found = [
        *_standing(safety_filter, observer, noise),
        *start_assumptions(safety_filter, observer, ports, xi),
    ]
    if safety_filter.gate is not None:
        exact = Assumption(
            "exact state",
            "the measured state is the state: plans begin there (Theorem 5)",
            noise == 0.0,
            {"measurement noise": noise},
            "the filter may run out of inputs",
        )
        found.append(exact)
        if safety_filter.barrier_set.obstacles_size:
            declared = Assumption(
                "declared obstacles",
                "no perceived obstacle appears, or changes its velocity (Theorem 5)",
                False,
                consequence="the filter may run out of inputs: a plan follows what is"
                " perceived at its tick",
            )
            found.append(declared)
    return (*found, *_information(safety_filter, filter_context, observer))


def start_assumptions(
    safety_filter: SafetyFilter,
    observer: DisturbanceObserver,
    ports: Mapping[str, Array],
    threshold: float,
) -> Iterator[Assumption]:
    """Yields the hypotheses about the state in which a loop starts, and the gains.

    Args:
        safety_filter: The filter.
        observer: The observer that feeds it.
        ports: The values of its ports ``levels``, ``authority``, ``volume`` and, with
            a gate, ``backup``.
        threshold: xi, which is in the volume.
    """
    if "backup" in ports:
        yield _certified_plan(safety_filter, bool(ports["backup"][1]))
    names, authority = safety_filter.barrier_set.names, ports["authority"]
    ends = np.cumsum(safety_filter.barrier_set.degrees)
    phi = np.split(ports["levels"], ends)[: len(ends)]
    # A slot without an obstacle has no level and says nothing.
    empty = np.array([len(p) > 0 and np.isnan(p).all() for p in phi], dtype=bool)
    empty &= authority == 0.0
    for name, chain, is_empty in zip(names, phi, empty, strict=True):
        if len(chain) > 0 and not is_empty:
            yield _start_inside(name, chain)
    yield _input_authority(names, np.where(empty, np.inf, authority))
    yield _volume_at_start(safety_filter, float(ports["volume"][0]), threshold)
    if safety_filter.method.disturbance == "estimated":
        for condition in observer.gain_conditions():
            yield Assumption(
                f"observer gain: {condition.name}",
                "Lemma 2 (E20) in sampled time",
                condition.holds,
                {"left": condition.left, "right": condition.right},
                "the error bound is the worst case, 2 delta1 (E37): the volume row is"
                " not certified; leave the gains out to have them computed",
            )


def _certified_plan(safety_filter: SafetyFilter, is_certified: bool) -> Assumption:
    return Assumption(
        "certified plan",
        "a backup manoeuvre of the plant, from the start, keeps every hard barrier for"
        " every disturbance within its bound (Theorem 5)",
        is_certified,
        {"delta1": safety_filter.bounds.delta1},
        "the filter may run out of inputs; start slower or farther away or, where"
        " that changes nothing, look at the manoeuvre: its input may be outside the"
        " limits, or no box of its plan free of every barrier",
    )


def _start_inside(name: str, chain: Array) -> Assumption:
    remedy = "start slower or farther away, or take larger gains"
    if not chain[0] >= 0.0:
        remedy = "start outside it"
    return Assumption(
        f"start inside: {name}",
        "phi_k(0) >= 0 for every k (E3), the largest decay rate first (R21)",
        bool(np.all(chain >= 0.0)),
        {f"phi_{k}": float(value) for k, value in enumerate(chain)},
        "Theorem 1 does not apply to this barrier, it may become negative; " + remedy,
    )


def _input_authority(names: tuple[str, ...], authority: Array) -> Assumption:
    weakest = int(np.argmin(authority)) if len(authority) else -1
    least = float(authority[weakest]) if len(authority) else np.inf
    row = f" ({names[weakest]})" if len(authority) else ""
    return Assumption(
        "input authority",
        "every row has an input that moves it: L_g L_f^(r-1) h != 0 (R33)",
        bool(least > _LEAST_AUTHORITY),
        {"least authority": least},
        f"a row that no input moves{row} is infeasible as soon as its right side is"
        " negative; let the input act on a derivative that every state moves, through"
        " integrators for example",
    )


def _volume_at_start(
    safety_filter: SafetyFilter, volume: float, threshold: float
) -> Assumption:
    determinant = volume + threshold
    remedy = f"take a threshold below {determinant:.2g}"
    if not determinant > least_threshold(safety_filter.input_set.num_inputs):
        remedy = "start where the rows leave the inputs some room"
    return Assumption(
        "volume at the start",
        "V_v(0) > 0 (Theorem 2)",
        bool(volume > 0.0) if safety_filter.method.has_volume_row else None,
        {"V_v(0)": volume, "threshold": threshold},
        "the volume row gives way from the first tick on, for the feasible set starts"
        f" smaller than it wants it; {remedy}",
    )


def _standing(
    safety_filter: SafetyFilter, observer: DisturbanceObserver, noise: float
) -> Iterator[Assumption]:
    """The hypotheses that hold at every state or at none."""
    method, applied = safety_filter.method, safety_filter.settings.corrections
    inputs, delta1 = safety_filter.input_set, observer.bounds.delta1
    is_open = np.isinf(inputs.farthest(np.eye(inputs.num_inputs)))
    half_widths = np.where(is_open, np.inf, inputs.scale)[inputs.scale > 0.0]
    is_body = inputs.is_bounded and len(half_widths) > 0
    yield Assumption(
        "bounded input set",
        "U = {u : A_m u <= b_m} is bounded and has an interior, fixed inputs apart",
        True if is_body else False if method.has_volume_row else None,
        {"smallest half-width": float(np.min(half_widths, initial=np.inf))},
        "the largest inscribed ellipsoid (E48) would not exist",
    )
    if method.disturbance == "ignored":
        yield Assumption(
            "no disturbance",
            "d = 0: this method's rows ignore it",
            delta1 == 0.0,
            {"delta1": delta1},
            "a barrier may become negative",
        )
    if safety_filter.backup_rows is not None:
        yield Assumption(
            "rows of the whole way",
            "the rows keep all of the backup law's way, under every disturbance: they"
            " stand at some of its instants, without one, up to a horizon (E68)",
            False,
            consequence="a barrier may become negative between these; infeasible:"
            " backup guarantees that it does not (Theorem 5)",
        )
    if method.disturbance == "estimated":
        if observer.basis == "calibrated":
            yield Assumption(
                "proven error bound",
                "the error bound is proven, not calibrated by simulations (E28)",
                False,
                consequence="an estimate may be off by more than its bound says",
            )
        yield Assumption(
            "known start",
            "the observer starts at the true state: xtil(0) = 0 (R8)",
            noise == 0.0,
            {"measurement noise": noise},
            "the error bound is calibrated, not proven",
        )
        if not applied.error_floor:
            yield Assumption(
                "floor of the error bound",
                "the error bound contains what sampling costs (E28), (R49)",
                False,
                consequence="no sampled observer meets the published bound (E20)",
            )
        if method.has_volume_row and not applied.total_derivative:
            yield Assumption(
                "total derivative of the volume",
                "the volume row counts that the estimate moves (E62), (R30)",
                False,
                consequence="Theorem 2 is false for the published row",
            )
    yield Assumption(
        "disturbance relative degree",
        "no barrier meets the disturbance before the input (R2)",
        True,
        {"barriers": float(safety_filter.barrier_set.size)},
        "h' and phi_1 would be unknown (checked when the filter is built)",
    )


def _information(
    safety_filter: SafetyFilter, context: Context, observer: DisturbanceObserver
) -> Iterator[Assumption]:
    """Conditions of the paper that no proof needs, and the cost of sampling."""
    method, volume = safety_filter.method, safety_filter.settings.volume
    if method.has_volume_row:
        numbers = {
            "widening": volume.widening,
            "gain": volume.gain,
            "threshold": safety_filter.threshold(context),
        }
        yield Assumption("volume barrier", volume.choice, None, numbers, "nothing")
    if method.disturbance == "estimated" and isinstance(observer, RiseObserver):
        decay, delta1 = observer.gains.decay_rate, observer.bounds.delta1
        barriers = safety_filter.barriers
        rates = (b.decay_rates[-1] for b in barriers if isinstance(b, Barrier))
        slowest = float(min(rates, default=np.nan))
        asked = {"lambda_V": decay, "lambda_r": slowest}
        yield _as_printed("lambda_V >= lambda_r", "", 1, asked)
        chains = safety_filter.feasible_set(context).rows.chain
        last_levels = [chain[-1] for chain in chains if len(chain)]
        lowest = float(np.fmin.reduce(last_levels, initial=np.inf))
        condition = "beta_1 > delta1^2 / (2 phi(0)), of the last phi: "
        yield _as_printed("beta_1", condition, 1, _least_weight(1, delta1, lowest))
        if method.has_volume_row:
            start = safety_filter.GetOutputPort("volume").Eval(context)[0]
            condition = "beta_2 > delta1^2 / (2 V_v(0)): "
            yield _as_printed("beta_2", condition, 2, _least_weight(2, delta1, start))
            asked = {"lambda_V": decay, "lambda_Vv": volume.gain}
            yield _as_printed("lambda_V >= lambda_Vv", "", 2, asked)
    yield _sampling(safety_filter, context)


def _as_printed(
    name: str, condition: str, theorem: int, numbers: dict[str, float]
) -> Assumption:
    """A condition of a theorem as printed that its proof does not need."""
    correction = {1: "R21", 2: "R36"}[theorem]
    statement = (
        f"{condition}asked for by Theorem {theorem} as printed; its proof does not need"
        f" it ({correction})"
    )
    return Assumption(name, statement, None, numbers, "nothing")


def _least_weight(index: int, delta1: float, start: float) -> dict[str, float]:
    least = float(delta1**2 / (2.0 * start)) if start > 0.0 else np.inf
    return {f"least beta_{index}": least}


def _sampling(safety_filter: SafetyFilter, context: Context) -> Assumption:
    period = safety_filter.settings.period
    if safety_filter.row_holder is not None:
        x = safety_filter.GetInputPort("state").Eval(context)
        u, model = safety_filter.input_set.center, safety_filter.model
        return Assumption(
            "sampled input",
            "inputs are chosen to keep the rows until the next tick (Theorem 4, E88),"
            " which takes a motion that can be enclosed: T abs(df/dx) below about 1",
            safety_filter.row_holder.can_enclose(x, u),
            {"period": period, "T abs(df/dx)": period * _slope(model, x, u)},
            "between_ticks: certified does nothing there: barriers may dip between"
            " ticks. Take a shorter period",
        )
    return Assumption(
        "sampled input",
        "the theorems are for continuous time, the input is held over a period: a run"
        " says what that can have cost (E87), between_ticks: certified prevents it",
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
