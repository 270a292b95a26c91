"""A run in real time: what its page is told, the pause, and a person at the sliders."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
import json
from pathlib import Path
import struct
from threading import Timer
import time
from typing import Any
from urllib.request import Request, urlopen

import numpy as np
import pytest

from tests.helpers.browser import browser
from tests.helpers.pages import page_data
from vcbf_drake import load_scenario, simulate
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.simulation.loading import load_fleet
from vcbf_drake.simulation.result import Result
from vcbf_drake.simulation.run import simulate_fleet
from vcbf_drake.viz.live import LiveView, Stick

SHORT = {"duration": 1.0, "target": [0.2, 0.0]}


def watched(act: Callable[[str], Any], **changes: Any) -> tuple[Result, Any]:
    """The result of a run, and what came of an action on its page beside it."""
    scenario = load_scenario("car-avoidance", SHORT | changes)
    with ThreadPoolExecutor() as beside:
        found: list[Future[Any]] = []
        view = LiveView([scenario], lambda url: found.append(beside.submit(act, url)))
        result = simulate(scenario, step_time=False, watch=view)
        view.close()
        return result, found[0].result(60.0)


def points(address: str) -> list[dict[str, Any]]:
    """Everything that a page is told, until the run is over."""
    with urlopen(address + "stream", timeout=60.0) as stream:
        text = stream.read().decode()
    *found, over = text.strip().split("\n\n")
    assert over.startswith("event: over")
    return [json.loads(each.removeprefix("data: "))[0] for each in found]


def test_a_page_is_told_what_the_log_has() -> None:
    def act(address: str) -> tuple[str, list[dict[str, Any]]]:
        with urlopen(address) as answer:
            return answer.read().decode(), points(address)

    result, (page, told) = watched(act)
    data = page_data(page)
    assert data["live"] and data["duration"] == 1.0 and not data["sliders"]
    assert [plot["title"] for plot in data["plots"]][2] == "Inputs"
    log, times = result.log, [point["time"][0] for point in told]
    assert times == sorted(times) and len(times) >= 8
    ticks = np.searchsorted(log["time"], np.array(times) - 1e-9)
    for point, tick in zip(told, np.minimum(ticks, len(log["time"]) - 1), strict=True):
        place = [*log["state"][tick, :2], 0.0]
        assert point["path"][0] == pytest.approx(place, abs=1e-3)
        assert point["input0"][0] == pytest.approx(log["input"][tick, 0], rel=1e-3)
        assert point["barrier"][0] == pytest.approx(log["barriers"][tick].min(), 1e-3)
        assert len(point["sets"]["outline"]) == 1
    events = [event for point in told for event in point["events"]]
    assert [event["kind"] for event in events] == ["reached"]


def test_of_two_vehicles_a_page_is_told_each() -> None:
    file = Path(__file__).parents[2] / "examples" / "two_vehicles.yaml"
    fleet = load_fleet(file, {"duration": 0.4})
    told: list[Future[Any]] = []

    def act(address: str) -> list[list[dict[str, Any]]]:
        with urlopen(address + "stream", timeout=60.0) as stream:
            *found, _ = stream.read().decode().strip().split("\n\n")
        return [json.loads(each.removeprefix("data: ")) for each in found]

    with ThreadPoolExecutor() as beside:
        view = LiveView(
            fleet.vehicles, lambda url: told.append(beside.submit(act, url))
        )
        results = simulate_fleet(fleet, step_time=False, watch=view)
        view.close()
        last = told[0].result(60.0)[-1]
    for point, result in zip(last, results, strict=True):
        tick = np.searchsorted(result.log["time"], point["time"][0] - 1e-9)
        place = [*result.log["state"][tick, :2], 0.0]
        assert point["path"][0] == pytest.approx(place, abs=1e-3)


def test_a_pause_holds_the_run_up() -> None:
    def act(address: str) -> float:
        def post(name: str) -> None:
            urlopen(Request(address + name, method="POST")).close()

        post("pause")
        started = time.monotonic()
        with urlopen(address + "stream", timeout=60.0) as stream:
            stream.readline()  # The first point; the next one comes after the pause.
            stream.readline()
            Timer(1.0, post, ["go"]).start()
            stream.readline()
        return time.monotonic() - started

    _, waited = watched(act, duration=0.4)
    assert waited > 0.9


def test_watching_changes_nothing() -> None:
    scenario = load_scenario("car-avoidance", SHORT)
    calls: list[float] = []
    alone = simulate(scenario, step_time=False)
    watched = simulate(
        scenario,
        step_time=False,
        watch=lambda _, context: calls.append(context.get_time()),
    )
    assert calls[0] == 0.0 and calls[-1] == 1.0 and len(calls) >= 25
    for name, values in alone.log.items():
        np.testing.assert_allclose(watched.log[name], values, atol=1e-9, err_msg=name)


def test_a_person_at_the_sliders_takes_the_controllers_place() -> None:
    scenario = load_scenario("car-avoidance", {"duration": 1.0})
    view = LiveView([scenario], lambda address: None)
    stick = Stick(view.meshcat, scenario)
    force, turn = view.meshcat.GetSliderNames()
    assert (force, turn) == ("acceleration force [N]", "turn rate [rad/s]")
    view.meshcat.SetSliderValue(force, 1.5)
    result = simulate(scenario, step_time=False, controller=stick)
    np.testing.assert_allclose(result.log["reference"], [[1.5, 0.0]] * 51)
    np.testing.assert_allclose(result.log["input"][5], [1.5, 0.0], atol=1e-6)


def packed(value: Any) -> bytes:
    """A small value as MessagePack, which is how Meshcat's page sends it."""
    if isinstance(value, dict):
        pairs = [packed(each) for pair in value.items() for each in pair]
        return bytes([0x80 | len(value)]) + b"".join(pairs)
    if isinstance(value, list):
        return bytes([0x90 | len(value)]) + b"".join(map(packed, value))
    if isinstance(value, str):
        return bytes([0xA0 | len(value)]) + value.encode()
    if isinstance(value, int):
        return bytes([value])
    return b"\xcb" + struct.pack(">d", value)


@pytest.mark.parametrize(
    ("axes", "reference"),
    [
        ([0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.07, -0.05, 0.02, 0.0], [0.0, 0.0, 0.0]),  # A stick that is not quite level.
        ([1.0, -1.0, 1.0, 0.0], [0.1, 0.2, 0.01]),
        ([-1.0, 1.0, -1.0, 0.0], [-0.02, -0.2, -0.01]),
        ([0.5, -0.5, 0.5, 0.0], [0.05, 0.1, 0.005]),
        ([-0.5, 0.5], [-0.01, -0.1, -0.005]),  # The first axis again.
        ([], [0.0, 0.0, 0.0]),
    ],
)
def test_a_gamepads_axes_are_the_inputs(
    axes: list[float], reference: list[float]
) -> None:
    limits = {"lower": [-0.02, -0.2, -0.01], "upper": [0.1, 0.2, 0.01]}
    scenario = load_scenario("blimp-multiple-obstacles", {"input_set": limits})
    view = LiveView([scenario], lambda address: None)
    stick = Stick(view.meshcat, scenario)
    gamepad = {"index": 0, "button_values": [0.0], "axes": axes}
    message = {"type": "gamepad", "name": "", "gamepad": gamepad}
    view.meshcat._InjectWebsocketMessage(packed(message))
    context = stick.CreateDefaultContext()
    found = stick.GetOutputPort("reference").Eval(context)
    np.testing.assert_allclose(found, reference, atol=1e-12)
    # Unplugged, when Meshcat keeps its index, it leaves the word to the sliders.
    view.meshcat._InjectWebsocketMessage(packed(message | {"gamepad": {}}))
    view.meshcat.SetSliderValue("surge force [N]", 0.06)
    again = stick.GetOutputPort("reference").Eval(stick.CreateDefaultContext())
    np.testing.assert_allclose(again, [0.06, 0.0, 0.0])


def test_a_slider_needs_limits() -> None:
    changes = {"method": "cbf-qp", "input_set": {"lower": [float("-inf"), -4.5]}}
    scenario = load_scenario("car-avoidance", changes)
    view = LiveView([scenario], lambda address: None)
    with pytest.raises(InvalidValueError, match=r"input_set.*finite, for a slider"):
        Stick(view.meshcat, scenario)


@pytest.mark.slow
def test_a_browser_shows_the_present() -> None:
    def act(address: str) -> dict[str, Any]:
        with browser() as tab:
            tab.open(address)
            text = "document.getElementById('{}')?.innerText ?? null".format
            over = "document.documentElement.classList.contains('over') || null"
            assert tab.settle(over)  # However late the run is.
            assert tab.settle(text("clock")).startswith("3.00 s")
            path = "['drake', 'vehicle', '0', 'point']"
            x = f"viewer.scene_tree.find({path}).object.position.x"
            kinds = "viewer.scene.children.map((each) => each.geometry?.type)"
            return {
                "x": tab.settle(x),  # By another connection than the rest.
                "kinds": tab.evaluate(kinds),
                "class": tab.evaluate("document.documentElement.className"),
                "errors": [each for each in tab.errors if "WebSocket" not in each],
            }

    result, seen = watched(act, duration=3.0, target=[5.0, 0.0])
    assert seen["x"] == pytest.approx(result.log["state"][-1, 0], abs=0.05)
    assert "TubeGeometry" in seen["kinds"]
    assert seen["class"] == "live over"
    assert not seen["errors"]


GAMEPAD = """navigator.getGamepads = () => [null, {
  connected: true, index: 1, axes: [0.5, -1], buttons: [{ value: 0 }],
}];"""


@pytest.mark.slow
def test_a_gamepad_in_a_browser_drives() -> None:
    scenario = load_scenario("car-avoidance", {"duration": 2.0})
    found: list[Future[Any]] = []

    def act(address: str) -> list[str]:
        with browser() as tab:
            tab.call("Page.addScriptToEvaluateOnNewDocument", source=GAMEPAD)
            tab.open(address)
            ended = "document.documentElement.className"
            assert tab.settle(f"{ended} === 'live driven over' || null")
            return [each for each in tab.errors if "WebSocket" not in each]

    with ThreadPoolExecutor() as beside:
        view = LiveView([scenario], lambda url: found.append(beside.submit(act, url)))
        stick = Stick(view.meshcat, scenario)
        result = simulate(scenario, step_time=False, watch=view, controller=stick)
        view.close()
        assert not found[0].result(60.0)
    np.testing.assert_allclose(result.log["reference"][-1], [1.5, 4.5])
