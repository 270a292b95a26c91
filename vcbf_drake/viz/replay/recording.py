"""A user's own diagram replayed: its SceneGraph, and its filter's plots."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import FrameId, Rgba, Role, SceneGraph, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import VectorLog

from vcbf_drake.checks import Array
from vcbf_drake.errors import naming_user_code
from vcbf_drake.plants.shapes import Part
from vcbf_drake.safety import SafetyFilter, unpack_feasible_set
from vcbf_drake.simulation.scenario import InputLimits
from vcbf_drake.viz.replay.page import Words, page_data, write_page
from vcbf_drake.viz.replay.scene import (
    draw_body,
    draw_mesh,
    draw_room,
    private_meshcat,
    record,
)
from vcbf_drake.viz.replay.tubes import tube
from vcbf_drake.viz.runs import Drawn, Event
from vcbf_drake.viz.scene_graph import BLUE
from vcbf_drake.viz.stage import MAX_FRAMES, Moving, View

Log: TypeAlias = VectorLog | Mapping[str, ArrayLike]

_LOOK_FROM = np.deg2rad(-112.0), np.deg2rad(28.0)  # Azimuth and elevation of the eye.
_GREY = Rgba(0.9, 0.9, 0.9, 1.0)
_SCALARS = ("slack", "volume", "status")
_SERIES = (
    *("barriers", "volume", "slack", "reference", "input", "polytope_A"),
    *("polytope_b", "ellipsoid_shape", "ellipsoid_center"),
)


@dataclass
class _Recording:
    """What happened.

    Attributes:
        frames: The frames' times, at equal steps from 0 [s].
        poses: Every frame's pose in the world, by its identifier.
        log: The arrays of the filter's ports, as a `Result` has them.
        time: The log's times, if they are not the frames' [s].
        events: How it ended, if it ended early.
    """

    frames: list[float] = field(default_factory=list)
    poses: dict[FrameId, list[RigidTransform]] = field(
        default_factory=lambda: defaultdict(list)
    )
    log: dict[str, Array] = field(default_factory=dict)
    time: Array | None = None
    events: list[Event] = field(default_factory=list)


def write_diagram_replay(
    diagram: Diagram,
    path: Path,
    duration: float | None = None,
    context: Context | None = None,
    title: str = "",
    *,
    log: Log | None = None,
    plant: System | None = None,
) -> Path:
    """Writes the page that replays a diagram: runs it, or takes a log of its motion.

    What the diagram has registered with its SceneGraph for illustration is what the
    page shows; if it holds a `SafetyFilter`, the plots and the feasible set of the
    first one stand below. Of every source of the SceneGraph, a vehicle's say, the frame
    that travels farthest leaves a trail.

    Args:
        diagram: A built diagram with a SceneGraph.
        path: The page to write; its directory is made.
        duration: How long to run it [s]; it may end itself earlier.
        context: Where it starts; left as it is. The default context if None. With a
            log, what everything but the plant's state is taken from.
        title: The page's title; the diagram's name if empty.
        log: In the place of a duration: the plant's state as a `VectorLogSink` logged
            it, or arrays such as ``numpy.load("log.npz")`` has: ``time`` (T,) and
            ``state`` (T, n), and for the plots those of a `Result`'s log. Between two
            ticks the state is interpolated.
        plant: Whose state the log has. The system called ``plant`` if None, or the only
            one with as many states.

    Returns:
        The path.

    Raises:
        ValueError: The diagram has no SceneGraph, or nothing in it to show; not one of
            duration and log was given; it is unclear whose state the log has.
    """
    if (duration is None) == (log is None):
        raise ValueError("duration, log: one of the two says what to replay")
    scene_graph = _first(diagram, SceneGraph)
    if scene_graph is None:
        raise ValueError(f"diagram {diagram.get_name()}: it has no SceneGraph")
    start = diagram.CreateDefaultContext() if context is None else context.Clone()
    inspector = scene_graph.model_inspector()
    found = {each: [*_parts(inspector, each)] for each in inspector.GetAllFrameIds()}
    frames = {frame: parts for frame, parts in found.items() if parts}
    if not frames:
        raise ValueError("SceneGraph: nothing in it has the illustration role")
    safety_filter, recording = _first(diagram, SafetyFilter), _Recording()
    moments = (
        _run(diagram, start, duration, safety_filter, recording)
        if duration is not None
        else _follow(diagram, start, log, plant, recording)
    )
    for time in moments:
        recording.frames.append(time)
        port = scene_graph.get_query_output_port()
        query = port.Eval(scene_graph.GetMyContextFromRoot(start))
        for frame in frames:
            pose = query.GetPoseInWorld(frame)  # Drake's own, which goes on changing.
            recording.poses[frame].append(RigidTransform(pose))
    sources = {frame: inspector.GetOwningSourceName(frame) for frame in frames}
    words = Words(title or diagram.get_name() or "Replay")
    return _write(path, words, frames, recording, safety_filter, sources)


def _first(diagram: Diagram, kind: type) -> Any:
    """The first system of a kind in a diagram, at whatever depth; None without."""
    return next((each for each in _systems(diagram) if isinstance(each, kind)), None)


def _systems(diagram: Diagram) -> Iterator[System]:
    """Every system in a diagram, at whatever depth."""
    for system in diagram.GetSystems():
        yield system
        if isinstance(system, Diagram):
            yield from _systems(system)


def _parts(inspector: SceneGraphInspector, frame: FrameId) -> Iterator[Part]:
    """What a frame carries for illustration."""
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        properties = inspector.GetIllustrationProperties(geometry)
        color = properties.GetPropertyOrDefault("phong", "diffuse", _GREY)
        name = f"{int(geometry.get_value())}"
        pose = inspector.GetPoseInFrame(geometry)
        channels = (color.r(), color.g(), color.b())
        hexadecimal = "#" + "".join(f"{round(255 * each):02x}" for each in channels)
        yield Part(name, inspector.GetShape(geometry), hexadecimal, pose)


def _run(
    diagram: Diagram,
    context: Context,
    duration: float,
    safety_filter: SafetyFilter | None,
    recording: _Recording,
) -> Iterator[float]:
    """Simulates; yields the time of each frame when the context is there."""
    simulator = Simulator(diagram, context)
    begin, rows = context.get_time(), list[dict[str, Any]]()
    count = int(np.clip(np.ceil(30.0 * duration), 1, MAX_FRAMES))
    for time in np.linspace(0.0, duration, count + 1):
        with naming_user_code(context.get_time):
            status = simulator.AdvanceTo(begin + time)
        now = context.get_time() - begin
        if safety_filter is not None:
            rows.append(filter_values(safety_filter, context))
        yield now
        if status.reason() != SimulatorStatus.ReturnReason.kReachedBoundaryTime:
            words = f"ended at {now:.2f} s"
            recording.events.append(Event(now, "infeasible", words))
            break
    recording.log = {
        name: np.array([row[name] for row in rows]) for name in (rows or [{}])[0]
    }


def _follow(
    diagram: Diagram,
    context: Context,
    log: Log | None,
    plant: System | None,
    recording: _Recording,
) -> Iterator[float]:
    """Puts a logged state into the context; yields the time of each frame then."""
    if isinstance(log, VectorLog):
        log = {"time": log.sample_times(), "state": log.data().T}
    arrays = {name: np.asarray(values) for name, values in (log or {}).items()}
    missing = [name for name in ("time", "state") if name not in arrays]
    if missing:
        raise ValueError(f"log: it has no {' and no '.join(missing)}")
    time, state = arrays["time"], np.atleast_2d(arrays["state"])
    if len(time) == 0 or len(time) != len(state):
        raise ValueError(f"log: {len(time)} times, {len(state)} states")
    own = _holder(diagram, context, state.shape[1], plant)
    own = own.GetMyMutableContextFromRoot(context)
    span = max(float(time[-1] - time[0]), 1e-3)
    count = int(np.clip(np.ceil(30.0 * span), 1, MAX_FRAMES))
    for now in np.linspace(0.0, span, count + 1):
        at = float(time[0] + now)
        x = np.array([np.interp(at, time, each) for each in state.T])
        context.SetTime(at)
        if own.num_continuous_states() == len(x):
            own.SetContinuousState(x)
        else:
            own.SetDiscreteState(x)
        yield float(now)
    if all(name in arrays for name in _SERIES):
        recording.time = time - time[0]
        recording.log = arrays


def _holder(
    diagram: Diagram, context: Context, size: int, plant: System | None
) -> System:
    """The system whose state has a size: the plant given, or the only one."""

    def holds(system: System) -> bool:
        own = system.GetMyContextFromRoot(context)
        groups = own.num_discrete_state_groups()
        discrete = own.get_discrete_state_vector().size() if groups == 1 else -1
        return size in (own.num_continuous_states(), discrete)

    if plant is not None:
        found = [plant] if holds(plant) else []
    else:
        found = [each for each in _systems(diagram) if holds(each)]
        found = [each for each in found if each.get_name() == "plant"] or found
    if len(found) != 1:
        names = ", ".join(each.get_name() for each in found) or "none"
        raise ValueError(
            f"log: its state has {size} numbers; systems with such a state: {names}."
            " plant= says whose it is"
        )
    return found[0]


def filter_values(safety_filter: SafetyFilter, root: Context) -> dict[str, Any]:
    """The values of a filter's ports, one row of each array of a `Result`'s log.

    Args:
        safety_filter: The filter.
        root: The context of the whole diagram.
    """
    context = safety_filter.GetMyContextFromRoot(root)
    ports = {
        name: safety_filter.GetOutputPort(name).Eval(context)
        for name in (*_SCALARS, "barriers", "feasible_set", "command")
    }
    found = unpack_feasible_set(
        ports["feasible_set"][None],
        safety_filter.num_rows,
        safety_filter.model.num_inputs,
    )
    return {
        **{name: ports[name][0] for name in _SCALARS},
        "barriers": ports["barriers"],
        "reference": safety_filter.GetInputPort("reference").Eval(context),
        "input": ports["command"],
        "polytope_A": found.A[0],
        "polytope_b": found.b[0],
        "ellipsoid_shape": found.shape[0],
        "ellipsoid_center": found.center[0],
    }


def _write(
    path: Path,
    words: Words,
    frames: dict[FrameId, list[Part]],
    recording: _Recording,
    safety_filter: SafetyFilter | None,
    sources: dict[FrameId, str],
) -> Path:
    bodies = {
        frame: Moving(f"frames/{number}", parts, recording.poses[frame])
        for number, (frame, parts) in enumerate(frames.items())
    }
    places = {
        frame: np.array([pose.translation() for pose in body.poses])
        for frame, body in bodies.items()
    }
    travel = {frame: float(np.ptp(places[frame], axis=0).sum()) for frame in places}
    ranked = sorted(travel, key=travel.__getitem__)
    farthest = {sources[frame]: frame for frame in ranked}
    view = _view([*bodies.values()])
    meshcat = private_meshcat()
    draw_room(meshcat, view)
    for number, frame in enumerate(farthest.values()):
        if travel[frame] > 1e-6:
            way = tube(places[frame], 0.0016 * view.span)
            draw_mesh(meshcat, f"trail/{number}", way, BLUE)
    for body in bodies.values():
        draw_body(meshcat, body)
    duration = max(recording.frames[-1], 1e-3)
    rate = max(len(recording.frames) - 1, 1) / duration
    times = np.arange(len(recording.frames)) / rate
    tracks = [(each.path, times, each.poses) for each in bodies.values() if each.moves]
    page = record(meshcat, rate, tracks)
    label, inputs, limits = words.title, list[str](), None
    if safety_filter is not None and recording.log:
        label, limits = safety_filter.get_name(), _limits(safety_filter)
        inputs = [f"input {k}" for k in range(safety_filter.model.num_inputs)]
    time = recording.frames if recording.time is None else recording.time
    shown = Drawn(
        label, BLUE, (), False, recording.events, np.array(time), recording.log,
        inputs, limits,
    )  # fmt: skip
    data = page_data([(shown, places[ranked[-1]])], view, duration, "")
    return write_page(page, words, data, path)


def _view(bodies: list[Moving]) -> View:
    """The box around everything that is shown, with a border, as seen from a corner."""
    everything = np.vstack([body.reached for body in bodies])
    low, high = everything.min(axis=0), everything.max(axis=0)
    border = 0.05 * float(np.linalg.norm(high - low)) * np.array([1.0, 1.0, 0.0])
    low, high = low - border, high + border
    span = max(float(np.linalg.norm(high - low)), 1e-3)
    azimuth, elevation = _LOOK_FROM
    return View(
        points=np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T,
        low=low,
        high=high,
        span=span,
        toward=np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]),
        rise=0.04 * span,
        places=(),
        few=sum(len(body.parts) for body in bodies) < 100,
    )


def _limits(safety_filter: SafetyFilter) -> InputLimits:
    inputs = safety_filter.input_set
    low, high = inputs.center - inputs.scale, inputs.center + inputs.scale
    return InputLimits(low.tolist(), high.tolist())
