"""AddSafetyFilter: the filter, its hold and its observer around a user's own loop."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, count
from typing import NamedTuple

from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import ZeroOrderHold

from vcbf_drake.barriers import Barrier, StateInputLimit
from vcbf_drake.between_ticks import BackupGate, HeldRows
from vcbf_drake.checks import require
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceObserver
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.interface import find_input_port, state_port_of
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.loop_monitor import LoopMonitor
from vcbf_drake.safety.safety_filter import SafetyFilter
from vcbf_drake.safety.settings import FilterSettings
from vcbf_drake.typed import typed

# The suffix of the monitor's name, after the filter's name.
LOOP_MONITOR = "loop_monitor"


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


@typed
def AddSafetyFilter(
    builder: DiagramBuilder,
    *,
    plant: System | InputPort | None,
    reference: OutputPort | None,
    barriers: Sequence[Barrier | StateInputLimit],
    input_set: InputSet,
    bounds: DisturbanceBounds | None = None,
    settings: FilterSettings | None = None,
    state: OutputPort | None = None,
    observer: DisturbanceObserver | None = None,
    model: ControlAffineModel | None = None,
    obstacles: OutputPort | None = None,
    applied_input: OutputPort | None = None,
    name: str | None = None,
) -> AddedSafetyFilter:
    """Puts a safety filter between a controller's output and a plant's input.

    Adds filter, hold and observer to the builder and connects them: state and
    reference to the filter, its command through the hold to the plant, state and held
    input to the observer, the observer's estimate to the filter. A `LoopMonitor` says
    at the start which hypotheses fail, and when there first is no feasible input; with
    the policy ``stop`` it ends the simulation there.

    Args:
        builder: Holds the plant and the controller already.
        plant: Any control-affine Drake system, whose input is its port ``input``, a
            MultibodyPlant's ``actuation``, or its only one beside ``disturbance``; or
            the input port itself, where that is another. None where the plant is
            elsewhere: then `model` and `state` are needed, and the hold's output is
            yours to connect.
        reference: The controller's output port, (m,); None leaves the filter's port
            ``reference`` to connect, or to export from a diagram.
        barriers: The barriers and limits.
        input_set: The inputs that the actuators can deliver.
        bounds: delta1, delta2, delta3 of the disturbance; not needed for a plant
            without one.
        settings: Period, method and all other choices; a scenario does, too.
            `FilterSettings()` by default.
        state: The measured state; the plant's output named ``state`` or its only one
            by default.
        observer: Used in place of the method's own. If it is in the builder already,
            those of its input ports that are connected stay as they are.
        model: The plant's model; made from the plant by default, with its default
            parameters: parameters changed in a context change the plant alone. Give it
            where it cannot be derived (a discrete plant), or where the plant's
            disturbance port has another name:
            ``ControlAffineModel.from_system(boat, "thrust", "gust")``.
        obstacles: The port of the perceived obstacles, if there are `PerceivedSpheres`
            among the barriers; None leaves the filter's port ``obstacles`` to connect.
        applied_input: The mean input that the plant really applied since the last
            tick, where it tells; the held input by default.
        name: The filter's name; hold, observer and monitor are named after it.
            ``filter`` by default, or ``filter_2`` where there is one.

    Raises:
        ModelError: The plant is not control affine or a barrier does not fit it.
        ValueError: An argument is outside what is allowed.
    """
    settings = settings or FilterSettings()
    plant_input: InputPort | None = None
    if plant is not None:
        plant_input = plant if isinstance(plant, InputPort) else find_input_port(plant)
        system = plant_input.get_system()
        # Certificates between ticks need symbolic dynamics.
        symbolic = settings.between_ticks == "certified"
        model = model or ControlAffineModel.from_system(
            system, plant_input, symbolic=symbolic
        )
        state = state or state_port_of(system)
    if model is None or state is None:
        raise ValueError("plant: None; then model and state must be given")
    bounds = _checked_bounds(bounds, model)
    name = _free_name(builder, name)
    if observer is None:
        observer = settings.make_observer(model, bounds)
    safety_filter = SafetyFilter(
        model,
        barriers,
        input_set,
        settings,
        bounds=bounds,
        estimate_gain=observer.estimate_gain,
        longest_hold=observer.certified_interval,
        make_row_holder=HeldRows,
        make_gate=BackupGate,
    )
    builder.AddNamedSystem(name, safety_filter)
    hold = builder.AddNamedSystem(
        f"{name}_hold", ZeroOrderHold(settings.period, model.num_inputs)
    )
    if observer not in builder.GetSystems():
        builder.AddNamedSystem(f"{name}_observer", observer)
    held = hold.get_output_port()
    if obstacles is not None:
        if not safety_filter.HasInputPort("obstacles"):
            raise ValueError("obstacles: none of the barriers is of PerceivedSpheres")
        builder.Connect(obstacles, safety_filter.GetInputPort("obstacles"))
    if reference is not None:
        builder.Connect(reference, safety_filter.GetInputPort("reference"))
    builder.Connect(state, safety_filter.GetInputPort("state"))
    builder.Connect(held, safety_filter.GetInputPort("held_input"))
    builder.Connect(safety_filter.GetOutputPort("command"), hold.get_input_port())
    if plant_input is not None:
        builder.Connect(held, plant_input)
    for source, port in ((state, "state"), (applied_input or held, "input")):
        if not builder.IsConnectedOrExported(observer.GetInputPort(port)):
            builder.Connect(source, observer.GetInputPort(port))
    if safety_filter.HasInputPort("estimate"):
        builder.Connect(
            observer.GetOutputPort("estimate"), safety_filter.GetInputPort("estimate")
        )
    if settings.warn or settings.infeasible == "stop":
        monitor = LoopMonitor(safety_filter, observer)
        builder.AddNamedSystem(f"{name}_{LOOP_MONITOR}", monitor)
        for i in range(monitor.num_input_ports()):
            port, name = monitor.get_input_port(i), monitor.get_input_port(i).get_name()
            owner = safety_filter if safety_filter.HasOutputPort(name) else observer
            builder.Connect(owner.GetOutputPort(name), port)
    return AddedSafetyFilter(safety_filter, hold, observer)


def _checked_bounds(
    bounds: DisturbanceBounds | None, model: ControlAffineModel
) -> DisturbanceBounds:
    if isinstance(bounds, DisturbanceBounds):
        return bounds
    is_calm = bounds is None and model.num_disturbances == 0
    rule = "DisturbanceBounds(delta1, delta2, delta3), for the plant has a disturbance"
    require(is_calm, "bounds", bounds, rule)
    return DisturbanceBounds(0.0, 0.0, 0.0)


def _free_name(builder: DiagramBuilder, name: str | None) -> str:
    if name is not None:
        require(not builder.HasSubsystemNamed(name), "name", name, "new to the builder")
        return name
    names = chain(["filter"], (f"filter_{i}" for i in count(2)))
    return next(each for each in names if not builder.HasSubsystemNamed(each))
