"""The live audit: an integrator's mistakes are found, and good links raise no alarm."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.relayed_loop import RelayedLoop
from vcbf_drake import load_scenario
from vcbf_drake.hil import CommandMode, InProcess, LinkFaults
from vcbf_drake.hil.messages import vcbf_status
from vcbf_drake.hil.watchdogs import FINDINGS

ESTIMATE, MOTION, FROZEN = FINDINGS


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


def test_a_frozen_state_is_called_one_and_forgiven_once_it_moves() -> None:
    run = RelayedLoop(scenario(), state_changed(Frozen((2.0, 2.5))))
    run.advance_to(2.1)
    assert run.controller.mode is CommandMode.FALLBACK
    assert FROZEN in run.controller.report()["findings"]
    run.advance_to(3.4)
    assert run.controller.mode is CommandMode.FALLBACK
    run.advance_to(3.6)  # A second after it moved on.
    assert run.controller.mode is CommandMode.APPLY


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
