"""FilterSettings: the choices behind a safety filter; its methods and errata."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Literal, get_args

import numpy as np

from vcbf_drake.checks import finite_array, require, require_choice
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearDisturbanceObserver,
    ObserverSettings,
    RiseObserver,
)
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.decay import DEFAULT_PENALTY, DecayRates
from vcbf_drake.safety.decision import InfeasiblePolicy
from vcbf_drake.safety.programs import DEFAULT_SOLVER, check_solver
from vcbf_drake.safety.qp import FeasibleSet, RowCosts
from vcbf_drake.safety.volume import VolumeBarrier
from vcbf_drake.typed import (
    Checked,
    NotNegative,
    Positive,
    PositiveOrInfinite,
    check_fields,
)

DisturbanceHandling = Literal["ignored", "worst_case", "estimated"]
Feasibility = Literal["none", "volume", "decay", "backup"]
ObserverKind = Literal["rise", "linear"]


@dataclass(frozen=True)
class Method:
    """A method: its treatment of the disturbance and of its own feasibility.

    Attributes:
        disturbance: Every row either ignores the disturbance, takes its worst case
            within ``|d| <= delta1``, or uses the observer's estimate and error bound.
        feasibility: The means against an empty feasible set: none, the volume barrier's
            row in the QP, decay rates that are variables of it, or rows along the way
            of a backup law in place of the barriers' own.
        observer: The kind of observer; a method that does not estimate only logs it.
        source: The source of the method.
    """

    disturbance: DisturbanceHandling
    feasibility: Feasibility
    observer: ObserverKind
    source: str

    @property
    def has_volume_row(self) -> bool:
        """Whether the volume barrier's row is in the QP."""
        return self.feasibility == "volume"


METHODS: dict[str, Method] = {
    "cbf-qp": Method("ignored", "none", "rise", "Tan et al. 2021 (E6)"),
    "robust-cbf-qp": Method("worst_case", "none", "rise", "Emam et al. 2019 (B2)"),
    "wang-xu-dob-cbf-qp": Method("estimated", "none", "linear", "Wang & Xu 2023 (B4)"),
    "vcbf-qp": Method("ignored", "volume", "rise", "Parwana et al. 2023 (E52)"),
    "dob-cbf-qp": Method("estimated", "none", "rise", "the paper (E47)"),
    "dob-vcbf-qp": Method("estimated", "volume", "rise", "the paper (E54)"),
    "optimal-decay": Method("estimated", "decay", "rise", "Zeng et al. 2021 (E69)"),
    "backup": Method("estimated", "backup", "rise", "Chen et al. 2021 (E68)"),
}

Fidelity = Literal["corrected", "paper"]


@dataclass
class Corrections(Checked):
    """The errata of the published method, each on or off.

    Attributes:
        exact_slack: Relaxation of the volume row only where it conflicts with the
            barrier rows (E55); off, with the printed penalty M delta^2 (E54, the
            DOB-VCBF-QP).
        total_derivative: The volume row with the total derivative, which includes the
            rate of the estimate (E62); off, with the printed derivative (E53, the
            printed volume term).
        error_floor: The certified error bound of sampled time (E28) with the hold
            margin; off, the printed bound (E20), which tends to 0.
    """

    exact_slack: bool = False
    total_derivative: bool = False
    error_floor: bool = False


FIDELITIES: dict[Fidelity, Corrections] = {
    "corrected": Corrections(True, True, True),
    "paper": Corrections(),
}

BetweenTicks = Literal["none", "certified"]
BETWEEN_TICKS: tuple[BetweenTicks, ...] = get_args(BetweenTicks)


@dataclass
class FilterSettings:
    """The settings of a safety filter; the defaults suit a user's own diagram.

    A `Scenario` is one of these with a plant and a task: its YAML keys are these
    fields, and `AddSafetyFilter` takes it in their place.

    Attributes:
        period: Control period [s].
        method: The safety filter, one of `METHODS`.
        fidelity: "corrected", or "paper" for the equations as published, or the errata
            to correct.
        infeasible: The policy for infeasible ticks: "least_violation" applies the input
            that violates the barrier rows least, "hold" keeps the last input, "stop"
            ends the simulation, "decay" lets barriers decay faster than their gains
            allow, by the least possible amount (E69), and "backup" keeps a certified
            backup manoeuvre of the plant at every tick (Theorem 5).
        volume: The volume barrier, for the methods that have one.
        decay_penalty: Penalty of a decay rate's growth, (omega - 1)^2, in the cost
            beside the squared distance to the reference (E69), with optimal-decay or
            infeasible: decay.
        backup_margin: Distance that the flow of the backup law keeps from every
            barrier, in units of the position, with method backup (E68, a backup
            barrier's row).
        between_ticks: "none" enforces the rows at the ticks only, "certified" also
            until the next tick (E88), where some input permits it.
        violation_weights: Weight of the violation of each barrier at infeasible ticks,
            (N,); empty for 1 each.
        input_weights: W of the cost (u - u_ref)'W (u - u_ref): its diagonal, (m,), or
            the matrix, (m, m); empty for the norm of the normalised inputs. 1 each
            gives the published |u - u_ref|^2 in the inputs' own units.
        soft_penalties: Penalty of the squared slack of each soft barrier row, (N,):
            infinity for the hard ones; empty if all are hard. A control Lyapunov
            function V beside barriers is the barrier h = -V with a penalty.
        soft_linear_penalties: Penalty of the slack itself of each soft row, added to
            that of its square, (N,); 0 for none. An exact penalty: a row whose penalty
            exceeds its multiplier holds wherever the other rows allow it.
        observer: The disturbance observer.
        solver: Drake's solver that proposes solutions of the QP and, if it supports
            cone programs, of the largest ellipsoid: one of `SOLVERS`.
        warn: Whether the log reports hypotheses that fail at the start, and the first
            infeasible tick.

    Raises:
        InvalidValueError: A field is outside what is allowed; one line says which.
    """

    period: Positive = 0.02
    method: str = "dob-vcbf-qp"
    fidelity: Fidelity | Corrections = "corrected"
    infeasible: InfeasiblePolicy = "least_violation"
    volume: VolumeBarrier = field(default_factory=VolumeBarrier)
    decay_penalty: Positive = DEFAULT_PENALTY
    backup_margin: NotNegative = 0.05
    between_ticks: BetweenTicks = "none"
    violation_weights: list[Positive] = field(default_factory=list)
    input_weights: list[float] | list[list[float]] = field(default_factory=list)
    soft_penalties: list[PositiveOrInfinite] = field(default_factory=list)
    soft_linear_penalties: list[NotNegative] = field(default_factory=list)
    observer: ObserverSettings = field(default_factory=ObserverSettings)
    solver: str = DEFAULT_SOLVER
    warn: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        check_solver(self.solver)
        require_choice("method", self.method, METHODS)
        rule = "positive numbers, one an input, or the rows of a matrix of them"
        dimensions = np.ndim(self.input_weights[:1])  # A matrix may be ragged.
        finite_array(self.input_weights, "input_weights", dimensions, rule)
        penalties = self.soft_penalties
        linear = self.soft_linear_penalties
        is_soft = len(linear) in (0, len(penalties)) and all(
            math.isfinite(square) or not each
            for each, square in zip(linear, penalties, strict=False)
        )
        require(
            is_soft,
            "soft_linear_penalties",
            linear,
            "one a barrier, 0 where soft_penalties has infinity",
        )
        require(
            self.observer.period <= self.period,
            ("observer", "period"),
            self.observer.period,
            f"at most the control period, {self.period:g} s",
        )
        chosen, is_certified = METHODS[self.method], self.between_ticks == "certified"
        is_printed = not self.corrections.error_floor
        require(
            not (is_certified and is_printed and chosen.disturbance == "estimated"),
            "between_ticks",
            self.between_ticks,
            "none without the correction error_floor, for the printed error bound does"
            " not hold between ticks",
        )
        is_backup = chosen.feasibility == "backup"
        require(
            not (is_backup and self.infeasible == "decay"),
            "infeasible",
            self.infeasible,
            f"backup or another with {self.method}, whose rows have no decay rates",
        )
        require(
            not (is_backup and (self.violation_weights or self.soft_penalties)),
            "method",
            self.method,
            "another with violation_weights or soft_penalties",
        )
        require(
            not (is_certified and chosen.feasibility in ("decay", "backup")),
            "between_ticks",
            self.between_ticks,
            f"none with {self.method}, whose rows are certified at the ticks alone",
        )

    def row_costs(self, count: int) -> RowCosts:
        """Returns the costs of violated barrier rows.

        Args:
            count: N.

        Raises:
            InvalidValueError: A setting has not one number per barrier.
        """
        settings = {
            "violation_weights": 1.0,
            "soft_penalties": np.inf,
            "soft_linear_penalties": 0.0,
        }
        numbers = []
        for name, default in settings.items():
            given = getattr(self, name) or [default] * count
            rule = f"{count} number{'s' * (count != 1)}, one a barrier"
            require(len(given) == count, name, given, rule)
            numbers.append(np.array(given, dtype=float))
        return RowCosts(*numbers)

    def decay_rates(
        self, feasible: FeasibleSet, barriers: Sequence[object]
    ) -> DecayRates | None:
        """Returns the decay rates that may grow at a tick; None where they may not."""
        always = METHODS[self.method].feasibility == "decay"
        if not (always or self.infeasible == "decay"):
            return None
        penalty, chain = self.decay_penalty, feasible.rows.chain
        return DecayRates.at(chain, barriers, self.period, penalty, not always)

    @property
    def corrections(self) -> Corrections:
        """The errata of the published method that the filter applies."""
        if isinstance(self.fidelity, Corrections):
            return self.fidelity
        return FIDELITIES[self.fidelity]

    def make_observer(
        self,
        model: ControlAffineModel,
        bounds: DisturbanceBounds,
        *,
        noise: float = 0.0,
        period: float | None = None,
        longest_interval: float | None = None,
    ) -> DisturbanceObserver:
        """Returns the method's observer.

        Args:
            model: The plant's.
            bounds: The bounds of the disturbance.
            noise: Standard deviation of the measured disturbed channels [m/s].
            period: Time between measurements [s]; the observer's own by default.
            longest_interval: See `DisturbanceObserver`.

        Raises:
            ModelError: Two disturbances act on the state in the same way.
            ValueError: The gains fail a condition that the error bound rests on.
        """
        chosen = self.observer
        period = period or chosen.period or self.period
        if METHODS[self.method].observer == "linear":
            return LinearDisturbanceObserver(
                model,
                period,
                bounds,
                chosen.linear_rate,
                noise=noise,
                longest_interval=longest_interval,
            )
        return RiseObserver(
            model,
            period,
            bounds,
            chosen,
            noise=noise,
            floor=self.corrections.error_floor,
            longest_interval=longest_interval,
        )
