"""The processes on a bus: what both share, and the simulated vehicle's."""

from __future__ import annotations

from collections.abc import Callable
import math
import time
from typing import Any

import numpy as np
from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import Context

from vcbf_drake.checks import Array
from vcbf_drake.errors import naming_user_code
from vcbf_drake.hil.bus import Bus, Neighbours
from vcbf_drake.hil.decoding import ModeChange, VehicleMode
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.hil.timing import Timeline, median_and_p99
from vcbf_drake.hil.vehicle_side import CommandReceiver, StateSender, make_vehicle
from vcbf_drake.simulation.collision_monitor import CollisionMonitor
from vcbf_drake.simulation.loop import COLLISION_MONITOR, LOG_PREFIX
from vcbf_drake.simulation.run import make_simulator
from vcbf_drake.simulation.scenario import Scenario

_TIMES, _PAUSE = 10, 0.05  # [s]
# How long nobody is heard before others are told of [us].
_LONELY = 1_000_000
# The share of control periods, of a second's, that may be missed without a word.
_MOST_MISSED = 0.1

# Why a process ended, and its exit status.
EXIT_STATUSES = {
    "duration": 0,
    "vehicle ended": 0,
    "collision": 3,
    "infeasible": 4,
    "no peer": 5,
    "stopped": 128,  # And the signal's number.
}


def say_farewell(send: Callable[[], None]) -> None:
    """Sends a last message again and again for half a second.

    A bus may lose a message, and a DrakeLcm that is busy keeps the first of several
    that come at once: the one before the last.

    Args:
        send: Sends it.
    """
    for _ in range(_TIMES):
        send()
        time.sleep(_PAUSE)


class HardwareProcess:
    """What both processes share: how they end, and what they say on the way.

    Attributes:
        bus: The bus.
        ending: Why `run` ended, one of the keys of `EXIT_STATUSES`; empty before.
        tell: Called with a line whenever something changes.
        progress: Called with a line once a second.
    """

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.ending = ""
        self.tell: Callable[[str], None] = lambda line: None
        self.progress: Callable[[str], None] = lambda line: None
        self._stopping = False
        self._told: dict[str, str] = {}
        self._progress_at = self._missed = 0

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def _forget_the_start(self, inbox: Inbox) -> None:
        """What came before is no loss: nobody listened."""
        self.bus.drain()
        inbox.begin_anew()

    def _tell_change(self, subject: str, text: str, line: str) -> None:
        """Tells a line if the subject's text is another one than before."""
        if self._told.get(subject, "") != text:
            self._told[subject] = text
            self.tell(line)

    def _tell_neighbours(self, neighbours: Neighbours, began: int) -> None:
        """Tells who else is on the bus, after waiting a while since `began` [us]."""
        names = neighbours.listen()
        if names and self.bus.clock.utime() - began > _LONELY:
            line = f"on this bus under other names: {names} (--name chooses)"
            self._tell_change("neighbours", names, line)

    def _tell_progress(
        self, line: Callable[[], str], missed: int, period: float
    ) -> None:
        """Tells once a second how things go, and whether the rate is kept.

        Args:
            line: How things go.
            missed: How many control periods were missed so far.
            period: The control period [s].
        """
        now = self.bus.clock.utime()
        if now - self._progress_at < 1_000_000:
            return
        periods = 1e-6 * (now - self._progress_at) / period
        lately = missed - self._missed
        self._progress_at, self._missed = now, missed
        is_kept = lately <= _MOST_MISSED * periods
        loss = f"the rate is not kept: {lately} of {periods:.0f} periods were missed"
        words = "the rate is kept again" if is_kept else loss
        self._tell_change("rate", "" if is_kept else "missed", words)
        self.progress(line())


def arrivals(inbox: Inbox) -> dict[str, Any]:
    """Returns how messages arrived, and what is known of their sender's clock."""
    clock = inbox.peer_clock
    return {
        "clock_offset_ms": None if clock is None else 1e-3 * clock.offset,
        "clock_steps": 0 if clock is None else clock.steps,
        "accepted": inbox.accepted,
        "lost": inbox.lost,
        "late": inbox.late,
        "rejected": {reason.value: count for reason, count in inbox.rejections.items()},
    }


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
        with naming_user_code(lambda: self.time):
            status = self._simulator.AdvanceTo(time)
        self._receiver.catch_up()
        self.collided = (
            status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )

    def report(self) -> dict[str, Any]:
        """Returns what the motion came to, and how the bus did."""
        scenario, inbox = self.scenario, self._receiver.inbox
        monitor: CollisionMonitor = self.diagram.GetSubsystemByName(COLLISION_MONITOR)
        times, path = self._log("path")
        positions = scenario.vehicle.positions(path)
        distance = np.linalg.norm(positions - np.array(scenario.target), axis=1)
        arrived = distance <= scenario.arrival_distance
        reached_at = float(times[np.argmax(arrived)]) if arrived.any() else None
        heights = monitor.barrier_set.values_along(path, times)
        report: dict[str, Any] = {
            "scenario": scenario.name,
            "outcome": self._outcome(reached_at is not None),
            "time": self.time,
            "reached_at": reached_at,
            "final_distance": float(distance[-1]),
            "min_barrier": float(np.nanmin(heights, initial=np.inf)),
            "round_trip_ms": median_and_p99(self._receiver.round_trip.milliseconds),
            "arrived": arrivals(inbox),
            "changes": self._changes(),
            "deadlines_missed": self.deadlines_missed,
        }
        if self._elapsed > 0.0:
            report["real_time_rate"] = self.time / self._elapsed
        return report

    def _outcome(self, is_there: bool) -> str | None:
        """Returns what became of the motion, None if there was none."""
        if self.mode is VehicleMode.WAITING:
            return None
        if self.collided:
            return "collision"
        return "reached" if is_there else "timeout"

    def _changes(self) -> list[ModeChange]:
        found: list[ModeChange] = []
        times, modes = self._log("mode")
        for when, code in zip(times.tolist(), modes[:, 0].tolist(), strict=True):
            mode = VehicleMode(int(code)).name.lower()
            if not found or found[-1]["mode"] != mode:
                found.append(ModeChange(time=when, mode=mode, reason=""))
        return found

    def _log(self, name: str) -> tuple[Array, Array]:
        """Returns the times and the rows of a log."""
        log = self.diagram.GetSubsystemByName(LOG_PREFIX + name).FindLog(self.context)
        return log.sample_times().copy(), log.data().T.copy()

    def _wait_for_command(self, patience: float) -> bool:
        """Stands until a command comes; returns whether one came."""
        began = self.bus.clock.utime()
        neighbours = Neighbours(self.bus, "VCBF_STATUS")
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
            self._tell_neighbours(neighbours, began)
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
            lambda: f"{self.time:8.1f} s  {mode}  {inbox.accepted} commands",
            self.deadlines_missed,
            self.scenario.period,
        )
