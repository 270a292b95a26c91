"""FilterSettings: the choices behind a safety filter, in one dataclass."""

# No `from __future__ import annotations`: pydrake.common.yaml needs evaluated types.

from dataclasses import dataclass, field, replace

from vcbf_drake.checks import require, require_choice
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearDisturbanceObserver,
    RiseGains,
    RiseObserver,
)
from vcbf_drake.disturbances.rise_certificate import STEPS
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.corrections import FIDELITIES, Corrections
from vcbf_drake.safety.filter_qp import INFEASIBLE_POLICIES
from vcbf_drake.safety.methods import METHODS
from vcbf_drake.safety.volume_barrier import VolumeBarrier

BETWEEN_TICKS = ("none", "certified")


@dataclass
class ObserverSettings:
    """The disturbance observers: the RISE observer (E9), and the linear one (B4).

    Raises:
        ValueError: A field is outside what is allowed.
    """

    # Gains of the RISE observer, (E9), (E13).
    alpha: float = 5.0
    # None for one that the disturbance's bounds need (E49): 6, or more.
    beta: float | None = None
    gamma: float = 4.0
    # Whether gains that fail (E49) are allowed: with the error bound 2 delta1 (E94).
    uncertified: bool = False
    # How one sampled step is taken: implicit (E40), saturated (E38), explicit (E36).
    step: str = "implicit"
    # Time between its steps, at most the control period [s]; 0 means that one.
    period: float = 0.0
    # Where the saturated step's sign function becomes linear [m/s].
    boundary_layer: float = 0.05
    # Rate of the first-order observer of method wang-xu-dob-cbf-qp [1/s].
    linear_rate: float = 4.0

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "gamma", "boundary_layer", "linear_rate"):
            value = getattr(self, name)
            require(value is None or value > 0.0, name, value, "above 0")
        require(self.period >= 0.0, "period", self.period, "not below 0")
        require_choice("step", self.step, STEPS)


@dataclass
class FilterSettings:
    """The settings of a safety filter; the defaults suit a user's own diagram.

    A `Scenario` is one of these with a plant and a task: its YAML keys are these
    fields, and `AddSafetyFilter` takes it in their place.

    Raises:
        ValueError: A field is outside what is allowed; one line says which.
    """

    # Control period [s].
    period: float = 0.02
    # The safety filter, one of METHODS.
    method: str = "dob-vcbf-qp"
    # "corrected", or "paper" for the equations as published; or the errata to apply.
    fidelity: str | Corrections = "corrected"
    # What to do when no input satisfies the barrier rows: apply the input of
    # "least_violation", "hold" the last one, or "stop" the simulation.
    infeasible: str = "least_violation"
    # The volume barrier, for the methods that have one.
    volume: VolumeBarrier = field(default_factory=VolumeBarrier)
    # Between ticks: "none" asks the rows to hold at the ticks alone, "certified" asks
    # for inputs under which they hold until the next tick (E77), where there are such.
    between_ticks: str = "none"
    # How much a violation of each barrier counts when not all can hold, (N,); empty
    # for 1 each.
    violation_weights: list[float] = field(default_factory=list)
    # The disturbance observer.
    observer: ObserverSettings = field(default_factory=ObserverSettings)

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Raises ValueError for a field, and fields of it, that are not allowed."""
        require(self.period > 0.0, "period", self.period, "above 0")
        require_choice("method", self.method, METHODS)
        if not isinstance(self.fidelity, Corrections):
            require_choice("fidelity", self.fidelity, FIDELITIES)
        require_choice("infeasible", self.infeasible, INFEASIBLE_POLICIES)
        require_choice("between_ticks", self.between_ticks, BETWEEN_TICKS)
        for index, weight in enumerate(self.violation_weights):
            require(weight > 0.0, f"violation_weights[{index}]", weight, "above 0")
        require(
            self.observer.period <= self.period,
            "observer.period",
            self.observer.period,
            f"at most the control period, {self.period:g} s",
        )
        if self.between_ticks == "certified" and not self.covers_hold:
            raise ValueError(
                "between_ticks: certified; it must be none without the correction"
                " error_floor, for the printed error bound does not hold between ticks"
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
