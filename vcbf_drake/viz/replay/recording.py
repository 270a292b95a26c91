"""A user's own diagram, run and replayed: its SceneGraph, and its filter's plots."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import (
    FrameId,
    Meshcat,
    Rgba,
    Role,
    SceneGraph,
    SceneGraphInspector,
)
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.checks import Array
from vcbf_drake.errors import naming_user_code
from vcbf_drake.plants.shapes import Part, bounding_box
from vcbf_drake.safety import SafetyFilter, unpack_feasible_set
from vcbf_drake.simulation.scenario import InputLimits
from vcbf_drake.viz.replay import scene
from vcbf_drake.viz.replay.page_data import Shown, Words, series_data, tick_labels
from vcbf_drake.viz.replay.pages import private_meshcat, write_page
from vcbf_drake.viz.runs import Event
from vcbf_drake.viz.scene_graph import BLUE
from vcbf_drake.viz.stage import MAX_FRAMES, cell_size

_LOOK_FROM = np.deg2rad(-112.0), np.deg2rad(28.0)  # Azimuth and elevation of the eye.
_GREY = Rgba(0.9, 0.9, 0.9, 1.0)
_SCALARS = ("slack", "volume", "status")


@dataclass
class _Recording:
    """What happened, a frame at a time.

    Attributes:
        time: The frames' times [s].
        poses: Every frame's pose in the world, by its identifier.
        log: The arrays of the filter's ports, as a `Result` has them.
        events: How it ended, if it ended early.
    """

    time: list[float] = field(default_factory=list)
    poses: dict[FrameId, list[RigidTransform]] = field(
        default_factory=lambda: defaultdict(list)
    )
    log: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))
    events: list[Event] = field(default_factory=list)


def write_diagram_replay(
    diagram: Diagram,
    path: Path,
    duration: float,
    context: Context | None = None,
    title: str = "",
) -> Path:
    """Runs a diagram and writes the page that replays it.

    What the diagram has registered with its SceneGraph for illustration is what the
    page shows; if it holds a `SafetyFilter`, the plots and the feasible set of the
    first one stand below. Of every source of the SceneGraph, a vehicle's say, the frame
    that travels farthest leaves a trail.

    Args:
        diagram: A built diagram with a SceneGraph.
        path: The page to write; its directory is made.
        duration: How long to run it [s]; it may end itself earlier.
        context: Where it starts; left as it is. The default context if None.
        title: The page's title; the diagram's name if empty.

    Returns:
        The path.

    Raises:
        ValueError: The diagram has no SceneGraph, or nothing in it to show.
    """
    scene_graph = _first(diagram, SceneGraph)
    if scene_graph is None:
        raise ValueError(f"diagram {diagram.get_name()}: it has no SceneGraph")
    start = diagram.CreateDefaultContext() if context is None else context.Clone()
    frames = {
        frame: list(_parts(scene_graph.model_inspector(), frame))
        for frame in scene_graph.model_inspector().GetAllFrameIds()
    }
    frames = {frame: parts for frame, parts in frames.items() if parts}
    if not frames:
        raise ValueError("SceneGraph: nothing in it has the illustration role")
    safety_filter = _first(diagram, SafetyFilter)
    recording = _record(diagram, start, duration, scene_graph, safety_filter, frames)
    words = Words(title or diagram.get_name() or "Replay")
    inspector = scene_graph.model_inspector()
    sources = {frame: inspector.GetOwningSourceName(frame) for frame in frames}
    return _write(path, words, frames, recording, safety_filter, sources)


def _first(diagram: Diagram, kind: type) -> Any:
    """The first system of a kind in a diagram, at whatever depth; None without."""
    for system in diagram.GetSystems():
        if isinstance(system, kind):
            return system
        if isinstance(system, Diagram) and (found := _first(system, kind)) is not None:
            return found
    return None


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


def _record(
    diagram: Diagram,
    context: Context,
    duration: float,
    scene_graph: SceneGraph,
    safety_filter: SafetyFilter | None,
    frames: dict[FrameId, list[Part]],
) -> _Recording:
    recording = _Recording()
    simulator = Simulator(diagram, context)
    begin = context.get_time()
    count = int(np.clip(np.ceil(30.0 * duration), 1, MAX_FRAMES))
    for time in np.linspace(0.0, duration, count + 1):
        with naming_user_code(context.get_time):
            status = simulator.AdvanceTo(begin + time)
        recording.time.append(context.get_time() - begin)
        port = scene_graph.get_query_output_port()
        query = port.Eval(scene_graph.GetMyContextFromRoot(context))
        for frame in frames:
            pose = query.GetPoseInWorld(frame)  # Drake's own, which goes on changing.
            recording.poses[frame].append(RigidTransform(pose))
        if safety_filter is not None:
            for name, value in filter_values(safety_filter, context).items():
                recording.log[name].append(value)
        reached = SimulatorStatus.ReturnReason.kReachedBoundaryTime
        if status.reason() != reached:
            words = f"ended at {recording.time[-1]:.2f} s"
            recording.events.append(Event(recording.time[-1], "infeasible", words))
            break
    return recording


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
    places = {
        frame: np.array([pose.translation() for pose in poses])
        for frame, poses in recording.poses.items()
    }
    travel = {frame: float(np.ptp(places[frame], axis=0).sum()) for frame in places}
    farthest: dict[str, FrameId] = {}
    for frame in sorted(travel, key=travel.__getitem__):
        farthest[sources[frame]] = frame
    leader = max(travel, key=travel.__getitem__)
    low, high = _extent(frames, recording)
    span = max(float(np.linalg.norm(high - low)), 1e-3)
    cell = cell_size(span)
    outline = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1])
                        for z in (low[2], high[2])])  # fmt: skip
    meshcat = private_meshcat()
    scene.add_light(meshcat, outline)
    scene.add_ground(meshcat, low, high, cell)
    for number, frame in enumerate(farthest.values()):
        if travel[frame] > 1e-6:
            path_name, thickness = f"trail/{number}", 0.0016 * span
            scene.add_trail(meshcat, path_name, places[frame], thickness, BLUE)
    rate = _animate(meshcat, frames, recording)
    name = safety_filter.get_name() if safety_filter is not None else words.title
    log = {key: np.array(values) for key, values in recording.log.items()}
    shown = Shown(
        name, BLUE, (), recording.events, places[leader], np.array(recording.time),
        log, _limits(safety_filter),
    )  # fmt: skip
    inputs = [f"input {k}" for k in range(log["input"].shape[1])] if log else []
    azimuth, elevation = _LOOK_FROM
    eye = [np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]
    data = {
        "duration": float(max(recording.time[-1], 1e-3)),
        "frames_per_second": rate,
        **series_data([shown], inputs, ""),
        "camera": {
            "points": outline.round(4).tolist(),
            "span": span,
            "direction": eye,
        },
        "sizes": {"vehicle": 0.04 * span, "marker": 0.01 * span},
        "labels": tick_labels(low, high, cell, eye),
        "round": sum(map(len, frames.values())) < 100,
    }
    return write_page(str(meshcat.StaticHtml()), words, data, path)


def _animate(
    meshcat: Meshcat, frames: dict[FrameId, list[Part]], recording: _Recording
) -> float:
    """Draws and records the frames; the recording's frames a second."""
    moving = []
    for number, (frame, parts) in enumerate(frames.items()):
        group = f"frames/{number}"
        for part in parts:
            scene.add_part(meshcat, f"{group}/{part.name}", part)
        poses = recording.poses[frame]
        meshcat.SetTransform(group, poses[0])
        if not all(pose.IsExactlyEqualTo(poses[0]) for pose in poses):
            moving.append((group, poses))
    steps = max(len(recording.time) - 1, 1)
    rate = steps / max(recording.time[-1], 1e-3)
    meshcat.StartRecording(rate, set_visualizations_while_recording=False)
    for group, poses in moving:
        for k, pose in enumerate(poses):
            meshcat.SetTransform(group, pose, k / rate)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return float(rate)


def _extent(
    frames: dict[FrameId, list[Part]], recording: _Recording
) -> tuple[Array, Array]:
    """The corners of the box around everything that is shown, with a border."""
    points = []
    for frame, parts in frames.items():
        low, high = bounding_box(parts)
        corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1)
        poses = recording.poses[frame]
        points += [(pose @ corners).T for pose in poses[:: max(len(poses) // 20, 1)]]
    everything = np.vstack(points)
    low, high = everything.min(axis=0), everything.max(axis=0)
    border = 0.05 * float(np.linalg.norm(high - low)) * np.array([1.0, 1.0, 0.0])
    return low - border, high + border


def _limits(safety_filter: SafetyFilter | None) -> InputLimits | None:
    if safety_filter is None:
        return None
    inputs = safety_filter.input_set
    low, high = inputs.center - inputs.scale, inputs.center + inputs.scale
    return InputLimits(low.tolist(), high.tolist())
