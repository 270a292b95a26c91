"""PlantProcess: a simulated vehicle on the bus, in real time."""

from __future__ import annotations

from typing import Any

from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import Context

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.command_receiver import CommandReceiver
from vcbf_drake.hil.farewell import say_farewell
from vcbf_drake.hil.modes import VehicleMode
from vcbf_drake.hil.report import plant_report
from vcbf_drake.hil.state_sender import StateSender
from vcbf_drake.hil.timeline import Timeline
from vcbf_drake.hil.vehicle import make_vehicle
from vcbf_drake.simulation.run import make_simulator
from vcbf_drake.simulation.scenario import Scenario


class PlantProcess:
    """Simulates a scenario's plant behind a bus: states out, commands in.

    The plant stands at its initial state until a first command comes.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: What is run.
        bus: The bus.
        diagram: The vehicle.
        collided: Whether a barrier became negative, which ends the motion.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        self.bus = bus
        self.collided = False
        self.scenario = scenario
        self._timeline = Timeline(bus.clock)
        self.diagram = make_vehicle(scenario, bus, self._timeline)
        self._receiver: CommandReceiver = self.diagram.GetSubsystemByName(
            "command_receiver"
        )
        self._sender: StateSender = self.diagram.GetSubsystemByName("state_sender")
        self._simulator = make_simulator(self.diagram, scenario)
        self._simulator.Initialize()
        self._stopping = False
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

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def run(self) -> None:
        """Runs in real time to the scenario's duration, a collision or `stop`."""
        self.bus.begin_session()
        self._wait_for_command()
        period, duration = self.scenario.period, self.scenario.duration
        tick = 1
        while not (self._stopping or self.collided or self.time >= duration):
            goal = min(tick * period, duration)
            self.bus.wait(self._timeline.utime(goal))
            self.advance_to(min(self._timeline.time(), goal))
            tick += self.time >= goal
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
        self.collided = (
            status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )

    def report(self) -> dict[str, Any]:
        """Returns what the motion came to, and how the bus did."""
        report = plant_report(self.scenario, self.diagram, self.context, self.collided)
        if self._elapsed > 0.0:
            report["real_time_rate"] = self.time / self._elapsed
        return report

    def _wait_for_command(self) -> None:
        while self._receiver.inbox.newest is None and not self._stopping:
            self._timeline.restart()
            self.diagram.ForcedPublish(self.context)
            self.bus.wait(self._timeline.utime(self.scenario.period))
        self._timeline.restart()
