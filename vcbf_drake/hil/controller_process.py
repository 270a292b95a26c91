"""ControllerProcess: observer, controller and filter behind a bus, in real time."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

from pydrake.systems.framework import Context

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.command_sender import CommandSender
from vcbf_drake.hil.farewell import say_farewell
from vcbf_drake.hil.hardware_loop import make_hardware_loop
from vcbf_drake.hil.modes import CommandMode, VehicleMode
from vcbf_drake.hil.prediction_record import PredictionRecord
from vcbf_drake.hil.report import ControllerRecord, controller_report
from vcbf_drake.hil.state_receiver import StateReceiver
from vcbf_drake.hil.warm_up import warm_up
from vcbf_drake.simulation.scenario import Scenario


class ControllerProcess:
    """Drives the hardware loop of a scenario: one tick for every state that comes.

    The loop's time is the time of the state, so the observer's intervals are the
    vehicle's, whatever the bus does. A vehicle that sends faster than the control
    period is sampled. When no state comes, commands go on once a control period, as
    the watchdog says.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: What is run.
        bus: The bus.
        diagram: The hardware loop.
        context: Its context.
        tick_taps: Called with the context at every tick, before its discrete state
            changes.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        self.bus = bus
        self.scenario = scenario
        self._period = round(1e6 * scenario.period)  # [us]
        self.diagram = make_hardware_loop(scenario, bus)
        named = self.diagram.GetSubsystemByName
        self._receiver: StateReceiver = named("state_receiver")
        self._sender: CommandSender = named("command_sender")
        warm_up(named("filter").model.num_inputs)
        self.context = self.diagram.CreateDefaultContext()
        self.tick_taps: list[Callable[[Context], None]] = []
        self._record = ControllerRecord()
        self._prediction: PredictionRecord | None = None
        if scenario.hardware.predict:
            self._prediction = PredictionRecord(self.diagram, len(scenario.target))
            self.tick_taps.append(self._prediction)
        self._sent_at = 0
        self._stopping = False

    @property
    def time(self) -> float:
        """The time of the last state that was acted on [s]."""
        return float(self.context.get_time())

    @property
    def mode(self) -> CommandMode | None:
        """What it asked of the vehicle last, None before the first time."""
        status = self._sender.last_status
        return None if status is None else CommandMode(status.mode)

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def run(self) -> None:
        """Runs until the vehicle ends, the scenario's duration is over, or `stop`.

        It takes over from any controller that speaks already.
        """
        self.bus.begin_session()
        while not (self._stopping or self._is_over()):
            self.bus.wait(self.bus.clock.utime() + self._period)
            self.step()
        self._sender.ending = True
        say_farewell(self._send)

    def step(self) -> None:
        """Acts on the newest state; in a long silence, sends what the watchdog says."""
        self.bus.poll()
        if self._is_due():
            self._tick()
        elif self._sender.states_are_old() and self._has_been_silent():
            self._send()

    def report(self) -> dict[str, Any]:
        """Returns what the filter did, and how the states arrived."""
        report = controller_report(self.scenario, self._receiver, self._record)
        if self._prediction is not None:
            report["prediction"] = self._prediction.report()
        return report

    def _is_due(self) -> bool:
        context = self._receiver_context()
        if not self._receiver.has_news(context):
            return False
        newest, last = self._receiver.inbox.newest, self._receiver.message(context)
        if last is None or newest.session != last.session or newest.time == last.time:
            return True
        return bool(newest.time - last.time > 0.9 * self.scenario.period)

    def _tick(self) -> None:
        """Takes the state over, updates filter, hold and observer, and sends."""
        started = time.perf_counter()
        self.diagram.ExecuteForcedEvents(self.context, publish=False)
        self.context.SetTime(self._receiver.time(self._receiver_context()))
        for tap in self.tick_taps:
            tap(self.context)
        self.context.SetDiscreteState(
            self.diagram.EvalUniquePeriodicDiscreteUpdate(self.context)
        )
        self._send()
        self._record.add_tick(self._sender.last_status, time.perf_counter() - started)

    def _send(self) -> None:
        """Sends command and status, if there was a tick already."""
        self.diagram.ForcedPublish(self.context)
        self._sent_at = self.bus.clock.utime()
        if self._sender.last_status is not None:
            self._record.add_mode(self._sender.last_status)

    def _has_been_silent(self) -> bool:
        return self.bus.clock.utime() - self._sent_at >= self._period

    def _is_over(self) -> bool:
        newest = self._receiver.inbox.newest
        return newest is not None and bool(
            newest.mode == VehicleMode.ENDED or newest.time >= self.scenario.duration
        )

    def _receiver_context(self) -> Any:
        return self._receiver.GetMyContextFromRoot(self.context)
