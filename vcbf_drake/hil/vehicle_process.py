"""PlantProcess: a simulated vehicle on the bus; and both halves in lockstep."""

from __future__ import annotations

import math
from typing import Any

from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import Context

from vcbf_drake.hil.bus import Bus, LinkFaults, SimulatedClock, Tap
from vcbf_drake.hil.controller_process import ControllerProcess, controller_of
from vcbf_drake.hil.decoding import VehicleMode
from vcbf_drake.hil.processes import HardwareProcess, say_farewell
from vcbf_drake.hil.report import plant_report
from vcbf_drake.hil.timing import Timeline
from vcbf_drake.hil.vehicle_side import CommandReceiver, StateSender, make_vehicle
from vcbf_drake.simulation.run import make_simulator
from vcbf_drake.simulation.scenario import Scenario


class PlantProcess(HardwareProcess):
    """Simulates a scenario's plant behind a bus: states out, commands in.

    The plant stands at its initial state until a first command comes.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: What is run.
        diagram: The vehicle.
        collided: Whether a barrier became negative, which ends the motion.
        deadlines_missed: How often it woke later than a control period.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        super().__init__(bus)
        self.collided = False
        self.deadlines_missed = 0
        self.scenario = scenario
        self._timeline = Timeline(bus.clock)
        self.diagram = make_vehicle(scenario, bus, self._timeline)
        self._receiver: CommandReceiver = self.diagram.GetSubsystemByName(
            "command_receiver"
        )
        self._sender: StateSender = self.diagram.GetSubsystemByName("state_sender")
        self._simulator = make_simulator(self.diagram, scenario)
        self._simulator.Initialize()
        self._elapsed = 0.0

    @property
    def context(self) -> Context:
        """The diagram's context."""
        return self._simulator.get_context()

    @property
    def time(self) -> float:
        """The time since the motion began [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> VehicleMode:
        """What the vehicle does."""
        return self._receiver.mode(self._receiver.GetMyContextFromRoot(self.context))

    def run(self, patience: float = math.inf) -> None:
        """Runs in real time to the scenario's duration, a collision or `stop`.

        Args:
            patience: How long to wait for a first command [s].
        """
        # Not a new session: the states of the start are heard, and were another's.
        self._forget_the_start(self._receiver.inbox)
        if self._wait_for_command(patience):
            self._move()
        self._elapsed = self._timeline.time()
        self._sender.ending = True
        say_farewell(lambda: self.diagram.ForcedPublish(self.context))

    def advance_to(self, time: float) -> None:
        """Simulates up to a time [s]; earlier ones and those after a collision do not.

        A command is applied from the first step on that begins after it has come.
        """
        if self.collided or time <= self.time:
            return
        status = self._simulator.AdvanceTo(time)
        self._receiver.catch_up()
        self.collided = (
            status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )

    def report(self) -> dict[str, Any]:
        """Returns what the motion came to, and how the bus did."""
        report = plant_report(self.scenario, self.diagram, self.context, self.collided)
        report["deadlines_missed"] = self.deadlines_missed
        if self._elapsed > 0.0:
            report["real_time_rate"] = self.time / self._elapsed
        return report

    def _wait_for_command(self, patience: float) -> bool:
        """Stands until a command comes; returns whether one came."""
        began = self.bus.clock.utime()
        while self._receiver.inbox.newest is None:
            self._timeline.restart()
            if self._stopping:
                self.ending = "stopped"
                return False
            if self.bus.clock.utime() - began > 1e6 * patience:
                self.ending = "no peer"
                self.tell(f"no controller was heard for {patience:g} s")
                return False
            self.diagram.ForcedPublish(self.context)
            self.bus.wait(self._timeline.utime(self.scenario.period))
            self._say()
        self._timeline.restart()
        return True

    def _move(self) -> None:
        period, duration = self.scenario.period, self.scenario.duration
        tick = 1
        while not (self._stopping or self.collided or self.time >= duration):
            goal = min(tick * period, duration)
            self.bus.wait(self._timeline.utime(goal))
            self.deadlines_missed += self._timeline.time() - goal > period
            self.advance_to(min(self._timeline.time(), goal))
            tick += self.time >= goal
            self._say()
        self.ending = "stopped" if self._stopping else "duration"
        if self.collided:
            self.ending = "collision"

    def _say(self) -> None:
        mode = self.mode.name.lower()
        self._tell_change("mode", mode, f"{self.time:.2f} s: {mode}")
        inbox = self._receiver.inbox
        complaint = inbox.complaint(self.bus.clock.utime())
        if complaint:
            line = f"{self.time:.2f} s: commands: {complaint}"
            self._tell_change("commands", inbox.last_rejection, line)
        self._tell_progress(
            lambda: f"{self.time:8.1f} s  {mode}  {inbox.accepted} commands"
        )


class InProcess:
    """Drives a vehicle and its controller in lockstep over ``memq://``.

    The clock stands still while either side computes, so without faults a command
    reaches the vehicle at the instant its state was measured: the run is that of
    `simulate`. With faults, messages arrive on a grid of time.

    Args:
        scenario: A validated scenario.
        vehicle_faults: Injected into the commands.
        controller_faults: Injected into the states.
        grid: How many times in a control period messages are handled.
        tap: Told of everything that the controller's side sends and receives.
        name: The vehicle's, where several share a bus.
        lcm: That bus; one of its own by default.
        key: What messages are signed with; nothing by default.

    Attributes:
        clock: What both sides take for the time.
        lcm: The bus both are on.
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
        """Starts a controller, or another one, which knows nothing of the first."""
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
