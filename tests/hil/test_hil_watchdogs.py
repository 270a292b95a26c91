"""What both sides do when messages fail to come, on a simulated clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.primitives import LinearSystem
import pytest

from tests.helpers.multibody_plants import PLANAR, SEVEN, load as load_plant
from vcbf_drake import (
    Blimp,
    Car,
    ControlAffineModel,
    InputLimits,
    InputSet,
    Scenario,
    load_scenario,
)
from vcbf_drake.barriers import Barrier
from vcbf_drake.hil import (
    Bus,
    CommandMode,
    InProcess,
    LinkFaults,
    PlantProcess,
    VehicleMode,
    controller_of,
)
from vcbf_drake.hil.messages import vcbf_command, vcbf_status
from vcbf_drake.hil.vehicle_side import fallback_input
from vcbf_drake.plants import StateFeedback, Vehicle

CAR = ControlAffineModel.from_system(Car())
BLIMP = ControlAffineModel.from_system(Blimp())


def loop(overrides: str = "{}", name: str = "blimp-multiple-obstacles", **options):
    return InProcess(load_scenario(name, overrides), **options)


def applied_input(run: InProcess) -> np.ndarray:
    receiver = run.plant.diagram.GetSubsystemByName("vehicle_end")
    context = receiver.GetMyContextFromRoot(run.plant.context)
    return receiver.GetOutputPort("input").Eval(context)


def state(run: InProcess) -> np.ndarray:
    plant = run.plant.diagram.GetSubsystemByName("plant")
    context = plant.GetMyContextFromRoot(run.plant.context)
    return plant.GetOutputPort("state").Eval(context)


def heard(run: InProcess, kind):
    """What is published on a channel, in a list that grows."""
    found: list = []
    channel = {vcbf_command: "VCBF_COMMAND", vcbf_status: "VCBF_STATUS"}[kind]
    run.lcm.Subscribe(channel, lambda data: found.append(kind.decode(data)))
    return found


# The vehicle's side ----------------------------------------------------------------


@pytest.mark.parametrize("fallback", ["zero", "brake"])
def test_a_vehicle_without_commands_falls_back_and_recovers(fallback: str) -> None:
    run = loop(f"{{hardware: {{fallback: {fallback}, command_timeout: 0.1}}}}")
    run.advance_to(0.5)
    assert run.plant.mode is VehicleMode.FOLLOWING
    run.kill_controller()
    run.advance_to(0.58)
    assert run.plant.mode is VehicleMode.FOLLOWING
    run.advance_to(0.64)
    assert run.plant.mode is VehicleMode.FALLBACK
    speed = np.linalg.norm(state(run)[4:7])
    run.advance_to(1.0)
    u = applied_input(run)
    if fallback == "zero":
        assert u.tolist() == [0.0, 0.0, 0.0]
    else:
        assert u[0] < 0.0
        assert np.linalg.norm(state(run)[4:7]) < 0.98 * speed
    run.start_controller()
    run.advance_to(1.06)
    assert run.plant.mode is VehicleMode.FOLLOWING
    assert [change["mode"] for change in run.plant.report()["changes"]] == [
        "waiting",
        "following",
        "fallback",
        "following",
    ]


def test_a_brake_takes_off_the_speed_it_can() -> None:
    free = InputSet.box([-100.0] * 3, [100.0] * 3)
    x = np.array([1.0, 2.0, 3.0, 0.4, 0.0, 0.0, -0.5, 0.0])
    x[4:6] = 0.7 * np.cos(0.4), 0.7 * np.sin(0.4)
    u = fallback_input("brake", BLIMP, free, x, 2.0)
    f, g = BLIMP.drift_and_input_matrix(x)
    # It flies straight ahead, so that thrust reaches all of its speed.
    np.testing.assert_allclose((f + g @ u)[4:7], -2.0 * x[4:7], atol=1e-9)
    weak = InputSet.box([-0.1] * 3, [0.1] * 3)
    assert weak.contains(fallback_input("brake", BLIMP, weak, x, 2.0))
    u = fallback_input("brake", CAR, InputSet.box([-9, -1], [9, 1]), np.ones(4), 2.0)
    f, g = CAR.drift_and_input_matrix(np.ones(4))
    assert (f + g @ u)[2] == pytest.approx(-2.0)


def test_an_arm_brakes_and_does_not_fall() -> None:
    arm = ControlAffineModel.from_system(load_plant(SEVEN))
    limits = InputSet.box(-arm.effort_limits, arm.effort_limits)
    x = np.linspace(-0.5, 0.5, 14)
    f, g = arm.drift_and_input_matrix(x)
    rate = f + g @ fallback_input("brake", arm, limits, x, 2.0)
    np.testing.assert_allclose(rate[7:], -2.0 * x[7:], atol=1e-9)


def test_an_arm_read_in_symbols_brakes_too() -> None:
    """As the scenario of a certified arm has it; nothing disturbs it."""
    arm = ControlAffineModel.from_system(load_plant(PLANAR), symbolic=True)
    n = arm.num_inputs
    x = np.concatenate([np.linspace(0.2, 0.4, n), np.linspace(-0.5, 0.5, n)])
    f, g = arm.drift_and_input_matrix(x)
    limits = InputSet.box([-1e3] * n, [1e3] * n)
    rate = f + g @ fallback_input("brake", arm, limits, x, 2.0)
    np.testing.assert_allclose(rate[n:], -2.0 * x[n:], atol=1e-9)


def test_zero_is_inside_the_limits() -> None:
    limits = InputSet.box([0.5, -1.0], [2.0, 1.0])
    assert fallback_input("zero", CAR, limits, np.ones(4), 1.0).tolist() == [0.5, 0.0]


def test_the_input_that_is_applied_is_inside_its_limits() -> None:
    run = loop(name="car-avoidance")
    run.kill_controller()
    run.advance_to(0.1)
    message = vcbf_command()
    message.version, message.session = 2, run.clock.now
    message.state_session = run.plant.bus.session
    message.utime, message.num_inputs = run.clock.now, 2
    message.input = [1e5, -1e5]
    run.lcm.Publish("VCBF_COMMAND", message.encode())
    run.advance_to(0.2)
    scenario = load_scenario("car-avoidance")
    limits = scenario.input_set
    assert applied_input(run).tolist() == [limits.upper[0], limits.lower[1]]


# The controller's side -------------------------------------------------------------


def test_a_controller_without_states_holds_then_asks_for_the_fallback() -> None:
    """max_state_age 0.1 s, then hold_time 0.1 s, then the fallback, saying why."""
    run = loop("{hardware: {max_state_age: 0.1, hold_time: 0.1}}")
    run.advance_to(0.98)
    commands, statuses = heard(run, vcbf_command), heard(run, vcbf_status)
    run.advance_to(1.0)
    held = list(commands.pop().input)
    statuses.clear()
    measured = run.clock.now
    modes = []
    for age in np.arange(0.02, 0.4, 0.02):  # The vehicle is silent: only time passes.
        run.clock.now = measured + round(1e6 * age)
        run.controller.step()
        run.plant.bus.poll()
        modes.append((round(age, 2), commands[-1].mode if commands else None))
    assert dict(modes)[0.1] is None  # Nothing to say while the state is fresh.
    assert {mode for age, mode in modes if 0.1 < age <= 0.2} == {CommandMode.HOLD}
    assert {mode for age, mode in modes if 0.2 < age} == {CommandMode.FALLBACK}
    holds = [c.input for c in commands if c.mode == CommandMode.HOLD]
    assert all(list(u) == held for u in holds)
    assert all(not any(c.input) for c in commands if c.mode == CommandMode.FALLBACK)
    reasons = [status.reason for status in statuses]
    assert reasons[0] == "the state is 0.12 s old; the input is held"
    assert reasons[-1] == "no new state for 0.38 s"
    assert [s.mode for s in statuses] == [c.mode for c in commands]
    # The vehicle speaks again.
    run.advance_to(1.02 + 0.4)
    assert run.controller.mode is CommandMode.APPLY
    assert run.plant.mode is VehicleMode.FOLLOWING
    assert statuses[-1].reason == ""


def test_an_infeasible_filter_asks_for_the_fallback_and_names_the_rows() -> None:
    run = loop("{method: dob-cbf-qp}")
    statuses = heard(run, vcbf_status)
    run.advance_to(9.5)
    infeasible = [status for status in statuses if status.filter_status == 3]
    assert infeasible
    for status in infeasible:
        assert status.mode == CommandMode.FALLBACK
        assert any(row.startswith("obstacle") for row in status.conflicts)
        assert status.reason == f"no input satisfies {', '.join(status.conflicts)}"
    assert "fallback" in [c["mode"] for c in run.plant.report()["changes"]]
    assert not run.plant.collided


@dataclass
class Point(Vehicle):
    """A point on a line whose input is its velocity."""

    position = (0,)

    def make_plant(self) -> LinearSystem:
        return LinearSystem([[0.0]], [[1.0]], [[1.0]], [[0.0]])

    def make_controller(self, target: Any) -> StateFeedback:
        return StateFeedback(lambda x: target - x, 1, 1)

    def barriers(self) -> list[Barrier]:
        return [
            Barrier(lambda x, t, p: 1e11 - x[0], [1e-9]),
            Barrier(lambda x, t, p: 1.0 + x[0] - (100.0 + 1e-7) * t, [1e-9]),
        ]


def test_a_conflict_by_less_than_rounding_asks_for_the_fallback_too() -> None:
    """The rows ask for u <= 100 and u >= 100 + 1e-7: rounding may explain that."""
    scenario = Scenario(
        vehicle=Point(),
        method="cbf-qp",
        infeasible="stop",
        input_set=InputLimits([99.0], [101.0]),
        initial_state=[0.0],
        target=[100.0],
        duration=0.1,
    )
    run = InProcess(scenario)
    statuses = heard(run, vcbf_status)
    run.advance_to(0.02)
    infeasible = [status for status in statuses if status.filter_status == 3]
    assert infeasible
    assert {status.mode for status in infeasible} == {CommandMode.FALLBACK}
    assert all(status.reason.startswith("no input satisfies ") for status in infeasible)


def test_a_vehicle_among_other_obstacles_is_sent_into_its_fallback() -> None:
    run = loop()
    run.advance_to(0.3)
    assert run.controller.mode is CommandMode.APPLY
    run.kill_controller()
    other = load_scenario("blimp-multiple-obstacles")
    other.obstacles[2].center[1] += 0.4
    other.obstacles[2].radius -= 0.1
    run.controller = controller_of(other, Bus(run.lcm, run.clock))
    statuses = heard(run, vcbf_status)
    run.advance_to(1.1)
    assert run.plant.mode is VehicleMode.FALLBACK
    assert statuses[-1].mode == CommandMode.FALLBACK
    assert statuses[-1].reason == (
        "the vehicle's obstacle 3 is 0.400 m away from the scenario's and +0.100 m"
        " larger"
    )


def test_a_vehicle_with_fewer_obstacles_is_sent_into_its_fallback() -> None:
    run = loop()
    other = load_scenario("blimp-multiple-obstacles")
    other.obstacles.pop()
    run.controller = controller_of(other, Bus(run.lcm, run.clock))
    statuses = heard(run, vcbf_status)
    run.advance_to(0.6)
    assert run.plant.mode is VehicleMode.FALLBACK
    assert statuses[-1].reason == "the vehicle does not know of 6 obstacles"


def test_the_last_command_asks_for_the_fallback() -> None:
    run = loop()
    run.advance_to(0.5)
    commands = heard(run, vcbf_command)
    run.controller.stop()
    run.controller.run()
    run.plant.bus.poll()
    assert [command.mode for command in commands] == 10 * [CommandMode.END]
    assert not any(commands[-1].input)
    run.kill_controller()
    run.advance_to(0.54)
    assert run.plant.mode is VehicleMode.FALLBACK


def test_a_vehicle_that_sends_faster_than_the_period_is_sampled() -> None:
    run = loop("{period: 0.005}")
    slow = load_scenario("blimp-multiple-obstacles", {"period": 0.02})
    run.controller = controller_of(slow, Bus(run.lcm, run.clock))
    commands, statuses = heard(run, vcbf_command), heard(run, vcbf_status)
    run.advance_to(1.0)
    assert len(commands) == pytest.approx(51, abs=1)
    assert np.diff([s.time for s in statuses]) == pytest.approx(0.02)
    # Each answers the state it acted on: one in four, the first ones aside.
    assert set(np.diff([c.state_sequence for c in commands]).tolist()) == {4}


def test_a_vehicle_that_starts_again_is_followed_from_its_beginning() -> None:
    run = loop()
    run.advance_to(2.0)
    statuses = heard(run, vcbf_status)
    run.clock.now += 3_000_000
    run.plant = PlantProcess(run.plant.scenario, Bus(run.lcm, run.clock))
    start = run.clock.now
    for tick in range(1, 20):
        run.clock.now = start + 20_000 * tick
        run.plant.advance_to(0.02 * tick)
        run.controller.step()
        run.plant.bus.poll()
    assert statuses[-1].time == pytest.approx(0.38)
    assert statuses[-1].mode == CommandMode.APPLY
    assert run.plant.mode is VehicleMode.FOLLOWING
    first = next(s for s in statuses if s.time < 1.0)
    assert first.error_bound == max(s.error_bound for s in statuses)


# The observer after a gap ----------------------------------------------------------


def test_the_error_bound_re_arms_after_a_gap_and_holds_along_the_way() -> None:
    scenario = load_scenario("blimp-multiple-obstacles")
    scenario.hardware.longest_interval = 0.1
    run = InProcess(scenario)
    statuses = heard(run, vcbf_status)
    run.advance_to(3.0)
    settled = statuses[-1].error_bound
    controller, run.controller = run.controller, None  # It hangs for 0.4 s.
    run.advance_to(3.4)
    run.controller = controller
    run.advance_to(3.42)
    first = next(status.error_bound for status in statuses if status.time > 3.0)
    assert settled < 0.05
    assert first > 0.1
    run.advance_to(8.0)
    assert statuses[-1].error_bound < 0.05


@pytest.mark.parametrize(
    "faults",
    [
        {"controller_faults": LinkFaults(drop=0.3, seed=1)},
        {
            "controller_faults": LinkFaults(drop=0.2, seed=2),
            "vehicle_faults": LinkFaults(drop=0.3, delay=0.03, jitter=0.01, seed=3),
            "grid": 5,
        },
    ],
)
def test_the_estimate_stays_within_its_bound_over_a_bad_link(faults) -> None:
    run = loop("{duration: 8.0}", **faults)
    statuses = heard(run, vcbf_status)
    run.advance_to(8.0)
    disturbance = run.plant.diagram.GetSubsystemByName("disturbance")
    context = disturbance.CreateDefaultContext()
    assert len(statuses) > 200
    for status in statuses:
        context.SetTime(status.time)
        true = disturbance.get_output_port().Eval(context)
        error = np.linalg.norm(true - np.array(status.disturbance_estimate))
        assert error <= status.error_bound


# What is guaranteed ----------------------------------------------------------------


@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"vehicle_faults": LinkFaults(delay=0.004), "grid": 5},
        {"vehicle_faults": LinkFaults(drop=0.2, seed=1)},
        {"controller_faults": LinkFaults(drop=0.2, seed=1)},
    ],
)
def test_a_plan_counts_for_nothing_where_a_period_or_an_input_was_another(
    faults,
) -> None:
    """Theorem 5 is of whole periods of each command: late and lost ones are counted."""
    run = loop("{infeasible: backup}", "car-avoidance", **faults)
    run.advance_to(2.0)
    report = run.controller.report()
    if not faults:
        assert report["reasons_against_feasible"] == []
        assert report["guaranteed_feasible"] is None  # Nobody there knows the truth.
        return
    assert report["guaranteed_feasible"] is False
    (reason,) = report["reasons_against_feasible"]
    assert reason.startswith("exact periods: ")
    assert reason.endswith(" intervals were no period of one command")


def test_without_a_plan_there_is_nothing_to_guarantee() -> None:
    run = loop(name="car-avoidance")
    run.advance_to(0.1)
    assert not {"guaranteed_feasible", "reasons_against_feasible"} & {
        *run.controller.report()
    }
