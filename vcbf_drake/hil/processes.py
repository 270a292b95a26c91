"""The processes on a bus: what both share, and the simulated vehicle's."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection
from contextlib import suppress
import math
import time
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import Context

from vcbf_drake.checks import Array
from vcbf_drake.errors import naming_user_code
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.formats import Reason, VehicleMode
from vcbf_drake.hil.vehicle_side import VehicleEnd, make_vehicle
from vcbf_drake.simulation.collision_monitor import (
    COLLISION_MONITOR,
    CollisionMonitor,
)
from vcbf_drake.simulation.loop import LOG_PREFIX
from vcbf_drake.simulation.run import make_simulator
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.summary import arrival

_TIMES, _PAUSE = 10, 0.05  # [s]
# The period of progress lines and of messages of a vehicle without a controller, and
# the silence after which other senders are reported [us].
_SECOND = 1_000_000
# The share of a second's control periods that may be missed without a report.
_MOST_MISSED = 0.1
# The report of missed periods, by the side that missed them.
_MISSED = {
    "ours": ("the rate is not kept", "were missed", "the rate is kept again"),
    "theirs": ("the vehicle is slow", "had no state", "the vehicle keeps the rate"),
}

# The reasons for the end of a process, and its exit status.
EXIT_STATUSES = {
    "duration": 0,
    "vehicle ended": 0,
    "error": 1,
    "collision": 3,
    "infeasible": 4,
    "no peer": 5,
    "stopped": 128,  # And the signal's number.
}


def say_farewell(send: Callable[[], None]) -> None:
    """Sends a last message for half a second, so that at least one copy arrives.

    A bus may lose a message, and a DrakeLcm that is busy keeps the first of several
    that come at once: the one before the last.
    """
    for _ in range(_TIMES):
        send()
        time.sleep(_PAUSE)


class HardwareProcess:
    """The common base of both processes: their end and their reports.

    Args:
        bus: Carries the messages.
        peer: The name of the other side.
        channel: The channel of its messages, without a name.

    Attributes:
        bus: The bus.
        ending: The reason why `run` ended, one of the keys of `EXIT_STATUSES`; empty
            before.
        tell: Called with a line whenever something changes.
        progress: Called with a line once a second.
        changes: The last 1000 modes of the vehicle, or requested of it: `time` since
            the motion began [s], `mode`, and `reason`, empty where none is needed.
    """

    def __init__(self, bus: Bus, peer: str, channel: str) -> None:
        self.bus = bus
        self.ending = ""
        self.tell: Callable[[str], None] = lambda line: None
        self.progress: Callable[[str], None] = lambda line: None
        self.changes: deque[dict[str, Any]] = deque(maxlen=1000)
        self._peer, self._channel, self._stopping = peer, channel, False
        self._told: dict[str, str] = {}
        self._troubled_at = Counter[str]()
        self._neighbours: set[str] = set()
        self._progress_at, self._missed = 0, Counter[str]()

    def run(self, patience: float = math.inf) -> None:
        """Runs in real time to its end or `stop`, and always says farewell.

        Args:
            patience: The time to wait for the other side [s].
        """
        try:
            self._run(patience)
        except BaseException:
            self.ending = "error"
            with suppress(Exception):  # A failed send may fail again.
                self._say_farewell()
            raise
        self._say_farewell()

    def stop(self, *_: object) -> None:
        """Makes `run` end soon; fit to be a signal's handler."""
        self._stopping = True

    def _run(self, patience: float) -> None:
        raise NotImplementedError

    def _say_farewell(self) -> None:
        raise NotImplementedError

    def _wait_for_peer(
        self, go_on: Callable[[], None], is_there: Callable[[], bool], patience: float
    ) -> bool:
        """Waits for the other side; returns whether it was heard."""
        began = self.bus.clock.utime()
        lcm = DrakeLcm(self.bus.lcm.get_lcm_url())
        lcm.SubscribeMultichannel(f"{self._channel}(/.*)?", self._hear_anybody)
        while not is_there():
            if self._stopping:
                self.ending = "stopped"
                return False
            go_on()
            lcm.HandleSubscriptions(0)
            waited = self.bus.clock.utime() - began
            if waited > _SECOND and self._neighbours:
                names = ", ".join(sorted(self._neighbours))
                line = f"on this bus under other names: {names} (--name chooses)"
                self._tell_change("neighbours", names, line)
            if waited > 1e6 * patience and not is_there():
                self.ending = "no peer"
                self.tell(f"no {self._peer} was heard for {patience:g} s")
                return False
        return True

    def _hear_anybody(self, channel: str, data: bytes) -> None:
        if channel != self.bus.channel(self._channel):
            name = channel.partition("/")[2]
            self._neighbours.add(name or "one without a name")

    def _note_mode(self, time: float, mode: str, reason: str = "") -> None:
        """Records a mode at a time of the motion [s], if it is new."""
        if not self.changes or self.changes[-1]["mode"] != mode:
            self.changes.append({"time": time, "mode": mode, "reason": reason})

    def _tell_change(self, subject: str, text: str, line: str) -> None:
        """Reports a subject's text if it has changed.

        An empty text means that the fault is over, which is reported after a second.
        """
        now = self.bus.clock.utime()
        if text:
            self._troubled_at[subject] = now
        elif now - self._troubled_at[subject] < _SECOND:
            return
        if self._told.get(subject, "") != text:
            self._told[subject] = text
            self.tell(line)

    def _tell_progress(
        self, line: Callable[[], str], period: float, **missed: int
    ) -> None:
        """Reports progress once a second, and the side that misses control periods.

        `missed` is the number of control periods of `period` [s] so far, by side.
        """
        now = self.bus.clock.utime()
        if now - self._progress_at < _SECOND:
            return
        periods = 1e-6 * (now - self._progress_at) / period
        for who, count in missed.items():
            lately = count - self._missed[who]
            is_lost = lately > _MOST_MISSED * periods
            what, how, again = _MISSED[who]
            loss = f"{what}: {lately} of {periods:.0f} periods {how}"
            self._tell_change(who, "missed" * is_lost, loss if is_lost else again)
        self._progress_at, self._missed = now, Counter(missed)
        self.progress(line())


def median_and_p99(values: Collection[float] | Array) -> dict[str, float | None]:
    """Returns both percentiles of the values, None where there are none."""
    if not len(values):
        return {"median": None, "p99": None}
    median, p99 = np.percentile(list(values), [50.0, 99.0])
    return {"median": float(median), "p99": float(p99)}


class PlantProcess(HardwareProcess):
    """Simulates a scenario's plant behind a bus: states out, commands in.

    The plant rests at its initial state until the first command arrives.

    Args:
        scenario: A validated scenario.
        bus: Carries the messages.

    Attributes:
        scenario: The scenario of the run.
        diagram: The vehicle.
        collided: Whether a barrier became negative, which ends the motion.
        deadlines_missed: The number of wake-ups that were late by more than a control
            period.
    """

    def __init__(self, scenario: Scenario, bus: Bus) -> None:
        super().__init__(bus, "controller", "VCBF_STATUS")
        self.collided = False
        self.deadlines_missed = 0
        self.scenario = scenario
        self.diagram = make_vehicle(scenario, bus)
        self._end: VehicleEnd = self.diagram.GetSubsystemByName("vehicle_end")
        self._simulator = make_simulator(self.diagram, scenario)
        self._simulator.Initialize()
        self._note_mode(0.0, self.mode.name.lower())
        self._elapsed = 0.0
        self._showed_itself_at: float = -math.inf

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
        """The mode of the vehicle."""
        return self._end.mode(self._end.GetMyContextFromRoot(self.context))

    def _run(self, patience: float) -> None:
        # Not a new session: the states of the start are heard, and were another's.
        inbox = self._end.inbox
        self.bus.poll()
        inbox.begin_anew()
        if self._wait_for_peer(self._stand, lambda: inbox.newest is not None, patience):
            self._end.restart()
            self._move()
        self._elapsed = self._end.time()

    def _say_farewell(self) -> None:
        self._end.ending = True
        say_farewell(lambda: self.diagram.ForcedPublish(self.context))

    def advance_to(self, time: float) -> None:
        """Simulates up to a time [s], unless that is over or the vehicle has collided.

        A command is applied from the first step on that begins after it has come.
        """
        if self.collided or time <= self.time:
            return
        with naming_user_code(lambda: self.time):
            status = self._simulator.AdvanceTo(time)
        self.collided = (
            status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )
        self._note_mode(self.time, self.mode.name.lower())

    def report(self) -> dict[str, Any]:
        """Returns the outcome of the motion, and the report of the bus."""
        scenario, inbox = self.scenario, self._end.inbox
        monitor: CollisionMonitor = self.diagram.GetSubsystemByName(COLLISION_MONITOR)
        log = self.diagram.GetSubsystemByName(LOG_PREFIX + "path").FindLog(self.context)
        times, states = log.sample_times().copy(), log.data().T.copy()
        path = {"time": times, "state": states}
        reached_at, final_distance = arrival(scenario, path)
        heights = monitor.barrier_set.values_along(states, times)
        report: dict[str, Any] = {
            "scenario": scenario.name,
            "outcome": self._outcome(reached_at),
            "time": self.time,
            "reached_at": reached_at,
            "final_distance": final_distance,
            "min_barrier": float(np.nanmin(heights, initial=np.inf)),
            "round_trip_ms": median_and_p99(inbox.round_trips),
            "arrived": inbox.report(),
            "changes": list(self.changes),
            "deadlines_missed": self.deadlines_missed,
        }
        if self._elapsed > 0.0:
            report["real_time_rate"] = self.time / self._elapsed
        return report

    def _outcome(self, reached_at: float | None) -> str | None:
        if self.mode is VehicleMode.WAITING:
            return None  # There was no motion.
        if self.collided:
            return "collision"
        return "timeout" if reached_at is None else "reached"

    def _stand(self) -> None:
        """Sends the waiting vehicle's state, for a control period.

        Once a second while commands answer another vehicle of its name: where both
        speak at once, a receiver that keeps one message would lose the other's.
        """
        now, inbox = self.bus.clock.utime(), self._end.inbox
        self._end.restart()
        since = 1e-6 * (now - inbox.last_rejected_at)
        is_another = inbox.last_rejection == Reason.ADDRESS.value
        is_second = is_another and since < self.scenario.hardware.command_timeout
        if not is_second or now - self._showed_itself_at >= _SECOND:
            self._showed_itself_at = now
            self.diagram.ForcedPublish(self.context)
        self.bus.wait(self._end.utime(self.scenario.period))
        self._say()

    def _move(self) -> None:
        period, duration = self.scenario.period, self.scenario.duration
        tick = 1
        while not (self._stopping or self.collided or self.time >= duration):
            goal = min(tick * period, duration)
            self.bus.wait(self._end.utime(goal))
            self.deadlines_missed += self._end.time() - goal > period
            self.advance_to(min(self._end.time(), goal))
            tick += self.time >= goal
            self._say()
        self.ending = "stopped" if self._stopping else "duration"
        if self.collided:
            self.ending = "collision"

    def _say(self) -> None:
        mode = self.mode.name.lower()
        self._tell_change("mode", mode, f"{self.time:.2f} s: {mode}")
        inbox = self._end.inbox
        complaint = inbox.complaint(self.bus.clock.utime())
        if complaint:
            line = f"{self.time:.2f} s: commands: {complaint}"
            self._tell_change("commands", inbox.last_rejection, line)
        self._tell_progress(
            lambda: f"{self.time:8.1f} s  {mode}  {inbox.accepted} commands",
            self.scenario.period,
            ours=self.deadlines_missed,
        )
