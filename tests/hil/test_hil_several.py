"""Several vehicles and controllers on one bus; signs of life; perceived obstacles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.lcm import DrakeLcm
import pytest

from tests.helpers.memory_bus import OneSlotLcm, RunningClock
from tests.helpers.relayed_loop import RelayedLoop
from vcbf_drake import load_scenario, simulate
from vcbf_drake.errors import UserCodeError
from vcbf_drake.hil import (
    Bus,
    CommandMode,
    InProcess,
    LinkFaults,
    PlantProcess,
    Reason,
    SimulatedClock,
    VehicleMode,
    controller_of,
)
from vcbf_drake.hil.messages import (
    vcbf_command,
    vcbf_obstacles,
    vcbf_state,
    vcbf_status,
)

ROOT = Path(__file__).parents[2]
CAR, BLIMP = "car-avoidance", "blimp-multiple-obstacles"


def path(run: InProcess) -> bytes:
    log = run.plant.diagram.GetSubsystemByName("log_path").FindLog(run.plant.context)
    return log.data().tobytes()


def heard(lcm: DrakeLcm, kind, channel: str = ""):
    """What is published on a channel, in a list that grows."""
    found: list = []
    channel = channel or kind.__name__.upper()
    lcm.Subscribe(channel, lambda data: found.append(kind.decode(data)))
    return found


# Names -----------------------------------------------------------------------------


@pytest.mark.parametrize("names", [(CAR, BLIMP), (CAR, CAR)])
def test_two_pairs_on_one_bus_do_what_each_does_alone_bit_for_bit(names) -> None:
    alone = [InProcess(load_scenario(name)) for name in names]
    lcm = DrakeLcm("memq://")
    together = [
        InProcess(load_scenario(name), name=f"vehicle-{index}", lcm=lcm)
        for index, name in enumerate(names)
    ]
    for tick in range(1, 101):
        for run in (*alone, *together):
            run.advance_to(0.02 * tick)
    assert [path(run) for run in together] == [path(run) for run in alone]
    for run in together:
        assert not run.controller.report()["arrived"]["rejected"]
        assert not run.plant.report()["arrived"]["rejected"]


# The same name ---------------------------------------------------------------------


def test_a_second_vehicle_of_the_name_is_neither_controlled_nor_does_it_obey() -> None:
    """Somebody starts another one by mistake: the first flies as if alone."""
    alone, run = InProcess(load_scenario(CAR)), InProcess(load_scenario(CAR))
    statuses = heard(run.lcm, vcbf_status)
    alone.advance_to(2.0)
    run.advance_to(0.5)
    second = PlantProcess(load_scenario(CAR), Bus(run.lcm, run.clock))
    for tick in range(26, 101):
        run.advance_to(0.02 * tick)
        second.diagram.ForcedPublish(second.context)
        run.controller.step()
        second.bus.poll()
        second.advance_to(0.02 * (tick - 25))
    assert second.mode is VehicleMode.WAITING
    assert second.report()["arrived"]["rejected"] == {Reason.ADDRESS.value: 75}
    assert statuses[-1].mode == CommandMode.APPLY
    assert statuses[-1].reason == (
        "another vehicle of this name speaks and is not controlled"
    )
    assert path(run) == path(alone)
    # Its end is not the end of the one that is controlled.
    second._end.ending = True
    second.diagram.ForcedPublish(second.context)
    run.controller.step()
    assert not run.controller._is_over()


def test_a_vehicle_is_one_sender_from_its_first_state_to_its_last() -> None:
    """Also of what it says while it loads: a controller that waits hears that."""
    lcm, clock = DrakeLcm("memq://"), SimulatedClock()
    states: list[vcbf_state] = []
    lcm.Subscribe("VCBF_STATE", lambda data: states.append(vcbf_state.decode(data)))
    vehicle = PlantProcess(load_scenario(CAR), Bus(lcm, clock))
    lcm.HandleSubscriptions(0)
    clock.now += 500_000
    vehicle.stop()
    vehicle.run()
    lcm.HandleSubscriptions(0)
    assert states[0].mode == VehicleMode.WAITING
    assert states[-1].mode == VehicleMode.ENDED
    assert len({state.session for state in states}) == 1


def test_a_second_controller_is_not_followed_and_both_say_so() -> None:
    run = InProcess(load_scenario(CAR))
    run.advance_to(0.5)
    run.clock.now += 1
    second = controller_of(load_scenario(CAR), Bus(run.lcm, run.clock))
    statuses = heard(run.lcm, vcbf_status)
    for tick in range(26, 60):
        run.advance_to(0.02 * tick)
        second.step()
        run.plant.bus.poll()
    assert run.plant.mode is VehicleMode.FOLLOWING
    # Once a second it shows itself, so that the vehicle can say so, too.
    assert run.plant.report()["arrived"]["rejected"] == {Reason.SESSION.value: 1}
    mine = [s for s in statuses if s.session == run.controller.bus.session]
    others = [s for s in statuses if s.session == second.bus.session]
    assert all(s.followed and not s.reason for s in mine)
    assert not any(s.followed for s in others)
    assert others[-1].reason == (
        f"the vehicle follows another controller, {run.controller.bus.session}"
    )
    # It takes over when the first falls silent, and the first comes back likewise.
    first = run.controller
    run.kill_controller()
    for tick in range(60, 80):
        run.advance_to(0.02 * tick)
        second.step()
        run.plant.bus.poll()
    assert statuses[-1].followed
    run.controller = first
    run.advance_to(2.0)
    assert statuses[-1].followed
    assert statuses[-1].session == first.bus.session


def test_a_second_controller_does_not_talk_the_first_one_down() -> None:
    """Both answer a state at once, the second always first, into one slot."""
    clock, ends = SimulatedClock(), []
    loaded = load_scenario(CAR)
    first, vehicle = (
        make(loaded, Bus(OneSlotLcm(ends), clock))
        for make in (controller_of, PlantProcess)
    )
    statuses: list[vcbf_status] = []
    ear = OneSlotLcm(ends)
    ear.Subscribe("VCBF_STATUS", lambda data: statuses.append(vcbf_status.decode(data)))
    vehicle.diagram.ForcedPublish(vehicle.context)
    controllers, epoch = [first], clock.now
    for tick in range(150):
        clock.now = epoch + round(2e4 * tick)
        vehicle.advance_to(0.02 * tick)
        if tick == 10:
            controllers.insert(0, controller_of(loaded, Bus(OneSlotLcm(ends), clock)))
        for controller in controllers:
            controller.step()
        ear.HandleSubscriptions(0)
        vehicle.bus.poll()
    report = vehicle.report()
    assert [change["mode"] for change in report["changes"]] == ["waiting", "following"]
    assert report["arrived"]["rejected"] == {Reason.SESSION.value: 3}
    assert report["arrived"]["lost"] <= 3
    assert first.diagram.GetSubsystemByName("state_receiver").is_followed


def test_a_controller_that_no_vehicle_obeys_says_so() -> None:
    """Its commands do not arrive, or the vehicle may not move yet."""
    run = InProcess(load_scenario(CAR), LinkFaults(drop=1.0))
    said: list[str] = []
    run.controller.tell = said.append
    for _ in range(50):  # The vehicle stands, and speaks.
        run.clock.now += 20_000
        run.plant.diagram.ForcedPublish(run.plant.context)
        run.controller.step()
        run.controller._say()
        run.plant.bus.poll()
    assert run.plant.mode is VehicleMode.WAITING
    words = "the vehicle tells of no command that it has accepted"
    assert said == ["0.00 s: apply", f"0.00 s: {words}"]
    assert run.controller._sender.last_status.reason == words


def test_who_was_overruled_keeps_quiet_though_it_took_over_itself() -> None:
    run = InProcess(load_scenario(CAR))
    commands = heard(run.lcm, vcbf_command)
    run.advance_to(0.5)
    run.clock.now += 1
    second = controller_of(load_scenario(CAR), Bus(run.lcm, run.clock))
    for controller in (run.controller, second):
        controller.diagram.GetSubsystemByName("command_sender").takes_over = True
    for tick in range(26, 60):
        run.advance_to(0.02 * tick)
        second.step()
        run.plant.bus.poll()
    sessions = [command.session for command in commands[26:]]
    assert sessions.count(second.bus.session) == 34
    assert sessions.count(run.controller.bus.session) <= 3


def test_a_standby_is_followed_from_the_first_one_s_farewell_on() -> None:
    run = InProcess(load_scenario(CAR))
    run.advance_to(0.5)
    run.clock.now += 1
    second = controller_of(load_scenario(CAR), Bus(run.lcm, run.clock))
    for tick in range(26, 50):
        # Its last words are said again and again.
        leaves = tick > 45
        run.controller.diagram.GetSubsystemByName("command_sender").ending = leaves
        run.advance_to(0.02 * tick)
        second.step()
        run.plant.bus.poll()
    modes = [change["mode"] for change in run.plant.report()["changes"]]
    assert modes == ["waiting", "following", "fallback", "following"]
    assert second.diagram.GetSubsystemByName("state_receiver").is_followed


def test_a_controller_that_takes_over_openly_is_followed_at_once() -> None:
    run = InProcess(load_scenario(CAR))
    run.advance_to(0.5)
    run.clock.now += 1
    second = controller_of(load_scenario(CAR), Bus(run.lcm, run.clock))
    sender = second.diagram.GetSubsystemByName("command_sender")
    sender.takes_over = True
    statuses = heard(run.lcm, vcbf_status)
    for tick in range(26, 30):
        run.advance_to(0.02 * tick)
        second.step()
        run.plant.bus.poll()
    assert [s.followed for s in statuses if s.session == second.bus.session][-1]
    assert not [s.followed for s in statuses if s.session != second.bus.session][-1]


@pytest.mark.parametrize("kind", [vcbf_command, vcbf_state])
def test_one_stray_farewell_ends_nothing(kind) -> None:
    """Of a newer session, well formed: END to the vehicle, mode 3 to the controller."""
    alone, run = InProcess(load_scenario(CAR)), InProcess(load_scenario(CAR))
    last = heard(run.lcm, kind)
    alone.advance_to(1.0)
    run.advance_to(0.5)
    stray = last[-1]
    stray.session, stray.sequence = run.clock.now, 0
    stray.mode = 3
    run.lcm.Publish(kind.__name__.upper(), stray.encode())
    run.advance_to(1.0)
    assert path(run) == path(alone)
    assert not run.controller._is_over()


def test_the_end_of_its_own_vehicle_ends_a_controller() -> None:
    run = InProcess(load_scenario(CAR))
    run.advance_to(0.2)
    run.plant.diagram.GetSubsystemByName("vehicle_end").ending = True
    run.plant.diagram.ForcedPublish(run.plant.context)
    run.controller.run()
    assert run.controller.ending == "vehicle ended"


# Signs of life ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: None, "no state yet"),
        (
            lambda m: _set(m, sequence=m.sequence + 10**9),
            "no state yet; 25 rejected, the last: contradictory time stamps or"
            " sequence",
        ),
        (
            lambda m: _set(m, utime=m.utime + 10**8, utime_measured=m.utime + 10**8),
            "no state yet; 25 rejected, the last: from the future (its clock is 100.0 s"
            " ahead; max_clock_offset is 60 s)",
        ),
        (
            lambda m: _set(m, num_states=3, state=[0.0] * 3),
            "no state yet; 25 rejected, the last: array of another size (num_states is"
            " 3, not 4)",
        ),
        (
            lambda m: _set(m, version=1),
            "no state yet; 25 rejected, the last: unknown version (1, ours is 2)",
        ),
    ],
)
def test_a_status_says_from_the_start_why_nothing_happens(change, words) -> None:
    def relay(message):
        return change(message) if hasattr(message, "state") else message

    run = RelayedLoop(load_scenario(CAR), relay)
    statuses, said = [], []
    run.controller.tell = said.append
    run.controller.bus.taps.append(
        lambda utime, channel, data: statuses.append((channel, data))
    )
    for tick in range(1, 25):
        run.advance_to(0.02 * tick)
        run.plant.diagram.ForcedPublish(run.plant.context)
        run.controller._say()
    found = [vcbf_status.decode(d) for c, d in statuses if c == "VCBF_STATUS"]
    assert len(found) >= 20
    last = found[-1]
    assert (last.state_sequence, last.mode) == (-1, CommandMode.FALLBACK)
    number = [word for word in last.reason.split() if word.isdigit()]
    assert last.reason.replace(number[0] if number else "25", "25", 1) == words
    assert not any(c == "VCBF_COMMAND" for c, _ in statuses)
    assert run.plant.mode is VehicleMode.WAITING
    assert 1 <= len(said) <= 2
    assert said[-1].startswith("fallback, no state yet")


def _set(message, **values):
    for name, value in values.items():
        setattr(message, name, value)
    return message


def test_a_constant_offset_of_seconds_changes_nothing() -> None:
    """The vehicle's clock is 5 s ahead: the same motion; the report says how far."""
    alone = InProcess(load_scenario(CAR))
    alone.advance_to(1.0)
    ahead = 5_000_000
    run = RelayedLoop(
        load_scenario(CAR),
        lambda m: _set(
            m,
            session=m.session + ahead,
            utime=m.utime + ahead,
            **(
                {"utime_measured": m.utime_measured + ahead}
                if hasattr(m, "utime_measured")
                else {}
            ),
        ),
        lambda m: _set(
            m,
            state_session=m.state_session - ahead,
            state_utime=m.state_utime - ahead,
        ),
    )
    run.advance_to(1.0)
    assert path(run) == path(alone)
    arrived = run.controller.report()["arrived"]
    assert arrived["clock_offset_ms"] == 5000.0
    assert arrived["rejected"] == {}


def test_a_rate_that_is_not_kept_is_said_and_when_it_is_again() -> None:
    """Of three states two are lost for two seconds: the periods have no command."""
    count = 0

    def relay(message):
        nonlocal count
        count += 1
        is_lost = hasattr(message, "state") and 1.0 < message.time < 3.0
        return None if is_lost and count % 3 else message

    run = RelayedLoop(load_scenario(CAR), relay)
    said: list[str] = []
    run.controller.tell = said.append
    for tick in range(250):
        run.advance_to(0.02 * tick)
        run.controller._say()
    found = [line for line in said if "rate" in line]
    assert len(found) == 2
    number = int(found[0].split(": ")[1].split()[0])
    assert found[0] == f"the rate is not kept: {number} of 50 periods were missed"
    assert 25 < number < 40
    assert found[1] == "the rate is kept again"


def test_a_slow_vehicle_is_not_called_a_slow_controller() -> None:
    """Every state is answered; of each second period the vehicle tells nothing."""
    slow = load_scenario(CAR, {"period": 0.04})
    run = RelayedLoop(slow, lambda message: message, known=load_scenario(CAR))
    said: list[str] = []
    run.controller.tell = said.append
    for tick in range(100):
        run.advance_to(0.04 * tick)
        run.controller._say()
    rates = [line for line in said if "rate" in line or "slow" in line]
    assert rates == ["the vehicle is slow: 25 of 50 periods had no state"]
    assert run.controller.report()["deadlines_missed"] == 0


def test_a_second_vehicle_of_the_name_speaks_once_a_second() -> None:
    """What speaks as often as the first displaces that one's states on a real bus."""
    lcm, clock = DrakeLcm("memq://"), RunningClock()
    vehicle = PlantProcess(load_scenario(CAR), Bus(lcm, clock))
    controller, states = Bus(lcm, clock), heard(lcm, vcbf_state)
    begin = clock.now
    while clock.now < begin + 3_000_000:
        vehicle._stand()
    lcm.HandleSubscriptions(0)
    alone = len(states)
    command = vcbf_command()
    command.state_session, command.num_inputs, command.input = 5, 2, [0.0, 0.0]
    begin = clock.now
    while clock.now < begin + 3_000_000:
        controller.send("VCBF_COMMAND", command)
        vehicle._stand()
    lcm.HandleSubscriptions(0)
    assert alone > 60
    assert 3 <= len(states) - alone <= 5


def test_a_controller_that_fails_says_farewell_first() -> None:
    run = InProcess(load_scenario(CAR))
    run.advance_to(0.5)

    def fail(context: object) -> None:
        raise RuntimeError("out of fuel")

    run.controller.tick_taps.append(fail)
    run.clock.now += 20_000
    run.plant.advance_to(0.52)
    with pytest.raises(UserCodeError, match=r"test_hil_several.py:\d+: RuntimeError"):
        run.controller.run()
    assert run.controller.ending == "error"
    assert run.controller.mode is CommandMode.END
    run.plant.bus.poll()
    run.plant.advance_to(0.54)
    assert run.plant.mode is VehicleMode.FALLBACK


# Perceived obstacles ---------------------------------------------------------------


def seeing(**hardware):
    settings = {"obstacles": "perceived", "most_obstacles": 3, **hardware}
    return load_scenario(CAR, {"hardware": settings})


def test_what_is_perceived_is_what_the_filter_avoids() -> None:
    """The path is that of the obstacle known; without the obstacle it is another."""

    def unseen(message):
        if hasattr(message, "radius"):
            return _set(message, valid=[False] * len(message.valid))
        return message

    runs = [
        RelayedLoop(load_scenario(CAR), lambda m: m),
        RelayedLoop(seeing(), lambda m: m),
        RelayedLoop(seeing(), unseen),
    ]
    for run in runs:
        run.advance_to(6.0)
        assert run.controller.mode is CommandMode.APPLY
    known, seen, blind = (run.plant.report() for run in runs)
    assert seen["outcome"] == known["outcome"]
    assert seen["min_barrier"] == pytest.approx(known["min_barrier"], abs=0.02)
    assert blind["min_barrier"] < 0.5 * known["min_barrier"]


def obstacles(message, count: int):
    """The first obstacle, so many times."""
    k = len(message.position) // len(message.radius)
    return _set(
        message,
        num_obstacles=count,
        radius=[message.radius[0]] * count,
        valid=[True] * count,
        num_coordinates=k * count,
        position=list(message.position[:k]) * count,
        velocity=list(message.velocity[:k]) * count,
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda m: obstacles(m, 4),
            "4 obstacles are perceived, and there is room for 3",
        ),
        (lambda m: _set(m, radius=[-1.0]), "has a negative radius"),
        (
            lambda m: _set(obstacles(m, 2), num_obstacles=1),
            "the 1 obstacles that are perceived have 4 coordinates; it must be 2 each",
        ),
        (lambda m: None, "no obstacles have been perceived yet"),
    ],
)
def test_what_cannot_be_perceived_leads_to_the_fallback(change, words) -> None:
    def relay(message):
        return change(message) if hasattr(message, "radius") else message

    run = RelayedLoop(seeing(), relay)
    run.advance_to(0.5)
    assert run.controller.mode is CommandMode.FALLBACK
    assert words in run.controller.report()["changes"][-1]["reason"]


def test_what_the_filter_cannot_satisfy_is_said_where_it_does_not_stop() -> None:
    """For 0.4 s an obstacle is where the car is; the least violation is applied."""

    def relay(message):
        if hasattr(message, "radius") and message.time < 0.4:
            message.position = [0.0] * message.num_coordinates
        return message

    loaded = seeing()
    loaded.infeasible = "least_violation"
    run = RelayedLoop(loaded, relay)
    said: list[str] = []
    run.controller.tell = said.append
    reasons = set()
    for tick in range(150):
        run.advance_to(0.02 * tick)
        run.controller._say()
        status = run.controller._sender.last_status
        assert status.mode == CommandMode.APPLY
        names = ", ".join(status.conflicts)
        assert status.reason == (f"no input satisfies {names}" if names else "")
        reasons.add(status.reason)
    assert {"", "no input satisfies seen obstacle 0"} <= reasons
    found = [line for line in said if "satisf" in line or "well" in line]
    assert len(found) == 2
    assert found[0] == "0.00 s: no input satisfies seen obstacle 0"
    assert found[1].endswith(" s: all is well again")


def test_the_count_of_obstacles_may_change_and_old_ones_are_not_acted_on() -> None:
    counts = iter([1, 2, 3, 0, 1, 3, 2])

    def relay(message):
        if not hasattr(message, "radius"):
            return message
        return obstacles(message, next(counts)) if message.time < 2.4 else None

    run = RelayedLoop(seeing(max_obstacle_age=1.0), relay)
    for tick in range(1, 160):
        run.advance_to(0.02 * tick)
        if 0.02 * tick < 3.0:
            assert run.controller.mode is CommandMode.APPLY
    run.advance_to(3.6)
    assert run.controller.mode is CommandMode.FALLBACK
    last = run.controller.report()["changes"][-1]
    assert "no obstacles have been perceived for 1.0" in last["reason"]


@pytest.mark.parametrize("source", ["known", "perceived"])
def test_what_another_session_says_of_obstacles_is_not_taken(source) -> None:
    """Of a vehicle of the same name, or of the one that was there before."""
    run = InProcess(load_scenario(CAR, {"hardware": {"obstacles": source}}))
    run.advance_to(0.2)
    stranger = Bus(run.lcm, run.clock)
    for tick in range(11, 150):
        far = vcbf_obstacles()
        far.time, far.num_obstacles, far.num_coordinates = 0.0, 2, 4
        far.radius, far.valid = [0.5, 0.5], [True, True]
        far.position, far.velocity = [50.0] * 4, [0.0] * 4
        stranger.send("VCBF_OBSTACLES", far)
        run.advance_to(0.02 * tick)
        assert run.controller.mode is CommandMode.APPLY
    alone = InProcess(load_scenario(CAR, {"hardware": {"obstacles": source}}))
    alone.advance_to(0.02 * 149)
    assert path(run) == path(alone)


def test_what_a_vehicle_perceived_before_it_started_again_is_forgotten() -> None:
    """The new one sends no obstacles yet: what there was is not its own."""
    before = True

    def relay(message):
        return None if hasattr(message, "radius") and not before else message

    run = RelayedLoop(seeing(), relay)
    run.advance_to(1.0)
    assert run.controller.mode is CommandMode.APPLY
    before = False
    run.restart_plant()
    run.advance_to(1.5)
    assert run.controller.mode is CommandMode.FALLBACK
    last = run.controller.report()["changes"][-1]
    assert last["reason"].startswith("no obstacles have been perceived yet")


# A robot of one's own --------------------------------------------------------------


def test_a_vehicle_of_one_s_own_is_controlled_as_it_is_simulated() -> None:
    """The puck of the example: its own plant and controller, over the bus."""
    loaded = load_scenario(ROOT / "examples" / "own_robot.py")
    loaded.hardware.longest_interval = loaded.period
    loaded.hardware.predict = True
    run = InProcess(loaded)
    run.advance_to(4.0)
    assert not run.controller.report()["findings"]
    known = load_scenario(ROOT / "examples" / "own_robot.py", {"duration": 4.0})
    expected = simulate(known, step_time=False).log
    log = run.plant.diagram.GetSubsystemByName("log_path").FindLog(run.plant.context)
    for k, state in enumerate(log.data()):
        found = np.interp(expected["time"], log.sample_times(), state)
        np.testing.assert_allclose(found, expected["state"][:, k], atol=1e-9)
