"""FilterSettings: the choices behind a safety filter, in one dataclass."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from vcbf_drake.checks import check_parameter, require, require_choice
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearDisturbanceObserver,
    RiseGains,
    RiseObserver,
)
from vcbf_drake.disturbances.rise_certificate import STEPS, ObserverStep
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.corrections import FIDELITIES, Corrections, Fidelity
from vcbf_drake.safety.methods import METHODS
from vcbf_drake.safety.programs import DEFAULT_SOLVER, check_solver
from vcbf_drake.safety.qp import INFEASIBLE_POLICIES, InfeasiblePolicy
from vcbf_drake.safety.volume import VolumeBarrier

BetweenTicks = Literal["none", "certified"]
BETWEEN_TICKS: tuple[BetweenTicks, ...] = get_args(BetweenTicks)


@dataclass
class ObserverSettings:
    """The disturbance observers: the RISE observer (E9), and the linear one (B4).

    Attributes:
        alpha: Gain of the RISE observer (E9), (E13) [1/s].
        beta: Gain of its sign term [m/s^3]; null for one that the disturbance's bounds
            need (E49): 6, or more.
        gamma: Gain of its filtered error [1/s].
        uncertified: Whether gains that fail (E49) are allowed: with the error bound
            2 delta1 (E94).
        step: How one sampled step is taken: implicit (E40), saturated (E38), explicit
            (E36).
        period: Time between its steps, at most the control period [s]; 0 means that
            one.
        boundary_layer: Where the saturated step's sign function becomes linear [m/s].
        linear_rate: Rate of the first-order observer of method wang-xu-dob-cbf-qp
            [1/s].

    Raises:
        InvalidValueError: A field is outside what is allowed.
    """

    alpha: float = 5.0
    beta: float | None = None
    gamma: float = 4.0
    uncertified: bool = False
    step: ObserverStep = "implicit"
    period: float = 0.0
    boundary_layer: float = 0.05
    linear_rate: float = 4.0

    def __post_init__(self) -> None:
        for name in ("alpha", "gamma", "boundary_layer", "linear_rate"):
            check_parameter(name, getattr(self, name))
        if self.beta is not None:
            check_parameter("beta", self.beta)
        check_parameter("period", self.period, zero_allowed=True)
        require_choice("step", self.step, STEPS)


@dataclass
class FilterSettings:
    """The settings of a safety filter; the defaults suit a user's own diagram.

    A `Scenario` is one of these with a plant and a task: its YAML keys are these
    fields, and `AddSafetyFilter` takes it in their place.

    Attributes:
        period: Control period [s].
        method: The safety filter, one of `METHODS`.
        fidelity: "corrected", or "paper" for the equations as published; or the errata
            to apply.
        infeasible: What to do when no input satisfies the barrier rows: apply the input
            of "least_violation", "hold" the last one, or "stop" the simulation.
        volume: The volume barrier, for the methods that have one.
        between_ticks: "none" asks the rows to hold at the ticks alone, "certified" asks
            for inputs under which they hold until the next tick (E77), where there are
            such.
        violation_weights: How much a violation of each barrier counts when not all can
            hold, (N,); empty for 1 each.
        observer: The disturbance observer.
        solver: Drake's solver that proposes solutions of the QP and, where it takes
            cone programs, the largest ellipsoid: one of `SOLVERS`.
        warn: Whether the log says which hypotheses fail at the start, and when there
            first is no feasible input.

    Raises:
        InvalidValueError: A field is outside what is allowed; one line says which.
    """

    period: float = 0.02
    method: str = "dob-vcbf-qp"
    fidelity: Fidelity | Corrections = "corrected"
    infeasible: InfeasiblePolicy = "least_violation"
    volume: VolumeBarrier = field(default_factory=VolumeBarrier)
    between_ticks: BetweenTicks = "none"
    violation_weights: list[float] = field(default_factory=list)
    observer: ObserverSettings = field(default_factory=ObserverSettings)
    solver: str = DEFAULT_SOLVER
    warn: bool = True

    def __post_init__(self) -> None:
        check_solver(self.solver)
        check_parameter("period", self.period)
        require_choice("method", self.method, METHODS)
        if not isinstance(self.fidelity, Corrections):
            require_choice("fidelity", self.fidelity, FIDELITIES)
        require_choice("infeasible", self.infeasible, INFEASIBLE_POLICIES)
        require_choice("between_ticks", self.between_ticks, BETWEEN_TICKS)
        weights = self.violation_weights
        check_parameter("violation_weights", weights, size=len(weights))
        require(
            self.observer.period <= self.period,
            ("observer", "period"),
            self.observer.period,
            f"at most the control period, {self.period:g} s",
        )
        require(
            self.between_ticks != "certified" or self.covers_hold,
            "between_ticks",
            self.between_ticks,
            "none without the correction error_floor, for the printed error bound does"
            " not hold between ticks",
        )

    @property
    def corrections(self) -> Corrections:
        """The errata of the published method that the filter applies."""
        if isinstance(self.fidelity, Corrections):
            return self.fidelity
        return FIDELITIES[self.fidelity]

    @property
    def covers_hold(self) -> bool:
        """Whether the error bound holds until the next tick too (E39)."""
        is_estimated = METHODS[self.method].disturbance == "estimated"
        return self.corrections.error_floor or not is_estimated

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
            bounds: Of the disturbance.
            noise: Standard deviation of the measured disturbed channels [m/s].
            period: Time between measurements [s]; the observer's own by default.
            longest_interval: See `DisturbanceObserver`.

        Raises:
            ModelError: Two disturbances act on the state in the same way.
            ValueError: The gains fail a condition that the error bound rests on.
        """
        chosen = self.observer
        period = period or chosen.period or self.period
        interval = max(period, longest_interval or 0.0)
        if METHODS[self.method].observer == "linear":
            return LinearDisturbanceObserver(
                model,
                period,
                bounds,
                rate=chosen.linear_rate,
                noise=noise,
                longest_interval=longest_interval,
            )
        gains = RiseGains.for_bounds(bounds, interval, chosen.alpha, chosen.gamma)
        return RiseObserver(
            model,
            period,
            bounds,
            gains=replace(gains, beta=chosen.beta or gains.beta),
            step=chosen.step,
            boundary_layer=chosen.boundary_layer,
            noise=noise,
            floor=self.corrections.error_floor,
            longest_interval=longest_interval,
            uncertified=chosen.uncertified,
        )
