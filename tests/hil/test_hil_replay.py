"""Logs of runs on hardware: the controller again, and the result that they tell."""

from __future__ import annotations

import json
from pathlib import Path
import struct

import numpy as np
from pydrake.lcm import DrakeLcm
import pytest
from typer.testing import CliRunner

from tests.helpers.memory_bus import RunningClock
from vcbf_drake import load_scenario, simulate
from vcbf_drake.cli import app
import vcbf_drake.cli.hardware as hardware_module
from vcbf_drake.errors import ScenarioError
from vcbf_drake.hil import (
    Bus,
    CommandMode,
    Event,
    EventLogError,
    EventLogWriter,
    InProcess,
    LinkFaults,
    LoggedController,
    PlantProcess,
    SimulatedClock,
    controller_of,
    read_event_log,
    replay_log,
    start_log,
)
from vcbf_drake.hil.event_log import logged_scenario
from vcbf_drake.hil.messages import vcbf_command, vcbf_status
from vcbf_drake.simulation.loading import dump_scenario
import vcbf_drake.viz.figures as figures_module
import vcbf_drake.viz.replay as replay_module

OWN_ROBOT = Path(__file__).parents[2] / "examples" / "own_robot.py"
BAD_LINK = LinkFaults(drop=0.2, delay=0.03, jitter=0.01)


def scenario(name: str = "blimp-multiple-obstacles", **overrides):
    loaded = load_scenario(name, overrides)
    loaded.hardware.longest_interval = loaded.period
    return loaded


def recorded(loaded, duration: float, **options) -> list[Event]:
    """A controller's log of a run in one process."""
    events: list[Event] = []
    run = InProcess(loaded, tap=lambda *event: events.append(Event(*event)), **options)
    run.advance_to(duration)
    return events


def write(path, events, loaded=None):
    with EventLogWriter(path, force=True) as log:
        if loaded is not None:
            text = dump_scenario(loaded).encode()
            log.tap(events[0].utime, "VCBF_SCENARIO", text)
        for event in events:
            log.tap(*event)
    return path


def driven(loaded, events) -> list[Event]:
    """What a controller sends that the log drives."""
    logged = LoggedController(loaded, events)
    sent: list[Event] = []
    logged.on_start = lambda controller: controller.bus.taps.append(
        lambda *event: sent.append(Event(*event))
    )
    logged.run()
    return sent


def of(events, channel) -> list[bytes]:
    return [event.data for event in events if event.channel == channel]


# The controller again --------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("car-avoidance", {}),
        ("blimp-multiple-obstacles", {"controller_faults": BAD_LINK, "grid": 5}),
    ],
)
def test_a_log_makes_the_same_bytes_again_every_time(name, options) -> None:
    """Commands and statuses, stamps and counters included, of two further runs."""
    loaded = scenario(name, hardware={"predict": True})
    events = recorded(loaded, 2.0, **options)
    first, second = (driven(loaded, events) for _ in range(2))
    for channel in ("VCBF_COMMAND", "VCBF_STATUS"):
        logged = of(events, channel)
        assert len(logged) > 60
        assert of(first, channel) == logged
        assert of(second, channel) == logged
    inputs = {tuple(vcbf_command.decode(d).input) for d in of(first, "VCBF_COMMAND")}
    assert len(inputs) > 50


def test_silence_and_a_controller_that_starts_again_come_out_again() -> None:
    loaded = scenario(hardware={"max_state_age": 0.1, "hold_time": 0.1})
    events: list[Event] = []
    run = InProcess(loaded, tap=lambda *event: events.append(Event(*event)))
    run.advance_to(0.5)
    measured = run.clock.now
    for age in np.arange(0.02, 0.4, 0.02):  # The vehicle is silent.
        run.clock.now = measured + round(1e6 * age)
        run.controller.step()
    run.advance_to(1.2)
    run.start_controller()
    run.advance_to(1.6)
    commands = [vcbf_command.decode(data) for data in of(events, "VCBF_COMMAND")]
    assert {command.mode for command in commands} == {
        CommandMode.APPLY,
        CommandMode.HOLD,
        CommandMode.FALLBACK,
    }
    assert len({command.session for command in commands}) == 2
    again = driven(loaded, events)
    assert of(again, "VCBF_COMMAND") == of(events, "VCBF_COMMAND")


def test_a_log_of_a_clock_that_runs_while_it_is_read_comes_out_again() -> None:
    """States about as old as they may be: what was true then is true again."""
    loaded = scenario("car-avoidance", hardware={"max_state_age": 0.03})
    lcm, clock, events = DrakeLcm("memq://"), RunningClock(), []
    bus, rng = Bus(lcm, clock), np.random.default_rng(5)
    bus.taps.append(lambda *event: events.append(Event(*event)))
    controller = controller_of(loaded, bus)
    vehicle = PlantProcess(loaded, Bus(lcm, clock))
    start = clock.now
    for tick in range(1, 100):
        clock.now = max(clock.now, start + 20_000 * tick)
        vehicle.advance_to(0.02 * tick)
        clock.now += int(rng.integers(10_000, 25_000))
        controller.step()
        vehicle.bus.poll()
    commands = of(events, "VCBF_COMMAND")
    modes = {vcbf_command.decode(data).mode for data in commands}
    assert modes >= {CommandMode.APPLY, CommandMode.HOLD}
    assert of(driven(loaded, events), "VCBF_COMMAND") == commands


def test_a_controller_that_was_not_followed_comes_out_again() -> None:
    """Of most of its ticks there is a status alone, until it is followed."""
    loaded = scenario("car-avoidance")
    run = InProcess(loaded)
    run.advance_to(0.5)
    run.clock.now += 1
    events: list[Event] = []
    bus = Bus(run.lcm, run.clock)
    bus.taps.append(lambda *event: events.append(Event(*event)))
    second = controller_of(loaded, bus)
    for tick in range(26, 180):
        if tick == 120:
            run.kill_controller()
        run.advance_to(0.02 * tick)
        second.step()
        run.plant.bus.poll()
    commands = of(events, "VCBF_COMMAND")
    assert 50 < len(commands) < 80
    assert of(driven(loaded, events), "VCBF_COMMAND") == commands


def test_a_stranger_on_the_bus_changes_nothing_of_what_a_vehicles_log_tells() -> None:
    """Its command is the first to a state, and the vehicle does not take it."""
    loaded, lcm, clock = scenario("car-avoidance"), DrakeLcm("memq://"), RunningClock()
    vehicle = PlantProcess(loaded, Bus(lcm, clock))
    events: list[Event] = []
    vehicle.bus.taps.append(lambda *event: events.append(Event(*event)))
    controllers = [controller_of(loaded, Bus(lcm, clock))]
    start = clock.now
    for tick in range(1, 60):
        clock.now = max(clock.now, start + 20_000 * tick)
        if tick == 20:
            controllers.insert(0, controller_of(loaded, Bus(lcm, clock)))
        vehicle.advance_to(0.02 * tick)
        for controller in controllers:
            controller.step()
            vehicle.bus.poll()
    stranger, followed = (controller.bus.session for controller in controllers)
    sessions = [vcbf_command.decode(d).session for d in of(events, "VCBF_COMMAND")]
    assert stranger > followed and {stranger, followed} == set(sessions)
    logged = LoggedController(loaded, events)
    logged.run()
    assert len(logged.controllers) == 1
    count = sessions.count(followed)
    expected = {"logged": count, "same": count, "largest_difference": 0.0}
    assert logged.report()["commands"] == expected


def test_a_log_without_commands_has_every_state_acted_on() -> None:
    loaded = scenario("car-avoidance")
    events = recorded(loaded, 1.0)
    states = [event for event in events if event.channel == "VCBF_STATE"]
    sent = driven(loaded, states)
    inputs = [vcbf_command.decode(data).input for data in of(sent, "VCBF_COMMAND")]
    logged = [vcbf_command.decode(data).input for data in of(events, "VCBF_COMMAND")]
    assert inputs == logged


def test_commands_of_another_filter_are_told_from_ours(tmp_path) -> None:
    """The report can say no: one input changed in its last bit, one mode."""
    loaded = scenario("car-avoidance")
    events = recorded(loaded, 1.0)
    assert replay_log(write(tmp_path / "a.log", events), loaded).report["commands"] == {
        "logged": 51,
        "same": 51,
        "largest_difference": 0.0,
    }
    places = [k for k, event in enumerate(events) if event.channel == "VCBF_COMMAND"]
    changed = vcbf_command.decode(events[places[20]].data)
    changed.input = [np.nextafter(changed.input[0], 9.0), *changed.input[1:]]
    events[places[20]] = events[places[20]]._replace(data=changed.encode())
    found = replay_log(write(tmp_path / "b.log", events), loaded).report["commands"]
    assert found["same"] == 50
    assert 0.0 < found["largest_difference"] < 1e-15
    other = vcbf_command.decode(events[places[30]].data)
    other.mode = CommandMode.FALLBACK
    events[places[30]] = events[places[30]]._replace(data=other.encode())
    found = replay_log(write(tmp_path / "c.log", events), loaded).report["commands"]
    assert (found["same"], found["largest_difference"]) == (49, np.inf)


# The result ------------------------------------------------------------------------


def test_the_result_of_a_log_is_that_of_the_simulation(tmp_path) -> None:
    """A run without faults is the simulation, and so is what its log tells."""
    loaded = scenario("car-avoidance", duration=4.0)
    path = write(tmp_path / "a.log", recorded(loaded, 4.0), loaded)
    found, expected = replay_log(path).result, simulate(loaded)
    ticks = len(found.log["time"])
    assert ticks >= len(expected.log["time"]) - 1
    assert found.log.keys() == expected.log.keys() - {"audit"}
    for name in found.log.keys() - {"disturbance"}:
        np.testing.assert_allclose(
            found.log[name], expected.log[name][:ticks], atol=2e-7, err_msg=name
        )
    # At either end there are states on one side only.
    true = expected.log["disturbance"][1 : ticks - 1, 0]
    np.testing.assert_allclose(found.log["disturbance"][1:-1, 0], true, atol=1e-4)
    assert np.ptp(true) > 0.05
    measured = {"step_cpu_ms", "real_time_factor", "assumptions"}
    audited = {  # Needs the truth.
        "audit", "certified_min_barrier", "guaranteed", "reasons_against",
    }  # fmt: skip
    for name in expected.summary.keys() - measured - audited:
        same = found.summary[name] == expected.summary[name]
        close = name in ("min_barrier", "final_distance", "min_volume", "reached_at")
        assert same or close, name
    for name in ("min_barrier", "final_distance", "reached_at"):
        value = expected.summary[name]
        assert found.summary[name] == (
            None if value is None else pytest.approx(value, abs=0.02)
        )
    assert found.summary["real_time_factor"] == pytest.approx(1.0)


def test_a_collision_is_found_in_the_states_of_a_vehicle_s_log(tmp_path) -> None:
    loaded = scenario("car-avoidance", hardware={"fallback": "zero"})
    events: list[Event] = []
    run = InProcess(loaded)
    run.plant.bus.taps.append(lambda *event: events.append(Event(*event)))
    run.advance_to(2.0)
    run.kill_controller()
    run.advance_to(20.0)
    run.plant.diagram.ForcedPublish(run.plant.context)  # Its last word.
    found = replay_log(write(tmp_path / "a.log", events), loaded)
    assert run.plant.collided
    assert found.result.summary["outcome"] == "collision"
    assert found.result.summary["collided_at"] == run.plant.time
    assert found.result.log["time"][-1] == pytest.approx(2.0)  # Then nobody acted.


def test_a_truncated_log_tells_what_it_has(tmp_path) -> None:
    loaded = scenario("car-avoidance")
    path = write(tmp_path / "a.log", recorded(loaded, 1.0), loaded)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    found = replay_log(path)
    assert "no whole events" in found.damage
    assert 10 < len(found.result.log["time"]) < 40


# What cannot be replayed -----------------------------------------------------------


def test_a_log_that_does_not_fit_is_refused_in_one_line(tmp_path) -> None:
    loaded = scenario("car-avoidance")
    events = recorded(loaded, 0.5)
    path = write(tmp_path / "a.log", events)
    with pytest.raises(EventLogError, match=r"a\.log: carries no scenario; it must be"):
        replay_log(path)
    with pytest.raises(
        EventLogError,
        match=r"no state of blimp-multiple-obstacles on VCBF_STATE, with 8 numbers and"
        r" 3 inputs \(26 array of another size\)",
    ):
        replay_log(path, scenario())
    write(path, [Event(1, "OTHER", b"")])
    with pytest.raises(EventLogError, match=r"\(nothing on that channel\)"):
        replay_log(path, loaded)
    write(path, [Event(1, "VCBF_SCENARIO", b"{a: {perod: 1}}\n")])
    with pytest.raises(ScenarioError, match="channel VCBF_SCENARIO:1: perod: unknown"):
        replay_log(path)


def spoiled(rng, events):
    """The events with up to three of them lost, moved, renamed, stamped or altered."""
    events = list(events)
    for _ in range(rng.integers(1, 4)):
        place, kind = rng.integers(len(events)), rng.integers(6)
        event = events.pop(place)
        if kind == 0 and events:
            continue
        if kind == 1:
            place = rng.integers(len(events) + 1)
        elif kind == 2:
            channel = rng.choice(["VCBF_STATE", "VCBF_COMMAND", "VCBF_STATUS", "OTHER"])
            event = event._replace(channel=str(channel))
        elif kind == 3:
            extreme = rng.choice([-(2**63), -1, 0, 10**15, 2**63 - 1])
            event = event._replace(utime=int(extreme))
        elif event.data:
            data = bytearray(event.data)
            start = 8 * rng.integers(len(data) // 8)
            if kind == 4:
                data[start] ^= 1 << rng.integers(8)
            else:
                number = rng.choice([np.nan, 0.0, -9e5, 1e-300, 1e300])
                data[start : start + 8] = struct.pack(">d", number)
            event = event._replace(data=bytes(data[: len(event.data)]))
        events.insert(place, event)
    return events


def test_a_log_of_a_vehicle_of_one_s_own_asks_for_its_scenario() -> None:
    said = [Event(1, "VCBF_SCENARIO", b"vehicle: !Puck {}\n")]
    with pytest.raises(ScenarioError, match=r"of your own needs its SCENARIO$"):
        logged_scenario("puck.log", said)


def test_a_log_of_a_vehicle_of_one_s_own_is_replayed_with_its_scenario(
    tmp_path, monkeypatch, capfd
) -> None:
    """Who writes the log says that it will be needed."""
    own = str(OWN_ROBOT)
    bus = Bus(DrakeLcm("memq://"), SimulatedClock())
    monkeypatch.setattr(hardware_module, "_open_bus", lambda *options: bus)
    monkeypatch.setattr(hardware_module, "_run", lambda *arguments: 0)
    path = tmp_path / "a.log"
    CliRunner().invoke(app, ["plant", own, "--log", str(path)])
    said = capfd.readouterr().err
    assert said.endswith(f"is your own: vcbf-drake replay-log {path} SCENARIO\n")
    loaded = load_scenario(OWN_ROBOT)
    write(path, recorded(loaded, 0.5), loaded)
    told = replay_log(path, load_scenario(OWN_ROBOT)).report["commands"]
    assert told["same"] == told["logged"] > 20


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0])
def test_another_period_than_the_log_s_is_said(factor, tmp_path) -> None:
    loaded = scenario("car-avoidance")
    path = write(tmp_path / "a.log", recorded(loaded, 0.3), loaded)
    other = f"{{period: {factor * loaded.period}}}"
    arguments = ["replay-log", str(path), "car-avoidance", "--override", other]
    out = ["--out", str(tmp_path / "out"), "--no-replay", "--no-figures"]
    found = CliRunner().invoke(app, [*arguments, *out])
    assert found.exit_code == 0, found.output
    period = f"the control period is {1e3 * factor * loaded.period:.4g} ms"
    assert f"commands are 20 ms apart, and {period}" in found.output
    assert '--override "{period: 0.02}"' in found.output


def test_a_spoiled_log_ends_in_a_result_or_in_one_line(tmp_path) -> None:
    loaded, rng = scenario("car-avoidance"), np.random.default_rng(8)
    events, told = recorded(loaded, 0.2), 0
    for _ in range(20):
        path = write(tmp_path / "a.log", spoiled(rng, events), loaded)
        try:
            log = replay_log(path).result.log
        except EventLogError as error:
            assert str(error).isprintable()
            continue
        inputs = loaded.input_set.input_set()
        assert all(inputs.contains(u, 1e-9) for u in log["input"])
        told += 1
    assert told > 10


# The commands ----------------------------------------------------------------------


def test_start_log_carries_the_scenario(tmp_path) -> None:
    loaded = scenario("car-avoidance", duration=3.5)
    run = InProcess(loaded)
    with start_log(run.controller.bus, loaded, tmp_path / "a.log"):
        run.advance_to(0.2)
    events, damage = read_event_log(tmp_path / "a.log")
    assert events[0].channel == "VCBF_SCENARIO"
    assert {event.channel for event in events[1:]} == {
        "VCBF_STATE",
        "VCBF_COMMAND",
        "VCBF_STATUS",
    }
    assert not damage
    assert replay_log(tmp_path / "a.log").result.scenario.duration == 3.5


@pytest.mark.parametrize("side", ["plant", "controller"])
def test_both_sides_log_what_they_say_and_what_was_asked(
    side, tmp_path, monkeypatch, capfd
) -> None:
    bus = Bus(DrakeLcm("memq://"), SimulatedClock())
    monkeypatch.setattr(hardware_module, "_open_bus", lambda *options: bus)
    monkeypatch.setattr(
        hardware_module, "_run", lambda *arguments: bus.publish("A", b"b")
    )
    path = tmp_path / "a.log"
    arguments = [side, "car-avoidance", "--duration", "3", "--log", str(path)]
    predicts = ["--override", "{hardware: {predict: true}}"]
    arguments += predicts if side == "controller" else []
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 0, found.output
    assert capfd.readouterr().err == f"log written to {path}\n"
    events = read_event_log(path)[0]
    assert events[-1] == Event(bus.clock.utime(), "A", b"b")
    # The vehicle's first state is sent when it is made.
    assert ("VCBF_STATE" in {event.channel for event in events}) is (side == "plant")
    loaded = logged_scenario(path, events)
    assert loaded.duration == 3.0
    assert loaded.hardware.predict is (side == "controller")
    nowhere = str(tmp_path / "none" / "a.log")
    found = CliRunner().invoke(app, [side, "car-avoidance", "--log", nowhere])
    assert found.exit_code == 2
    assert "No such file or directory" in " ".join(found.output.split())


def test_replay_log_writes_what_run_writes(tmp_path, monkeypatch) -> None:
    drawn = []
    monkeypatch.setattr(
        figures_module, "write_figures", lambda results, directory: drawn.append("png")
    )
    monkeypatch.setattr(
        replay_module, "write_replay", lambda results, path: drawn.append(path.name)
    )
    loaded = scenario("car-avoidance", duration=1.0)
    path = write(tmp_path / "flight.log", recorded(loaded, 1.0), loaded)
    with open(path, "ab") as file:
        file.write(b"tail")
    out = tmp_path / "out"
    arguments = ["replay-log", str(path), "--out", str(out)]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 0, found.output
    words = " ".join(found.output.split())
    assert "51 of 51 logged ones came out again bit for bit" in words
    assert "4 of its" in words
    assert drawn == ["png", "replay.html"]
    assert json.loads((out / "summary.json").read_text())["outcome"] == "timeout"
    assert (out / "scenario.yaml").exists()
    statuses = of(read_event_log(path)[0], "VCBF_STATUS")
    with np.load(out / "log.npz") as log:
        volumes = [vcbf_status.decode(data).volume for data in statuses]
        assert log["volume"].tolist() == volumes


def test_replay_log_says_in_one_line_what_is_wrong(tmp_path) -> None:
    (tmp_path / "a.log").write_bytes(b"text")
    found = CliRunner().invoke(app, ["replay-log", str(tmp_path / "a.log")])
    assert found.exit_code == 2
    assert "not an LCM log: no event in its 4 bytes" in found.output
    assert not (tmp_path / "out").exists()
