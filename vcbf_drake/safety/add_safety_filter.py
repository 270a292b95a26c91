"""AddSafetyFilter: the filter, its hold and its observer around a user's own loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import ZeroOrderHold

from vcbf_drake.barriers import Barrier, StateInputLimit
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearDisturbanceObserver,
    RiseObserver,
    observer_ports,
)
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.corrections import FIDELITIES, Corrections, Fidelity
from vcbf_drake.safety.filter_qp import InfeasiblePolicy
from vcbf_drake.safety.infeasibility_monitor import InfeasibilityMonitor
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.methods import method_named
from vcbf_drake.safety.safety_filter import SafetyFilter
from vcbf_drake.safety.volume_barrier import VolumeBarrier

BetweenTicks = Literal["none", "certified"]
BETWEEN_TICKS: tuple[BetweenTicks, ...] = ("none", "certified")

# What the monitor of the policy ``stop`` is called, after the filter's name.
STOP_MONITOR = "infeasibility_monitor"


def covers_hold(method: str, corrections: Corrections) -> bool:
    """Returns whether a filter's error bound holds until the next tick too (E39).

    Args:
        method: One of `vcbf_drake.safety.METHODS`.
        corrections: The errata it applies.
    """
    return corrections.error_floor or method_named(method).disturbance != "estimated"


class AddedSafetyFilter(NamedTuple):
    """The systems that `AddSafetyFilter` put into the diagram, the monitor aside.

    Attributes:
        filter: The safety filter.
        hold: Holds the filter's input over a control period.
        observer: The disturbance observer; its estimate is there for the controller.
    """

    filter: SafetyFilter
    hold: ZeroOrderHold
    observer: DisturbanceObserver


def AddSafetyFilter(
    builder: DiagramBuilder,
    *,
    plant: System | None,
    reference: OutputPort | None,
    barriers: Sequence[Barrier | StateInputLimit],
    input_set: InputSet,
    period: float,
    bounds: DisturbanceBounds,
    method: str = "dob-vcbf-qp",
    fidelity: Fidelity = "corrected",
    corrections: Corrections | None = None,
    infeasible: InfeasiblePolicy = "stop",
    volume_barrier: VolumeBarrier | None = None,
    observer: DisturbanceObserver | None = None,
    state: OutputPort | None = None,
    observed_state: OutputPort | None = None,
    applied_input: OutputPort | None = None,
    obstacles: OutputPort | None = None,
    input_port: InputPort | str | int | None = None,
    disturbance_port: InputPort | str | int | None = None,
    violation_weights: Sequence[float] | None = None,
    between_ticks: BetweenTicks = "none",
    model: ControlAffineModel | None = None,
    name: str = "filter",
    filter_class: Callable[..., SafetyFilter] = SafetyFilter,
) -> AddedSafetyFilter:
    """Puts a safety filter between a controller's output and a plant's input.

    Adds filter, hold and observer to the builder and connects them: state and
    reference to the filter, the filter's input through the hold to the plant, state
    and held input to the observer, the observer to the filter. With the policy
    ``stop`` it also adds a monitor that ends the simulation at an infeasible tick.

    Args:
        builder: Holds the plant and the controller already.
        plant: Any control-affine Drake system; see `ControlAffineModel.from_system`.
            The filter's model is made here, with the plant's default parameters:
            parameters changed in a context change the plant alone. None where the
            plant is elsewhere: then `model` and `state` are needed, and what the hold
            puts out is yours to connect.
        reference: The controller's output port, (m,); None leaves the filter's port
            ``reference`` to connect, or to export from a diagram.
        barriers: What must stay true.
        input_set: What the actuators can do.
        period: The control period [s].
        bounds: delta1, delta2, delta3 of the disturbance.
        method: One of `vcbf_drake.safety.METHODS`.
        fidelity: ``corrected``, or ``paper`` for the equations as printed.
        corrections: The errata to apply, in place of those of the fidelity.
        infeasible: When no input satisfies the barrier rows: ``stop`` the simulation,
            apply the input of ``least_violation``, or ``hold`` the last one.
        volume_barrier: What the volume row keeps positive, and its gain.
        observer: Used in place of the method's own with its default gains.
        state: The measured state; the plant's output named ``state`` or its only one
            by default.
        observed_state: What the observer is told, where `state` is not what was
            measured but a prediction; `state` by default.
        applied_input: The mean input that the plant really applied since the last
            tick, where it tells; the held input by default.
        obstacles: What is perceived, where there are `PerceivedSpheres` among the
            barriers; None leaves the filter's port ``obstacles`` to connect.
        input_port: The plant's input, where it has several.
        disturbance_port: The plant's disturbance input, where it has another name.
        violation_weights: How much a violation of each barrier counts when not all can
            hold, (N,), positive; ones by default.
        between_ticks: ``certified`` for inputs under which the rows hold until the next
            tick (E77), where there are such; ``none`` for the ticks alone.
        model: The plant's model, when it is at hand already; needed where it cannot be
            derived from the plant (a discrete one), or has other parameters.
        name: The filter's name; hold, observer and monitor are named after it.
        filter_class: What makes the filter, from the arguments of `SafetyFilter`.

    Raises:
        ModelError: The plant is not control affine or a barrier does not fit it.
        ValueError: An argument is outside what is allowed.
    """
    if plant is None and (model is None or state is None):
        raise ValueError("plant: None; then model and state must be given")
    if between_ticks not in BETWEEN_TICKS:
        raise ValueError(
            f"between_ticks: got {between_ticks!r}; allowed: {', '.join(BETWEEN_TICKS)}"
        )
    model = model or ControlAffineModel.from_system(plant, input_port, disturbance_port)
    observer = observer or _default_observer(method, model, period, bounds)
    applied = corrections or FIDELITIES[fidelity]
    if between_ticks == "certified" and not covers_hold(method, applied):
        raise ValueError(
            "between_ticks: certified needs the correction error_floor (fidelity"
            " corrected): the printed error bound does not hold between ticks"
        )
    longest_hold = max(period, observer.certified_interval)
    safety_filter = filter_class(
        model,
        barriers,
        input_set,
        method=method,
        fidelity=fidelity,
        corrections=corrections,
        infeasible=infeasible,
        volume_barrier=volume_barrier,
        disturbance_bound=bounds.delta1,
        estimate_gain=observer.estimate_gain,
        violation_weights=violation_weights,
        hold_margin=bounds.delta2 * longest_hold if applied.error_floor else 0.0,
        certified_hold=longest_hold if between_ticks == "certified" else 0.0,
    )
    builder.AddNamedSystem(name, safety_filter)
    hold = builder.AddNamedSystem(
        f"{name}_hold", ZeroOrderHold(period, model.num_inputs)
    )
    builder.AddNamedSystem(f"{name}_observer", observer)
    if state is None:
        state = _state_output(plant)
    if obstacles is not None:
        builder.Connect(obstacles, _obstacles_port(safety_filter))
    held = hold.get_output_port()
    builder.Connect(state, safety_filter.GetInputPort("state"))
    if reference is not None:
        builder.Connect(reference, safety_filter.GetInputPort("reference"))
    builder.Connect(safety_filter.GetOutputPort("input"), hold.get_input_port())
    builder.Connect(held, safety_filter.GetInputPort("held_input"))
    if plant is not None:
        builder.Connect(held, _port(plant, input_port))
    builder.Connect(observed_state or state, observer.GetInputPort("state"))
    builder.Connect(applied_input or held, observer.GetInputPort("input"))
    if safety_filter.method.disturbance == "estimated":
        for port, _ in observer_ports(model.num_disturbances):
            builder.Connect(
                observer.GetOutputPort(port), safety_filter.GetInputPort(port)
            )
    if infeasible == "stop":
        monitor = builder.AddNamedSystem(
            f"{name}_{STOP_MONITOR}", InfeasibilityMonitor(period)
        )
        builder.Connect(safety_filter.GetOutputPort("status"), monitor.get_input_port())
    return AddedSafetyFilter(safety_filter, hold, observer)


def _default_observer(
    method: str, model: ControlAffineModel, period: float, bounds: DisturbanceBounds
) -> DisturbanceObserver:
    if method_named(method).observer == "linear":
        return LinearDisturbanceObserver(model, period, bounds)
    return RiseObserver(model, period, bounds)


def _obstacles_port(safety_filter: SafetyFilter) -> InputPort:
    if not safety_filter.HasInputPort("obstacles"):
        raise ValueError("obstacles: none of the barriers is of PerceivedSpheres")
    return safety_filter.GetInputPort("obstacles")


def _state_output(plant: System) -> OutputPort:
    if plant.HasOutputPort("state"):
        return plant.GetOutputPort("state")
    return plant.get_output_port()


def _port(plant: System, port: InputPort | str | int | None) -> InputPort:
    if port is None:
        return (
            plant.GetInputPort("input")
            if plant.HasInputPort("input")
            else plant.get_input_port()
        )
    if isinstance(port, str):
        return plant.GetInputPort(port)
    return plant.get_input_port(port) if isinstance(port, int) else port
