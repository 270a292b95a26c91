"""make_hardware_loop: the loop of a scenario with LCM in the place of the plant."""

from __future__ import annotations

from pydrake.systems.framework import Diagram, DiagramBuilder

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.check_timing import check_timing
from vcbf_drake.hil.command_sender import CommandSender
from vcbf_drake.hil.obstacle_watch import ObstacleWatch
from vcbf_drake.hil.state_predictor import StatePredictor
from vcbf_drake.hil.state_receiver import StateReceiver
from vcbf_drake.hil.state_watchdog import StateWatchdog
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import AddedSafetyFilter
from vcbf_drake.simulation.loop import add_controller_and_filter
from vcbf_drake.simulation.parts import make_observer, make_plant, make_source
from vcbf_drake.simulation.scenario import Scenario


def make_hardware_loop(scenario: Scenario, bus: Bus | None = None) -> Diagram:
    """Returns controller, filter, hold and observer between two ends of an LCM bus.

    The systems are those of `make_loop`, with state_receiver and command_sender where
    plant and disturbance were. The observer has the control period, for states come no
    faster, and is told what the vehicle really applied.
    It bridges lost states up to `Hardware.longest_interval` and begins anew after
    longer gaps; the filter's margin for the hold covers that interval, too.

    A simulator drives the diagram as any other. `ControllerProcess` drives it tick by
    tick instead, whenever a state comes.

    Args:
        scenario: A validated scenario.
        bus: Carries states in and commands out; LCM's default one if None.

    Raises:
        ScenarioError: A time limit is shorter than the control period.
    """
    bus = bus or Bus()
    check_timing(scenario)
    builder = DiagramBuilder()
    model = ControlAffineModel.from_system(make_plant(scenario))
    bounds, settings = make_source(scenario).bounds, scenario.hardware
    receiver = builder.AddNamedSystem(
        "state_receiver",
        StateReceiver(bus, model.num_states, model.num_inputs, settings.max_state_age),
    )
    measured = receiver.GetOutputPort("state")
    predictor = _add_predictor(builder, scenario, model) if settings.predict else None
    controller, loop = add_controller_and_filter(
        builder,
        scenario,
        model,
        bounds,
        state=predictor.get_output_port() if predictor else measured,
        observed_state=measured,
        observer=make_observer(
            scenario,
            model,
            bounds,
            period=scenario.period,
            longest_interval=settings.longest_interval,
        ),
        applied_input=receiver.GetOutputPort("applied_input"),
    )
    if predictor is not None:
        _connect_predictor(builder, predictor, receiver, loop)
    watchdog = StateWatchdog(receiver.inbox, bus.clock, settings)
    sender = builder.AddNamedSystem(
        "command_sender",
        CommandSender(
            bus,
            loop.filter,
            model.num_disturbances,
            scenario.period,
            receiver.inbox,
            watchdog,
            ObstacleWatch(bus, scenario),
            scenario.method,
        ),
    )
    builder.Connect(loop.hold.get_output_port(), sender.GetInputPort("input"))
    builder.Connect(
        controller.GetOutputPort("reference"), sender.GetInputPort("reference")
    )
    for name in ("slack", "volume", "barriers", "status", "feasible_set"):
        builder.Connect(loop.filter.GetOutputPort(name), sender.GetInputPort(name))
    for name in ("disturbance_estimate", "error_bound"):
        builder.Connect(loop.observer.GetOutputPort(name), sender.GetInputPort(name))
    builder.Connect(receiver.GetOutputPort("stamp"), sender.GetInputPort("stamp"))
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_controller")
    return diagram


def _add_predictor(
    builder: DiagramBuilder, scenario: Scenario, model: ControlAffineModel
) -> StatePredictor:
    longest = scenario.hardware.max_state_age
    predictor: StatePredictor = builder.AddNamedSystem(
        "state_predictor", StatePredictor(model, scenario.period, longest)
    )
    return predictor


def _connect_predictor(
    builder: DiagramBuilder,
    predictor: StatePredictor,
    receiver: StateReceiver,
    loop: AddedSafetyFilter,
) -> None:
    ports = {
        "state": receiver.GetOutputPort("state"),
        "delays": receiver.GetOutputPort("delays"),
        "held_input": loop.hold.get_output_port(),
        "disturbance_estimate": loop.observer.GetOutputPort("disturbance_estimate"),
    }
    for name, port in ports.items():
        builder.Connect(port, predictor.GetInputPort(name))
