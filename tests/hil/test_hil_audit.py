"""The live audit: an integrator's mistakes are found, and good links raise no alarm."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.relayed_loop import RelayedLoop
from vcbf_drake import load_scenario
from vcbf_drake.hil import CommandMode, InProcess, LinkFaults, VehicleMode
from vcbf_drake.hil.messages import vcbf_status
from vcbf_drake.hil.prediction import FINDINGS

ESTIMATE, MOTION, FROZEN, NO_TIME = FINDINGS


def scenario(name: str = "blimp-multiple-obstacles", **overrides):
    return load_scenario(name, {"period": 0.01, **overrides})


def state_changed(change):
    """What changes a state's message, and lets all others pass."""

    def relay(message):
        return change(message) if hasattr(message, "state") else message

    return relay


def in_body_axes(message):
    x = list(message.state)
    c, s = np.cos(x[3]), np.sin(x[3])
    x[4], x[5] = c * x[4] + s * x[5], -s * x[4] + c * x[5]
    message.state = x
    return message


def downwards(message):
    x = list(message.state)
    x[2], x[6] = -x[2], -x[6]
    message.state = x
    return message


def in_degrees(message):
    x = list(message.state)
    x[3] = float(np.degrees(x[3]))
    message.state = x
    return message


def backwards(message):
    message.input_integral = [-each for each in message.input_integral]
    return message


def without_integral(message):
    message.input_integral = [0.0] * 3
    return message


class Frozen:
    """A state that stands still for a while, with fresh stamps."""

    def __init__(self, *spans: tuple[float, float]) -> None:
        self._spans = spans
        self._kept: dict[tuple[float, float], list[float]] = {}

    def __call__(self, message):
        for span in self._spans:
            if span[0] <= message.time < span[1]:
                message.state = self._kept.setdefault(span, list(message.state))
        return message


@pytest.mark.parametrize(
    "mistake", [in_body_axes, downwards, in_degrees, backwards, without_integral]
)
def test_a_mistake_is_found_soon_and_leads_to_the_fallback(mistake) -> None:
    run = RelayedLoop(scenario(), state_changed(mistake))
    run.advance_to(1.0)
    report = run.controller.report()
    assert report["findings"].keys() <= {MOTION, ESTIMATE}
    fallback = next(c for c in report["changes"] if c["mode"] == "fallback")
    assert fallback["reason"].startswith("refuted: the ")
    assert fallback["time"] < 0.5
    assert run.controller.mode is CommandMode.FALLBACK


def test_an_interval_of_one_period_is_judged_whatever_the_longest_is() -> None:
    """At a rate so low that `longest_interval` is below the period."""
    slow = scenario(hardware={"longest_interval": 0.005})
    run = RelayedLoop(slow, state_changed(in_body_axes))
    run.advance_to(1.0)
    assert run.controller.report()["findings"].keys() <= {MOTION, ESTIMATE}
    assert run.controller.mode is CommandMode.FALLBACK


def test_a_frozen_state_is_called_one_and_forgiven_once_it_moves() -> None:
    run = RelayedLoop(scenario(), state_changed(Frozen((2.0, 2.5))))
    run.advance_to(2.1)
    assert run.controller.mode is CommandMode.FALLBACK
    assert FROZEN in run.controller.report()["findings"]
    run.advance_to(3.4)
    assert run.controller.mode is CommandMode.FALLBACK
    run.advance_to(3.6)  # A second after it moved on.
    assert run.controller.mode is CommandMode.APPLY


def standing_from(instant: float):
    """The motion's time stands from then on; the vehicle does not."""

    def stand(message):
        message.time = min(message.time, instant)
        return message

    return state_changed(stand)


@pytest.mark.parametrize("instant", [0.0, 2.0])
def test_a_time_that_stands_while_the_vehicle_moves_is_found(instant) -> None:
    """Without it nothing else is compared: the filter would be believed blindly."""
    run = RelayedLoop(scenario(), standing_from(instant))
    said: list[str] = []
    run.controller.tell = said.append
    for tick in range(200):
        run.advance_to(instant + 0.01 * tick)
        run.controller._say()
        if tick == 9:
            assert run.controller.mode is CommandMode.APPLY
    assert run.controller.report()["findings"].keys() == {NO_TIME}
    fallback = [c for c in run.controller.report()["changes"] if c["mode"] != "apply"]
    assert [c["reason"] for c in fallback] == [f"refuted: {NO_TIME}"]
    assert run.controller.mode is CommandMode.FALLBACK
    assert sum("refuted: the motion's time" in line for line in said) == 1
    assert run.plant.mode is VehicleMode.FALLBACK


def test_a_vehicle_that_calls_itself_waiting_but_obeys_is_found_too() -> None:
    def stand(message):
        message.time, message.mode = 0.0, VehicleMode.WAITING
        return message

    run = RelayedLoop(scenario(), state_changed(stand))
    run.advance_to(0.5)
    assert run.controller.report()["findings"].keys() == {NO_TIME}


@pytest.mark.parametrize("session", [0, -1])
def test_a_vehicle_that_fills_in_nothing_but_its_state_is_found(session) -> None:
    """It obeys, and calls itself waiting for a first command all the time."""

    def bare(message):
        message.time, message.mode = 0.0, VehicleMode.WAITING
        message.command_session = message.command_sequence = session
        message.input_integral = [0.0] * 3
        return message

    run = RelayedLoop(scenario(), state_changed(bare))
    run.advance_to(0.5)
    assert run.controller.report()["findings"].keys() == {NO_TIME}
    assert run.controller.mode is CommandMode.FALLBACK


def test_a_vehicle_that_waits_may_drift_and_its_sensors_be_noisy() -> None:
    """As the wind and noise that are declared move it; not for longer than that."""
    noise = {"std": [2e-3] * 8, "seed": 1}
    known, rng = scenario(noise=noise), np.random.default_rng(2)

    def drift(message):
        t, push = message.time, 0.02
        x = np.array(known.initial_state)
        x[0], x[4] = x[0] + push * t**2 / 2, x[4] + push * t
        message.state = (x + 2e-3 * rng.standard_normal(8)).tolist()
        message.time, message.mode = 0.0, VehicleMode.WAITING
        message.command_session, message.input_integral = -1, [0.0] * 3
        return message

    run = RelayedLoop(scenario(), state_changed(drift), known=known)
    run.advance_to(2.0)
    assert run.controller.report()["findings"] == {}


def test_a_vehicle_that_waits_and_one_whose_time_comes_in_steps_are_fine() -> None:
    """Waiting for longer than a state may be old; a plant slower than its messages."""

    def wait(message):
        if message.time < 0.8:
            message.time, message.state = 0.0, list(x_0)
            message.mode, message.command_session = VehicleMode.WAITING, -1
            message.input_integral = [0.0] * 3
        return message

    x_0 = scenario().initial_state
    run = RelayedLoop(scenario(), state_changed(wait))
    run.advance_to(0.79)
    assert run.controller.report()["findings"] == {}

    kept: list = []

    def step(message):
        if not kept or message.time - kept[0].time >= 0.0499:
            kept[:] = [message]
        message.time, message.state = kept[0].time, kept[0].state
        message.input_integral = kept[0].input_integral
        return message

    run = RelayedLoop(scenario(), state_changed(step))
    run.advance_to(3.0)
    assert run.controller.report()["findings"] == {}


def test_a_time_in_milliseconds_is_named_once_and_nothing_is_applied_again() -> None:
    def in_milliseconds(message):
        message.time *= 1e3
        return message

    run = RelayedLoop(scenario(), state_changed(in_milliseconds))
    said: list[str] = []
    run.controller.tell = said.append
    for tick in range(300):
        run.advance_to(0.01 * tick)
        run.controller._say()
    changes = run.controller.report()["changes"]
    assert [change["mode"] for change in changes] == ["apply", "hold", "fallback"]
    named = [line for line in said if "its motion's time leaps (on by" in line]
    assert len(named) == 1
    assert "its unit is s" in named[0]


def test_the_third_finding_stays() -> None:
    frozen = Frozen((1.0, 1.2), (2.5, 2.7), (4.0, 4.2))
    run = RelayedLoop(scenario(), state_changed(frozen))
    run.advance_to(3.9)
    assert run.controller.mode is CommandMode.APPLY
    run.advance_to(6.0)
    assert run.controller.mode is CommandMode.FALLBACK


def test_a_single_jump_is_no_finding() -> None:
    """As of a state estimator that is reset."""

    def jumped(message):
        if message.time >= 1.0:
            message.state = [message.state[0] + 0.5, *message.state[1:]]
        return message

    run = RelayedLoop(scenario(), state_changed(jumped))
    run.advance_to(1.5)
    assert run.controller.report()["findings"] == {}


def test_a_jump_of_the_speed_is_told_and_the_estimate_does_not_follow() -> None:
    """The observer passes over that interval, and status and report say so."""

    def jumped(message):
        if message.time >= 1.0:
            x = list(message.state)
            x[4] += 0.3
            message.state = x
        return message

    run = RelayedLoop(scenario(), state_changed(jumped))
    statuses, said = [], []
    run.controller.tell = said.append
    run.controller.bus.taps.append(
        lambda utime, channel, data: (
            statuses.append(vcbf_status.decode(data))
            if channel == "VCBF_STATUS"
            else None
        )
    )
    run.advance_to(0.98)
    assert statuses[-1].refused_intervals == 0
    run.advance_to(1.01)
    run.controller._say()
    assert statuses[-1].refused_intervals >= 1
    assert run.controller.report()["refused_intervals"] >= 1
    assert any("the state jumped" in line for line in said)
    bound = statuses[-1].disturbance_bound + statuses[-1].error_bound
    assert np.linalg.norm(statuses[-1].disturbance_estimate) <= bound


def test_with_report_alone_the_vehicle_is_not_stopped_but_status_says_so() -> None:
    loaded = scenario(hardware={"audit": "report"})
    run = RelayedLoop(loaded, state_changed(without_integral))
    statuses = []
    run.controller.bus.taps.append(
        lambda utime, channel, data: (
            statuses.append(vcbf_status.decode(data))
            if channel == "VCBF_STATUS"
            else None
        )
    )
    said: list[str] = []
    run.controller.tell = said.append
    run.advance_to(0.5)
    run.controller._say()
    assert run.controller.mode is CommandMode.APPLY
    assert statuses[-1].findings == [MOTION]
    assert statuses[-1].disturbance_bound == pytest.approx(
        run.controller.diagram.GetSubsystemByName("filter_observer").bounds.delta1
    )
    assert [line for line in said if "refuted" in line] == [
        f"{statuses[-1].time:.2f} s: refuted: {MOTION}"
    ]


@pytest.mark.parametrize("step", [1e-3, 1e-2])
def test_a_coarse_sensor_is_found_unless_its_noise_is_declared(step) -> None:
    """A step of q has the deviation q / sqrt(12)."""

    def rounded(message):
        message.state = (step * np.round(np.divide(message.state, step))).tolist()
        return message

    noise = {"std": [step / 12.0**0.5] * 8, "seed": 1}
    findings = []
    for known in (scenario(), scenario(noise=noise)):
        run = RelayedLoop(scenario(), state_changed(rounded), known=known)
        run.advance_to(1.0)
        findings.append(set(run.controller.report()["findings"]))
    assert MOTION in findings[0]
    assert findings[1] == set()


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("car-avoidance", {}),
        ("blimp-multiple-obstacles", {"period": 0.02}),
        ("blimp-multiple-obstacles", {"period": 0.005}),
        ("car-avoidance", {"method": "cbf-qp"}),
        ("car-avoidance", {"noise": {"std": [0.002, 0.002, 0.002, 0.002], "seed": 3}}),
    ],
)
def test_what_is_as_declared_raises_no_alarm(name, options) -> None:
    run = InProcess(load_scenario(name, options))
    run.advance_to(5.0)
    assert run.controller.report()["findings"] == {}
    assert run.controller.report()["ticks"] > 100


def test_a_bad_link_raises_no_alarm() -> None:
    """Losses, delays and overtaking, both ways, and a controller that is replaced."""
    faults = [
        LinkFaults(drop=0.3, delay=0.03, jitter=0.03, seed=seed) for seed in (1, 2)
    ]
    run = InProcess(scenario(), *faults, grid=2)
    run.advance_to(3.0)
    assert run.controller.report()["findings"] == {}
    run.kill_controller()
    run.advance_to(3.4)
    run.start_controller()
    run.advance_to(6.0)
    assert run.controller.report()["findings"] == {}
    assert run.controller.report()["ticks"] > 100
