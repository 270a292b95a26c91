"""The controller's side of the bus: a vehicle's link, and the loop of a scenario.

`InProcess` has both sides, in lockstep.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort

from vcbf_drake.add_safety_filter import AddedSafetyFilter
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.hil.bus import Bus, LinkFaults, SimulatedClock, Tap
from vcbf_drake.hil.command_sender import CommandSender
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.prediction import LiveAudit, StatePredictor
from vcbf_drake.hil.processes import PlantProcess
from vcbf_drake.hil.receivers import (
    ObstacleInbox,
    ObstacleReceiver,
    StateReceiver,
    Watchdog,
    difference_from,
)
from vcbf_drake.hil.vehicle_side import check_timing
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.simulation.faults import lose_answers
from vcbf_drake.simulation.loop import (
    add_controller_and_filter,
    make_observer,
)
from vcbf_drake.simulation.obstacles import barriers, perceived_spheres
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.sections import Hardware


class VehicleLink:
    """A vehicle on a bus in place of a plant: its state arrives, commands leave.

    Adds a `StateReceiver` to a diagram, whose ports feed a controller and a safety
    filter, and, by `answer`, the systems that answer the vehicle: a `LiveAudit` and a
    `CommandSender` with its watchdogs.

    Args:
        builder: The diagram's.
        bus: The bus, for states and commands.
        model: The vehicle's f, g, E.
        period: The control period [s].
        settings: The response to missing messages.

    Attributes:
        state: The measured state's port, (n,).
        applied_input: The port of the mean input that was applied before it, (m,).
        receiver: The receiver of the states.

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
        """Adds the sender of the filter's input, and the audit.

        Args:
            safety: The result of `AddSafetyFilter` with ``plant=None``.
            reference: The controller's port.
            watchdogs: Further watchdogs, such as that of the obstacles.
            noise: The standard deviations of the measured state, (n,).

        Raises:
            ModelError: The vehicle is answered already.
        """
        builder, settings, period = self._builder, self._settings, self._period
        if builder.HasSubsystemNamed("command_sender"):
            raise ModelError("VehicleLink.answer: one filter answers a vehicle")
        bounds, inputs = safety.observer.bounds, safety.filter.input_set
        audit = builder.AddNamedSystem(
            "live_audit",
            LiveAudit(self._model, inputs, bounds, period, settings, noise),
        )
        sender: CommandSender = builder.AddNamedSystem(
            "command_sender",
            CommandSender(
                self._bus,
                safety.filter,
                bounds.delta1,
                period,
                self.receiver,
                settings,
                watchdogs,
            ),
        )
        ports = {
            "input": safety.hold.get_output_port(),
            "finding": audit.get_output_port(),
            "reference": reference,
        }
        for system in (audit, sender):
            sources = self.receiver, safety.observer, safety.filter
            _connect(builder, system, ports, *sources)
        return sender


def _connect(
    builder: DiagramBuilder,
    system: LeafSystem,
    ports: Mapping[str, OutputPort],
    *sources: LeafSystem,
) -> None:
    """Connects a system's inputs: to the ports given, else to those of their names."""
    for i in range(system.num_input_ports()):
        port, name = system.get_input_port(i), system.get_input_port(i).get_name()
        owners = (each for each in sources if each.HasOutputPort(name))
        source = ports.get(name) or next(owners).GetOutputPort(name)
        builder.Connect(source, port)


def make_hardware_loop(scenario: Scenario, bus: Bus | None = None) -> Diagram:
    """Returns controller, filter, hold and observer between two ends of an LCM bus.

    The systems are those of `make_loop`, with state_receiver, live_audit and
    command_sender where plant and disturbance were. The observer has the control
    period, for states come no faster, and receives the input that the vehicle really
    applied. It bridges lost states up to `Hardware.longest_interval` and begins anew
    after longer gaps; the filter's margin for the hold covers that interval, too.

    A simulator drives the diagram as any other. `ControllerProcess` drives it tick by
    tick instead, whenever a state comes.

    Args:
        scenario: A validated scenario.
        bus: Carries states in and commands out; LCM's default one if None.

    Raises:
        InvalidValueError: A time limit is shorter than the control period.
    """
    bus = bus or Bus()
    check_timing(scenario)
    builder = DiagramBuilder()
    model = scenario.make_model()
    bounds, settings = scenario.make_source().bounds, scenario.hardware
    link = VehicleLink(builder, bus, model, scenario.period, settings)
    state, obstacles, states = link.state, None, link.receiver.inbox
    if settings.predict:
        predictor = builder.AddNamedSystem(
            "state_predictor",
            StatePredictor(model, scenario.period, settings.max_state_age),
        )
        state = predictor.get_output_port()
    if settings.obstacles == "perceived":
        seeing = builder.AddNamedSystem(
            "obstacle_receiver",
            ObstacleReceiver(bus, perceived_spheres(scenario), states, settings),
        )
        obstacles, said = seeing.get_output_port(), seeing.inbox
    else:
        compare = partial(difference_from, scenario)
        said = ObstacleInbox(bus, states, settings, compare, are_needed=False)
    observer = builder.AddNamedSystem(
        "filter_observer",
        make_observer(
            scenario,
            model,
            bounds,
            scenario.period,
            longest_interval=settings.longest_interval,
        ),
    )
    # The measured state, where the filter acts on a prediction of it.
    builder.Connect(link.state, observer.GetInputPort("state"))
    controller, loop = add_controller_and_filter(
        builder,
        scenario,
        barriers(scenario, seen=obstacles is not None),
        model=model,
        state=state,
        observer=observer,
        applied_input=link.applied_input,
        obstacles=obstacles,
    )
    if settings.predict:
        held = {"held_input": loop.hold.get_output_port()}
        _connect(builder, predictor, held, link.receiver, loop.observer)
    link.answer(
        loop,
        controller.GetOutputPort("reference"),
        watchdogs=[said.verdict],
        noise=np.array(scenario.noise.std),
    )
    lose_answers(builder, scenario, loop)
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_controller")
    return diagram


def controller_of(scenario: Scenario, bus: Bus) -> ControllerProcess:
    """Returns the process that controls a validated scenario's vehicle."""
    return ControllerProcess(make_hardware_loop(scenario, bus), bus, scenario.duration)


class InProcess:
    """Drives a vehicle and its controller in lockstep over ``memq://``.

    The clock stands still while either side computes, so without faults a command
    reaches the vehicle at the instant its state was measured: the run is that of
    `simulate`. With faults, messages arrive on a grid of time.

    Args:
        scenario: A validated scenario.
        vehicle_faults: Injected into the commands.
        controller_faults: Injected into the states.
        grid: The number of times per control period at which messages are handled.
        tap: Called with every message that the controller's side sends or receives.
        name: The vehicle's, where several share a bus.
        lcm: The shared bus; a private one by default.
        key: The key that signs messages; none by default.

    Attributes:
        clock: The clock of both sides.
        lcm: The bus of both sides.
        plant: The vehicle's side.
        controller: The controller's side; None while it is dead.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle_faults: LinkFaults | None = None,
        controller_faults: LinkFaults | None = None,
        grid: int = 1,
        tap: Tap | None = None,
        *,
        name: str = "",
        lcm: DrakeLcm | None = None,
        key: bytes = b"",
    ) -> None:
        self.clock = SimulatedClock()
        self.lcm = lcm or DrakeLcm("memq://")
        self._name, self._key = name, key
        self.controller: ControllerProcess | None = None
        self._scenario, self._faults = scenario, controller_faults
        self._grid, self._instant, self._tap = grid, 0, tap
        self._epoch = self.clock.now
        self.start_controller()
        self.plant = PlantProcess(scenario, self._bus(vehicle_faults))
        self._exchange()

    def start_controller(self) -> None:
        """Starts a controller, without memory of an earlier one."""
        bus = self._bus(self._faults)
        if self._tap is not None:
            bus.taps.append(self._tap)
        self.controller = controller_of(self._scenario, bus)

    def kill_controller(self) -> None:
        """Ends the controller without a farewell."""
        self.controller = None

    def advance_to(self, time: float) -> None:
        """Runs both sides up to a time [s], or to a collision."""
        while not self.plant.collided:
            step, part = divmod(self._instant + 1, self._grid)
            instant = (step + part / self._grid) * self._scenario.period
            if instant > time + 1e-9:
                return
            self._instant += 1
            self.clock.now = self._epoch + round(1e6 * instant)
            self.plant.advance_to(instant)
            self._exchange()

    def _bus(self, faults: LinkFaults | None) -> Bus:
        return Bus(self.lcm, self.clock, faults, name=self._name, key=self._key)

    def _exchange(self) -> None:
        if self.controller is not None:
            self.controller.step()
        self.plant.bus.poll()
