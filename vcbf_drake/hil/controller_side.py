"""The controller's side of the bus: a vehicle's link, and the loop of a scenario."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    OutputPort,
)

from vcbf_drake.add_safety_filter import AddedSafetyFilter
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.command_sender import CommandSender
from vcbf_drake.hil.live_audit import LiveAudit
from vcbf_drake.hil.state_receiver import StatePredictor, StateReceiver
from vcbf_drake.hil.timing import check_timing
from vcbf_drake.hil.watchdogs import ObstacleReceiver, ObstacleWatch, Watchdog
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.simulation.fault_systems import lose_answers
from vcbf_drake.simulation.loop import (
    add_controller_and_filter,
    make_observer,
)
from vcbf_drake.simulation.obstacles import perceived_spheres
from vcbf_drake.simulation.scenario import Hardware, Scenario


class VehicleLink:
    """A vehicle on a bus in the place of a plant: its state here, its commands there.

    Adds a `StateReceiver` to a diagram, whose ports a controller and a safety filter
    are connected to, and, when these are there, what answers the vehicle: a `LiveAudit`
    and a `CommandSender` with its watchdogs.

    Args:
        builder: The diagram's.
        bus: Carries states in and commands out.
        model: The vehicle's f, g, E.
        period: The control period [s].
        settings: What to do when messages fail to come.

    Attributes:
        state: The measured state's port, (n,).
        applied_input: The port of the mean input that was applied before it, (m,).
        receiver: What takes the states.

    Raises:
        ModelError: The diagram has a link already.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        bus: Bus,
        model: ControlAffineModel,
        period: float,
        settings: Hardware | None = None,
    ) -> None:
        self._builder, self._bus, self._model = builder, bus, model
        self._period, self._settings = period, settings or Hardware()
        if builder.HasSubsystemNamed("state_receiver"):
            raise ModelError("VehicleLink: a diagram has one")
        self.receiver: StateReceiver = builder.AddNamedSystem(
            "state_receiver",
            StateReceiver(bus, model.num_states, model.num_inputs, self._settings),
        )
        self.state = self.receiver.GetOutputPort("state")
        self.applied_input = self.receiver.GetOutputPort("applied_input")

    def answer(
        self,
        safety: AddedSafetyFilter,
        reference: OutputPort,
        *,
        watchdogs: Sequence[Watchdog] = (),
        noise: Array | None = None,
    ) -> CommandSender:
        """Adds what sends the filter's input, and what watches.

        Args:
            safety: What `AddSafetyFilter` returned, with ``plant=None``.
            reference: The controller's port.
            watchdogs: Further ones, as for the obstacles.
            noise: The standard deviations of the measured state, (n,).

        Raises:
            ModelError: The vehicle is answered already.
        """
        builder, settings = self._builder, self._settings
        if builder.HasSubsystemNamed("command_sender"):
            raise ModelError("VehicleLink.answer: one filter answers a vehicle")
        audit = builder.AddNamedSystem(
            "live_audit",
            LiveAudit(
                self._model,
                safety.filter.input_set,
                safety.observer.bounds,
                self._period,
                settings,
                noise,
            ),
        )
        sender: CommandSender = builder.AddNamedSystem(
            "command_sender",
            CommandSender(
                self._bus,
                safety.filter,
                safety.observer.bounds.delta1,
                self._period,
                self.receiver,
                settings,
                watchdogs,
            ),
        )
        ports = {
            "input": safety.hold.get_output_port(),
            "reference": reference,
            "finding": audit.get_output_port(),
            "state": self.state,
            "applied_input": self.applied_input,
            "stamp": self.receiver.GetOutputPort("stamp"),
        }
        for name in ("slack", "volume", "barriers", "status", "feasible_set"):
            ports[name] = safety.filter.GetOutputPort(name)
        ports["estimate"] = safety.observer.GetOutputPort("estimate")
        for system in (audit, sender):
            for name, port in ports.items():
                if system.HasInputPort(name):
                    builder.Connect(port, system.GetInputPort(name))
        return sender


def make_hardware_loop(scenario: Scenario, bus: Bus | None = None) -> Diagram:
    """Returns controller, filter, hold and observer between two ends of an LCM bus.

    The systems are those of `make_loop`, with state_receiver, live_audit and
    command_sender where plant and disturbance were. The observer has the control
    period, for states come no faster, and is told what the vehicle really applied.
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
    model = scenario.make_model()
    bounds, settings = scenario.make_source().bounds, scenario.hardware
    link = VehicleLink(builder, bus, model, scenario.period, settings)
    predictor = None
    if settings.predict:
        predictor = builder.AddNamedSystem(
            "state_predictor",
            StatePredictor(model, scenario.period, settings.max_state_age),
        )
    watchdogs: list[Watchdog] = []
    obstacles, states = None, link.receiver.inbox
    if settings.obstacles == "perceived":
        seeing = builder.AddNamedSystem(
            "obstacle_receiver",
            ObstacleReceiver(bus, perceived_spheres(scenario), states, settings),
        )
        obstacles = seeing.get_output_port()
        watchdogs.append(seeing)
    else:
        watchdogs.append(ObstacleWatch(bus, scenario, states))
    observer = builder.AddNamedSystem(
        "filter_observer",
        make_observer(
            scenario,
            model,
            bounds,
            period=scenario.period,
            longest_interval=settings.longest_interval,
        ),
    )
    # What was measured, where the filter acts on a prediction of it.
    builder.Connect(link.state, observer.GetInputPort("state"))
    controller, loop = add_controller_and_filter(
        builder,
        scenario,
        model,
        bounds,
        state=predictor.get_output_port() if predictor else link.state,
        observer=observer,
        applied_input=link.applied_input,
        obstacles=obstacles,
    )
    if predictor is not None:
        _connect_predictor(builder, predictor, link.receiver, loop)
    link.answer(
        loop,
        controller.GetOutputPort("reference"),
        watchdogs=watchdogs,
        noise=np.array(scenario.noise.std),
    )
    lose_answers(builder, scenario, loop)
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_controller")
    return diagram


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
