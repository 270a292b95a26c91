"""What a vehicle applies when commands come at any time and it wakes at any time."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
import pytest

from tests.helpers.memory_bus import MemoryLcm
from vcbf_drake import load_scenario
from vcbf_drake.hil import (
    Bus,
    CommandMode,
    InProcess,
    SimulatedClock,
    VehicleMode,
    command_format,
)
from vcbf_drake.hil.messages import vcbf_command
from vcbf_drake.hil.vehicle_side import VehicleEnd

MS = 1000  # In microseconds.
TIMEOUT = 100 * MS
SCENARIO = load_scenario(
    "car-avoidance",
    {
        "input_set": {"lower": [-1e4, -1e4], "upper": [1e4, 1e4]},
        "hardware": {"fallback": "zero", "command_timeout": 1e-6 * TIMEOUT},
    },
)


class Vehicle:
    """A vehicle's end by itself, whose commands carry their number as an input."""

    def __init__(self) -> None:
        self.clock, lcm = SimulatedClock(), MemoryLcm()
        self.bus, self._sender = Bus(lcm, self.clock), Bus(lcm, self.clock)
        self.receiver = VehicleEnd(self.bus, SCENARIO, SCENARIO.make_model())
        self._during: list[tuple[int, VehicleMode]] = []
        self._simulator = Simulator(self.receiver)
        self._simulator.set_monitor(self._note)
        self._context = self._simulator.get_mutable_context()
        self.receiver.GetInputPort("state").FixValue(self._context, np.zeros(4))
        self._start = self.clock.now
        self.clock.now += 1  # A session has begun before its first message.

    def send(self, number: int, mode: CommandMode = CommandMode.APPLY) -> None:
        message = vcbf_command()
        message.mode, message.num_inputs = int(mode), 2
        message.state_session, message.state_utime = self.bus.session, self.clock.now
        message.input = [float(number), 0.0]
        self._sender.send(command_format(2).channel, message)
        self.bus.poll()

    def wait_until(self, instant: int) -> None:
        self.clock.now = max(self.clock.now, self._start + instant)

    def step_to(self, instant: int) -> None:
        self._during.clear()
        self._simulator.AdvanceTo(1e-6 * instant)

    def _note(self, context: Context) -> None:
        u = self.receiver.GetOutputPort("input").Eval(context)
        self._during.append((round(u[0]), self.receiver.mode(context)))

    # During the step: at its end, where something is sent, it looks once more.

    @property
    def applied(self) -> int:
        return self._during[0][0]

    @property
    def mode(self) -> VehicleMode:
        return self._during[0][1]


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    period=st.sampled_from([5, 10, 20]),
    gaps=st.lists(st.integers(200, 30 * MS), min_size=10, max_size=120),
    lateness=st.lists(st.integers(0, 15 * MS), min_size=20, max_size=20),
)
def test_what_was_received_before_a_step_acts_from_the_next_one_on(
    period: int, gaps: list[int], lateness: list[int]
) -> None:
    """Commands at random times, wake-ups late by random times, up to three periods."""
    vehicle = Vehicle()
    arrivals = (np.cumsum(gaps) + 1).tolist()
    received, before = 0, 0
    for tick in range(1, 21):
        goal = tick * period * MS
        wakes_at = goal + lateness[tick - 1]
        while received < len(arrivals) and arrivals[received] <= wakes_at:
            vehicle.wait_until(arrivals[received])
            received += 1
            vehicle.send(received)
        vehicle.wait_until(wakes_at)
        vehicle.step_to(goal)
        begun_at = goal - period * MS
        there = sum(arrival <= begun_at for arrival in arrivals[:received])
        fresh = there == 0 or begun_at - arrivals[there - 1] <= TIMEOUT
        # Everything that the step before could have taken, and all that had come by
        # the beginning of this one.
        if vehicle.mode is VehicleMode.FOLLOWING:
            assert max(before, there) <= vehicle.applied <= received
        elif vehicle.mode is VehicleMode.WAITING:
            assert before == there == 0
        else:
            assert not fresh
        before = received


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    gaps=st.lists(st.integers(200, 400 * MS), min_size=5, max_size=20),
    lateness=st.lists(st.integers(0, 9 * MS), min_size=100, max_size=100),
)
def test_the_watchdog_looks_at_every_step(gaps: list[int], lateness: list[int]) -> None:
    vehicle, period, received = Vehicle(), 10 * MS, 0
    arrivals = (np.cumsum(gaps) + 1).tolist()
    newest = None
    for tick in range(1, 101):
        goal, wakes_at = tick * period, tick * period + lateness[tick - 1]
        passed = newest
        while received < len(arrivals) and arrivals[received] <= wakes_at:
            vehicle.wait_until(arrivals[received])
            newest = arrivals[received]
            received += 1
            vehicle.send(received)
        vehicle.wait_until(wakes_at)
        vehicle.step_to(goal)
        begun_at = goal - period
        due = [a for a in arrivals[:received] if a <= begun_at]
        last = max([*due, *([passed] if passed is not None else [])], default=None)
        expected = VehicleMode.WAITING
        if last is not None:
            is_fresh = begun_at - last <= TIMEOUT
            expected = VehicleMode.FOLLOWING if is_fresh else VehicleMode.FALLBACK
        assert vehicle.mode is expected


@pytest.mark.parametrize("mode", [CommandMode.FALLBACK, CommandMode.END])
def test_wake_ups_that_are_always_late_starve_no_command(mode: CommandMode) -> None:
    """Every wake-up 1 ms late at 100 Hz: 49 reverse commands, then 51 to fall back."""
    vehicle, period = Vehicle(), 10 * MS
    applied, modes = [], []
    for tick in range(101):
        vehicle.wait_until(tick * period + MS)
        vehicle.send(
            100 if tick == 0 else -42, CommandMode.APPLY if tick < 50 else mode
        )
        vehicle.step_to(tick * period)
        applied.append(vehicle.applied)
        modes.append(vehicle.mode)
    assert applied[1] == 100
    assert applied[2:51] == 49 * [-42]
    assert modes[51:] == 50 * [VehicleMode.FALLBACK]
    assert not any(applied[51:])


def test_a_vehicle_that_wakes_late_follows_its_controller() -> None:
    """The whole vehicle: a reverse command acts, and so does the request to stop."""
    run = InProcess(load_scenario("blimp-multiple-obstacles", {"period": 0.01}))
    run.advance_to(0.2)
    run.kill_controller()
    sender = Bus(run.lcm, run.clock)
    receiver = run.plant.diagram.GetSubsystemByName("vehicle_end")
    context = receiver.GetMyContextFromRoot(run.plant.context)
    start = run.clock.now
    for tick in range(1, 101):
        run.clock.now = start + tick * 10 * MS + MS
        message = vcbf_command()
        message.mode = int(CommandMode.APPLY if tick < 50 else CommandMode.FALLBACK)
        message.num_inputs, message.input = 3, [-0.04, 0.0, 0.0]
        message.state_session = run.plant.bus.session
        message.state_utime = run.clock.now
        message.takes_over = True
        sender.send(command_format(3).channel, message)
        run.plant.bus.poll()
        run.plant.advance_to(0.2 + tick * 0.01)
        u = receiver.GetOutputPort("input").Eval(context)
        if 3 <= tick < 50:
            assert u[0] == -0.04
            assert run.plant.mode is VehicleMode.FOLLOWING
        if tick >= 52:
            assert run.plant.mode is VehicleMode.FALLBACK
