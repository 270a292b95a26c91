"""The Meshcat replay: one self-contained page for one or several methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.replay.page_data import stage_data, stage_words
from vcbf_drake.viz.replay.pages import private_meshcat, write_page
from vcbf_drake.viz.replay.tubes import merge, ring, tube
from vcbf_drake.viz.stage import Motion, Stage, set_stage
from vcbf_drake.viz.style import ALARM

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from vcbf_drake.simulation.result import Result

MAX_TRAIL_POINTS = 1000


def write_replay(results: Sequence[Result], path: Path) -> Path:
    """Writes an HTML page that replays results side by side, with nothing to install.

    Args:
        results: Results of one scenario under one or several methods; the last one is
            drawn solid, the others as translucent ghosts.
        path: The page to write; its directory is made.

    Returns:
        The path.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    stage = set_stage(results)
    page = _meshcat_page(stage)
    return write_page(page, stage_words(stage), stage_data(stage), path)


def _meshcat_page(stage: Stage) -> str:
    """Meshcat's own page with the scene and its recording."""
    meshcat = private_meshcat()
    draw_scene(meshcat, stage)
    rate = stage.frames_per_second
    meshcat.StartRecording(rate, set_visualizations_while_recording=False)
    _record(meshcat, stage)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return str(meshcat.StaticHtml())


def draw_scene(meshcat: Meshcat, stage: Stage) -> None:
    """Draws everything where it is at the start."""
    from vcbf_drake.viz.replay import scene

    scene.add_light(meshcat, stage.outline)
    scene.add_ground(meshcat, stage.low, stage.high, stage.cell)
    scene.add_obstacles(meshcat, stage)
    scene.add_walls(meshcat, stage)
    scene.add_markers(meshcat, stage)
    for index in range(len(stage.runs)):
        _draw_run(meshcat, stage, index)


def _draw_run(meshcat: Meshcat, stage: Stage, index: int) -> None:
    """Draws a run's vehicle, its trail, and where it failed."""
    from pydrake.geometry import Sphere

    from vcbf_drake.viz.replay.scene import add_mesh, add_part, add_shape

    run, motion = stage.runs[index], stage.motions[index]
    ghost = run is not stage.runs[-1]
    small = np.diag([*[1.0 / stage.fraction] * 3, 1.0])
    for part in run.vehicle.geometry(run.color):
        body = f"{body_path(index, part.body, motion)}/body"
        add_part(meshcat, f"{body}/{part.name}", part)
        meshcat.SetTransform(body, small)
    thickness = 0.0022 * stage.span
    trail = tube(_thinned(motion.position, stage), thickness * (0.7 if ghost else 1.0))
    add_mesh(meshcat, f"trail/{index}", trail, run.color)
    if run.failure:
        place, radius = motion.position_at(run.failure.time), 1.5 * stage.reach
        rings = merge([ring(radius, 0.9 * thickness).moved(turn=t) for t in _TURNS])
        add_mesh(meshcat, f"failure/{index}/rings", rings.moved(place), ALARM)
        add_shape(meshcat, f"failure/{index}/halo", Sphere(radius), place, ALARM, 0.16)


def body_path(index: int, body: str, motion: Motion) -> str:
    """Where a body of a run's vehicle is in Meshcat's tree."""
    is_one = len(motion.poses[0]) == 1
    return f"vehicle/{index}" if is_one else f"vehicle/{index}/{body or 'point'}"


def _thinned(points: Array, stage: Stage) -> Array:
    """Every so many points, so that all trails together stay small."""
    count = max(min(len(points), MAX_TRAIL_POINTS // len(stage.runs)), 2)
    kept: Array = points[np.linspace(0, len(points) - 1, count).round().astype(int)]
    return kept


def _record(meshcat: Meshcat, stage: Stage) -> None:
    """Records how the vehicles and the obstacles move and when the markers appear."""
    from pydrake.math import RigidTransform

    for index, (run, motion) in enumerate(zip(stage.runs, stage.motions, strict=True)):
        for time, poses in zip(motion.time, motion.poses, strict=True):
            for body, pose in poses.items():
                meshcat.SetTransform(body_path(index, body, motion), pose, time)
        if run.failure:
            path = f"failure/{index}"
            meshcat.SetProperty(path, "visible", False, 0.0)
            frame = np.ceil(run.failure.time * stage.frames_per_second - 1e-9)
            appears = float(frame / stage.frames_per_second)
            meshcat.SetProperty(path, "visible", True, appears)
    for index, solid in enumerate(stage.solids):
        # The page fills in between two poses.
        for time in solid.key_times(stage.duration) if solid.moves else ():
            pose = RigidTransform(solid.offset_at(time))
            meshcat.SetTransform(f"obstacles/{index}", pose, float(time))


_TURNS = (
    np.eye(3),
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
)
