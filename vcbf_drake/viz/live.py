"""A run in real time in a browser: Meshcat's scene, the plots beside it, a pause."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
import json
from threading import Event, Thread
import time
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, Diagram, LeafSystem

from vcbf_drake.checks import Array, require
from vcbf_drake.model.interface import state_port_of
from vcbf_drake.plants.vehicle import channels_of
from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation.result import Result
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.viz import runs
from vcbf_drake.viz.replay import stage_data, stage_words
from vcbf_drake.viz.replay.page import series_data, whole_page
from vcbf_drake.viz.replay.recording import filter_values
from vcbf_drake.viz.replay.scene import draw_stage, private_meshcat
from vcbf_drake.viz.solids import in_space
from vcbf_drake.viz.stage import Stage, body_path, set_stage

_PLOTTED = 0.1  # Time between two points of the plots, at least [s].
_NOTHING_YET = dict.fromkeys(("outcome", "infeasible_at", "collided_at", "reached_at"))
_LOOK_AGAIN = 0.02  # The period of checks for news to a browser [s].
_DEAD = 0.08  # The greatest deflection of a stick at rest.
_KEYS = ("ArrowLeft", "ArrowRight"), ("ArrowDown", "ArrowUp")


class LiveView:
    """Shows a run while it goes on; `simulate` calls it as its `watch`.

    It holds the run up: before the first browser has opened the page, while that is
    paused, and to real time.
    """

    def __init__(
        self, scenarios: Sequence[Scenario], tell: Callable[[str], None]
    ) -> None:
        """Starts the page's server, which this computer alone can see.

        Args:
            scenarios: The scenario of each vehicle of the run.
            tell: Called with the page's address, once.
        """
        self.meshcat = private_meshcat()
        self._scenarios, self._tell = scenarios, tell
        self._stage: Stage | None = None
        self._known: set[tuple[int, str]] = set()  # Whose events have been told.
        self._next_point = 0.0
        self._lead = 0.0  # The wall clock less the time of the motion [s].
        self._stream = _Stream()

    def __call__(self, diagram: Diagram, context: Context) -> None:
        """Shows the present; returns when it is time to go on."""
        loops = [diagram]
        if len(self._scenarios) > 1:
            loops = [diagram.GetSubsystemByName(each.name) for each in self._scenarios]
        now, pairs = context.get_time(), [*zip(self._scenarios, loops, strict=True)]
        if self._stage is None:
            begun = [Result(s, _NOTHING_YET, _present(x, context)) for s, x in pairs]
            self._stage = set_stage(begun)
            self._open(self._stage)
        for index, (scenario, loop) in enumerate(pairs):
            for body, pose in scenario.vehicle.poses(_state(loop, context)).items():
                self.meshcat.SetTransform(body_path(index, body), pose)
        for index, solid in enumerate(self._stage.solids):
            if solid.moves:
                offset = RigidTransform(solid.offset_at(now))
                self.meshcat.SetTransform(f"obstacles/{index}", offset)
        if now >= self._next_point:
            self._next_point = now + _PLOTTED
            logs = [_present(loop, context) for loop in loops]
            self._stream.send([self._point(k, log) for k, log in enumerate(logs)])
        self._stream.going.wait()
        early = self._lead + now - time.monotonic()
        time.sleep(max(early, 0.0))
        self._lead -= min(early, 0.0)  # Lost time is not made up for.

    def close(self) -> None:
        """Ends the page's server; what the browsers show stays as it is."""
        self._stream.close()

    def _open(self, stage: Stage) -> None:
        draw_stage(self.meshcat, stage)
        data = stage_data(stage, live=True) | {
            "duration": self._scenarios[0].duration,
            "sliders": bool(self.meshcat.GetSliderNames()),
        }
        address = self.meshcat.web_url()
        with urlopen(address) as answer:
            page = answer.read().decode()
        page = page.replace("url = location.toString()", f'url = "{address}/"')
        page = whole_page(page, data, **stage_words(stage))
        self._tell(self._stream.serve(page.encode(), address))
        self._stream.opened.wait()
        self._lead = time.monotonic()

    def _point(self, index: int, log: dict[str, Array]) -> dict[str, Any]:
        """The new data of a vehicle for the page."""
        assert self._stage is not None  # There is no point before the stage.
        now, run = float(log["time"][0]), self._stage.runs[index]
        place = run.vehicle.positions(log["state"])
        away = float(np.linalg.norm(place[0] - run.scenario.target))
        found = []
        for kind, holds, words in (
            ("infeasible", log["status"][0] >= FilterStatus.INFEASIBLE, "since"),
            ("collision", np.nanmin(log["barriers"], initial=0.0) < 0.0, "at"),
            ("reached", away <= run.scenario.arrival_distance, "at"),
        ):
            if holds and (index, kind) not in self._known:
                self._known.add((index, kind))
                found.append(runs.Event(now, kind, f"{kind} {words} {now:.1f} s"))
        present = replace(run, events=found, time=log["time"], log=log)
        return series_data(present, in_space(place))


def _state(loop: Diagram, context: Context) -> Array:
    """The state of a loop's plant."""
    plant = loop.GetSubsystemByName("plant")
    state: Array = state_port_of(plant).Eval(plant.GetMyContextFromRoot(context))
    return state


def _present(loop: Diagram, context: Context) -> dict[str, Array]:
    """The arrays of a log of the present alone."""
    values = filter_values(loop.GetSubsystemByName("filter"), context)
    values |= {"time": context.get_time(), "state": _state(loop, context)}
    return {name: np.array([each], dtype=float) for name, each in values.items()}


class Stick(LeafSystem):
    """Sliders of a Meshcat page, or a gamepad, in the place of a controller.

    A gamepad's axes are the inputs in their order, to the right and up is more: in its
    middle an axis stands for 0, or the limit next to it, at its ends for the limits.

    Ports:
        state (n): not looked at.
        reference (m), output: the input that the person wants.
    """

    def __init__(self, meshcat: Meshcat, scenario: Scenario) -> None:
        """Adds a slider for every input, from its least to its greatest value.

        Args:
            meshcat: The Meshcat whose page shows the sliders.
            scenario: The scenario of the run.

        Raises:
            InvalidValueError: An input has no limit.
        """
        super().__init__()
        channels = channels_of(scenario.vehicle.make_plant())
        limits = scenario.input_set
        self._meshcat, self._names = meshcat, channels.input_labels
        self._low, self._high = np.array(limits.lower), np.array(limits.upper)
        is_finite = bool(np.isfinite([self._low, self._high]).all())
        rule = "finite, for a slider has two ends"
        require(is_finite, "input_set", [limits.lower, limits.upper], rule)
        self._rest = np.clip(0.0, self._low, self._high)
        for k, name in enumerate(self._names):
            low, high = float(self._low[k]), float(self._high[k])
            step, keys = (high - low) / 20.0, _KEYS[k] if k < len(_KEYS) else ("", "")
            meshcat.AddSlider(name, low, high, step, float(self._rest[k]), *keys)
        self.DeclareVectorInputPort("state", len(scenario.initial_state))
        self.DeclareVectorOutputPort(
            "reference", len(self._names), self._calc_reference, {self.time_ticket()}
        )

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        found = self._meshcat.GetGamepad().axes
        if not found:  # Its index stays when it is unplugged.
            wish = [self._meshcat.GetSliderValue(name) for name in self._names]
        else:
            axes = np.resize(np.array(found), len(self._names))
            axes[1::2] *= -1.0  # A stick's way up is negative.
            axes[np.abs(axes) < _DEAD] = 0.0  # Nobody's thumb is on it.
            ends = np.where(axes < 0.0, self._low, self._high)
            wish = self._rest + np.abs(axes) * (ends - self._rest)
        output.SetFromVector(wish)


class _Stream:
    """A page, and what has to be added to it as the run goes on."""

    def __init__(self) -> None:
        self._news: list[bytes] = []
        self._over, self.going, self.opened = Event(), Event(), Event()
        self.going.set()
        self._server: ThreadingHTTPServer | None = None

    def serve(self, page: bytes, meshcat: str) -> str:
        """Serves the page on a free port of this computer; returns its address.

        Args:
            page: The page.
            meshcat: The address of what it was made from, which has the rest of it.
        """
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                kind, content = "text/html", page
                if self.path == "/stream":
                    kind, content = "text/event-stream", b""
                elif self.path != "/":
                    try:
                        with urlopen(meshcat + self.path) as answer:
                            kind = answer.headers.get_content_type()
                            content = answer.read()
                    except HTTPError as error:
                        return self.send_error(error.code)
                self.send_response(200)
                self.send_header("Content-Type", f"{kind}; charset=utf-8")
                self.end_headers()
                with suppress(OSError):  # When the browser leaves.
                    self.wfile.write(content)
                    if self.path == "/stream":
                        stream._write_to(self.wfile)

            def do_POST(self) -> None:
                (stream.going.clear if self.path == "/pause" else stream.going.set)()
                self.send_response(204)
                self.end_headers()

            def log_message(self, *args: Any) -> None:
                """No log: nobody reads the requests."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        Thread(target=self._server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{self._server.server_port}/"

    def send(self, news: Sequence[Mapping[str, Any]]) -> None:
        """Adds to every page that is open, or will be."""
        self._news.append(json.dumps(news, allow_nan=False).encode())

    def _write_to(self, file: BufferedIOBase) -> None:
        """Writes everything, and what comes, until the run is over."""
        self.opened.set()
        count, over = 0, False
        while not over:
            over = self._over.wait(_LOOK_AGAIN)
            for each in self._news[count:]:
                file.write(b"data: " + each + b"\n\n")
                count += 1
        file.write(b"event: over\ndata:\n\n")

    def close(self) -> None:
        """Tells the browsers that the run is over, and closes."""
        self._over.set()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
