"""A user's own diagram replayed: its SceneGraph, and its filter's plots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import FrameId, Rgba, Role, SceneGraph, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import VectorLog

from vcbf_drake.checks import Array, check_finite, check_parameter, require
from vcbf_drake.errors import naming_user_code
from vcbf_drake.plants.shapes import Part
from vcbf_drake.safety import SafetyFilter, unpack_feasible_set
from vcbf_drake.simulation.sections import InputLimits
from vcbf_drake.viz.replay import write_page
from vcbf_drake.viz.replay.page import page_data, whole_page
from vcbf_drake.viz.replay.scene import draw_body, draw_room, private_meshcat, record
from vcbf_drake.viz.runs import Drawn, Event
from vcbf_drake.viz.stage import MAX_FRAMES, Moving, View
from vcbf_drake.viz.style import BLUE

Log: TypeAlias = VectorLog | Mapping[str, ArrayLike]

_LOOK_FROM = np.deg2rad(-112.0), np.deg2rad(28.0)  # Azimuth and elevation of the eye.
_GREY = Rgba(0.9, 0.9, 0.9, 1.0)
_SCALARS = ("slack", "volume", "status")
_SERIES = (
    *("barriers", "volume", "slack", "reference", "input", "polytope_A"),
    *("polytope_b", "ellipsoid_shape", "ellipsoid_center"),
)


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
        duration: The duration of the run [s]; the diagram may end it earlier.
        context: The initial context, which is not changed. The default context if None.
            With a log, what everything but the plant's state is taken from.
        title: The page's title; the diagram's name if empty.
        log: In the place of a duration: the plant's state as a `VectorLogSink` logged
            it, or arrays such as ``numpy.load("log.npz")`` has: ``time`` (T,) and
            ``state`` (T, n), and for the plots those of a `Result`'s log. Between two
            ticks the state is interpolated.
        plant: Whose state the log has; the system called ``plant`` if None.

    Returns:
        The path.

    Raises:
        ValueError: The diagram has no SceneGraph, or nothing in it to show; not one of
            duration and log was given; a number of them is not finite, or the log's
            times do not increase; it is unclear whose state the log has.
    """
    scene_graph = _first(diagram, SceneGraph)
    if scene_graph is None:
        raise ValueError(f"diagram {diagram.get_name()}: it has no SceneGraph")
    inspector = scene_graph.model_inspector()
    parts = {each: [*_parts(inspector, each)] for each in inspector.GetAllFrameIds()}
    poses: dict[FrameId, list[RigidTransform]] = {f: [] for f in parts if parts[f]}
    if not poses:
        raise ValueError("SceneGraph: nothing in it has the illustration role")
    now = diagram.CreateDefaultContext() if context is None else context.Clone()
    safety_filter = _first(diagram, SafetyFilter)
    arrays = None
    if log is None and duration is not None:
        check_parameter("duration", duration)
        steps = _simulated(diagram, now, duration)
    elif log is not None and duration is None:
        arrays = _arrays(log)
        steps = _replayed(diagram, now, arrays, plant)
    else:
        raise ValueError("duration, log: one of the two says what to replay")
    frames, rows = list[float](), list[dict[str, Any]]()
    for time in steps:
        frames.append(time)
        port = scene_graph.get_query_output_port()
        query = port.Eval(scene_graph.GetMyContextFromRoot(now))
        for frame, way in poses.items():  # Drake's own poses go on changing.
            way.append(RigidTransform(query.GetPoseInWorld(frame)))
        if arrays is None and safety_filter is not None:
            rows.append(filter_values(safety_filter, now))
    end = max(frames[-1], 1e-3)  # It may end at once.
    times = np.linspace(0.0, end, len(frames))
    bodies = [
        Moving(f"frames/{number}", parts[frame], times, way)
        for number, (frame, way) in enumerate(poses.items())
    ]
    sources = [inspector.GetOwningSourceName(frame) for frame in poses]
    *trails, farthest = _ways(bodies, sources)
    title = title or diagram.get_name() or "Replay"
    shown = Drawn(title, BLUE, (), False, (), np.array(frames), {}, (), None, False)
    if duration is not None and frames[-1] < duration - 1e-9:
        ended = Event(frames[-1], "infeasible", f"ended at {frames[-1]:.2f} s")
        shown = replace(shown, events=[ended])
    if rows:
        series = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        shown = replace(shown, log=series)
    elif arrays is not None and all(name in arrays for name in _SERIES):
        since = arrays["time"] - arrays["time"][0]
        shown = replace(shown, log=arrays, time=since)
    if safety_filter is not None and shown.log:
        shown = _filtered(shown, safety_filter)
    view, meshcat = _view(bodies), private_meshcat()
    draw_room(meshcat, view)
    for body in bodies:
        draw_body(meshcat, body)
    page = record(meshcat, max(len(frames) - 1, 1) / end, bodies)
    data = page_data([(shown, farthest)], view, end, "", trails=trails)
    return write_page(path, whole_page(page, data, title))


def _filtered(shown: Drawn, safety_filter: SafetyFilter) -> Drawn:
    """The diagram, with the name and the inputs of its filter."""
    inputs = [f"input {k}" for k in range(safety_filter.model.num_inputs)]
    box = safety_filter.input_set
    ends = box.center - box.scale, box.center + box.scale
    limits = InputLimits(*(each.tolist() for each in ends))
    return replace(
        shown,
        label=safety_filter.get_name(),
        inputs=inputs,
        limits=limits,
        has_volume=safety_filter.method.has_volume_row,
    )


def _ways(bodies: Sequence[Moving], sources: Sequence[str]) -> list[Array]:
    """For every source the path of the moving body; the longest one last."""
    ways = [np.array([pose.translation() for pose in b.poses]) for b in bodies]
    travel = [float(np.ptp(each, axis=0).sum()) for each in ways]
    *ranked, last = sorted(range(len(bodies)), key=travel.__getitem__)
    farthest = {sources[index]: index for index in ranked if travel[index] > 1e-6}
    farthest.pop(sources[last], None)
    return [ways[index] for index in [*farthest.values(), last]]


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
    """The illustration geometry of a frame."""
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        properties = inspector.GetIllustrationProperties(geometry)
        color = properties.GetPropertyOrDefault("phong", "diffuse", _GREY)
        name = f"{int(geometry.get_value())}"
        pose = inspector.GetPoseInFrame(geometry)
        channels = (color.r(), color.g(), color.b())
        hexadecimal = "#" + "".join(f"{round(255 * each):02x}" for each in channels)
        yield Part(name, inspector.GetShape(geometry), hexadecimal, pose)


def _times(duration: float) -> Array:
    """The times of the frames [s]."""
    count = int(np.clip(np.ceil(30.0 * duration), 1, MAX_FRAMES))
    return np.linspace(0.0, duration, count + 1)


def _simulated(diagram: Diagram, context: Context, duration: float) -> Iterator[float]:
    """Simulates from frame to frame; yields the time since the start at each [s]."""
    simulator, begin = Simulator(diagram, context), context.get_time()
    for time in _times(duration):
        with naming_user_code(context.get_time):
            status = simulator.AdvanceTo(begin + time)
        yield context.get_time() - begin
        if status.reason() != SimulatorStatus.ReturnReason.kReachedBoundaryTime:
            return


def _arrays(log: Log) -> dict[str, Array]:
    """The arrays of a log, after checking the times and the states."""
    if isinstance(log, VectorLog):
        log = {"time": log.sample_times(), "state": log.data().T}
    require(isinstance(log, Mapping), "log", log, "a VectorLog, or arrays by name")
    arrays = {name: np.asarray(values) for name, values in log.items()}
    missing = [name for name in ("time", "state") if name not in arrays]
    if missing:
        raise ValueError(f"log: it has no {' and no '.join(missing)}")
    time, state = arrays["time"], np.atleast_2d(arrays["state"])
    if len(time) == 0 or len(time) != len(state):
        raise ValueError(f"log: {len(time)} times, {len(state)} states")
    for name, values in (("time", time), ("state", state)):
        check_finite(("log", name), values.ravel().tolist(), size=values.size)
    (back,) = np.nonzero(np.diff(time) < 0.0)
    rule = "of times that do not go back"
    require(not len(back), ("log", "time"), time[back[:1] + 1], rule)
    return arrays | {"state": state}


def _replayed(
    diagram: Diagram, context: Context, log: Mapping[str, Array], plant: System | None
) -> Iterator[float]:
    """Puts a log's state into the context at every frame; yields as `_simulated`."""
    time, state = log["time"], log["state"]
    named = (each for each in _systems(diagram) if each.get_name() == "plant")
    holder = plant or next(named, None)
    if holder is None:
        raise ValueError("plant: None; it must be the system whose state the log has")
    own = holder.GetMyMutableContextFromRoot(context)
    is_continuous = own.num_continuous_states() > 0
    put = own.SetContinuousState if is_continuous else own.SetDiscreteState
    size = own.num_continuous_states() or own.get_discrete_state_vector().size()
    rule = f"a state of {size} numbers a row, as the plant has"
    require(state.shape[1] == size, ("log", "state"), state[0], rule)
    for since in _times(max(float(time[-1] - time[0]), 1e-3)):
        at = time[0] + since
        context.SetTime(at)
        put(np.array([np.interp(at, time, each) for each in state.T]))
        yield since


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


def _view(bodies: Sequence[Moving]) -> View:
    """The box around everything that is shown, with a border, as seen from a corner."""
    everything = np.vstack([body.reached for body in bodies])
    low, high = everything.min(axis=0), everything.max(axis=0)
    border = 0.05 * float(np.linalg.norm(high - low)) * np.array([1.0, 1.0, 0.0])
    low, high = low - border, high + border
    span = max(float(np.linalg.norm(high - low)), 1e-3)
    azimuth, elevation = _LOOK_FROM
    return View(
        points=np.array([*product(*zip(low, high, strict=True))]),
        low=low,
        high=high,
        span=span,
        toward=np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]),
        rise=0.04 * span,
        places=(),
        few=sum(len(body.parts) for body in bodies) < 100,
    )
