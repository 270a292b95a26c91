"""Meshcat's scene of a replay, and the recording of its motions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Cylinder, Meshcat, MeshcatParams, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw

from vcbf_drake.checks import Array
from vcbf_drake.plants.shapes import Part
from vcbf_drake.viz.scene_graph import rgba
from vcbf_drake.viz.solids import hull, in_space
from vcbf_drake.viz.stage import Moving, Stage, View
from vcbf_drake.viz.style import ALARM, SHELL, START, TARGET, multiples

GROUND, GROUND_LINES, SKY, HORIZON = "#eceff3", "#c3ccd7", "#dfe8f2", "#f8fafc"
PLAN, DEFAULT = "#8894a3", "#e6e6e6"
HALO = "29"  # The opacity of what is around a place.
# Three rings around a place, each about another axis.
_TURNS = [0.0, 0.0, 0.0], [0.5 * np.pi, 0.0, 0.0], [0.0, 0.5 * np.pi, 0.0]


def private_meshcat() -> Meshcat:
    """A silent Meshcat on any free port, visible on this machine only."""
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)  # Its address would help nobody.
    try:
        return Meshcat(MeshcatParams(host="127.0.0.1", port=0))
    finally:
        logger.setLevel(level)


def record(
    meshcat: Meshcat,
    rate: float,
    bodies: Iterable[Moving],
    appearing: Mapping[str, float] | None = None,
) -> str:
    """Meshcat's own page with its scene and a recording; the page fills in between.

    Args:
        meshcat: The scene.
        rate: The recording's frames a second.
        bodies: The bodies that may move.
        appearing: The paths of what is not there before a time [s].
    """
    meshcat.StartRecording(rate, set_visualizations_while_recording=False)
    for body in bodies:
        if body.moves:
            for time, pose in zip(body.times, body.poses, strict=True):
                meshcat.SetTransform(body.path, pose, float(time))
    for path, time in (appearing or {}).items():
        meshcat.SetProperty(path, "visible", False, 0.0)
        meshcat.SetProperty(path, "visible", True, np.ceil(time * rate - 1e-9) / rate)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return str(meshcat.StaticHtml())


def draw_stage(meshcat: Meshcat, stage: Stage) -> None:
    """Draws a scenario's scene where everything is at the start."""
    draw_room(meshcat, stage.view)
    for body in stage.bodies:
        draw_body(meshcat, body)
    _draw_edges(meshcat, stage)
    _draw_markers(meshcat, stage)
    thickness = stage.view.trail
    for index, run in enumerate(stage.runs):
        apart = run.scenario.separation.distance
        if run.name and apart > 0.0 and not run.ghost:
            # Of two vehicles that are as near as they may be, these touch.
            vehicle = f"vehicle/{index}/"
            body = next(b for b in stage.bodies if b.path.startswith(vehicle))
            path = f"{body.path}/apart"
            _draw_ring(meshcat, path, 0.5 * apart, thickness, run.color)
        if run.failure:
            length = 0.5 * run.vehicle.length / stage.fraction
            radius = 1.5 * (length or 3.0 * stage.view.mark)
            path, place = f"failure/{index}", run.path[run.failure_tick]
            for number, turn in enumerate(_TURNS):
                pose = RigidTransform(RollPitchYaw(turn), place)
                ring = f"{path}/ring/{number}"
                _draw_ring(meshcat, ring, radius, 0.9 * thickness, ALARM, pose)
            _draw_shape(meshcat, f"{path}/halo", Sphere(radius), place, ALARM + HALO)


def draw_room(meshcat: Meshcat, view: View) -> None:
    """A bright room with one sun, and a pale floor with lines at round places."""
    properties: dict[str, dict[str, Any]] = {
        "/Background": {"top_color": _rgb(SKY), "bottom_color": _rgb(HORIZON)},
        "/Grid": {"visible": False},
        "/Axes": {"visible": False},
        "/Lights/PointLightNegativeX": {"visible": False},
        "/Lights/PointLightPositiveX": {"visible": False},
        "/Lights/AmbientLight/<object>": {"intensity": 1.9},
        "/Lights/FillLight/<object>": _sun(view.points),
        "/Cameras/default/rotated/<object>": {"fov": 32.0, "far": 400.0},
    }
    for path, values in properties.items():
        for name, value in values.items():
            meshcat.SetProperty(path, name, value)
    (x0, y0, z), (x1, y1, _) = view.low, view.high
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    meshcat.SetTriangleMesh("ground/floor", corners.T, faces.T, rgba(GROUND))
    above = z + 0.004 * view.cell  # The floor, not in it.
    ends = [([x, y0, above], [x, y1, above]) for x in multiples(x0, x1, view.cell)]
    ends += [([x0, y, above], [x1, y, above]) for y in multiples(y0, y1, view.cell)]
    begin, end = np.array(ends).transpose(1, 2, 0)
    meshcat.SetLineSegments("ground/lines", begin, end, 1.0, rgba(GROUND_LINES))


def draw_body(meshcat: Meshcat, body: Moving) -> None:
    """A body at the first of its poses."""
    for part in body.parts:
        _draw_part(meshcat, f"{body.path}/scaled/{part.name}", part)
    small = np.diag([body.scale, body.scale, body.scale, 1.0])
    meshcat.SetTransform(f"{body.path}/scaled", small)
    meshcat.SetTransform(body.path, body.poses[0])


def tube(
    points: Array, normal: Sequence[float] | Array, radius: float, sides: int = 9
) -> tuple[Array, NDArray[np.int32]]:
    """A round tube along a path in a plane; Drake has no shape for it.

    Args:
        points: The path, which rests nowhere, shape (n, 3) [m].
        normal: The plane's, of length 1, shape (3,).
        radius: The tube's [m].
        sides: The number of sides.

    Returns:
        The vertices, shape (n sides, 3), and the triangles as indices into them,
        counter-clockwise from outside, along the path, shape (2 (n - 1) sides, 3).
    """
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(tangents, normal)[:, None]
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[:, None]
    round_it = np.cos(angle) * np.asarray(normal) + np.sin(angle) * across
    here = np.arange((len(points) - 1) * sides, dtype=np.int32).reshape(-1, sides)
    beside = np.roll(here, -1, axis=1)
    corners = [here, beside, here + sides, beside, beside + sides, here + sides]
    faces = np.stack(corners, axis=-1).reshape(-1, 3)
    return (points[:, None] + radius * round_it).reshape(-1, 3), faces


def _draw_part(meshcat: Meshcat, path: str, part: Part) -> None:
    meshcat.SetObject(path, part.shape, rgba(part.color or DEFAULT))
    meshcat.SetTransform(path, part.pose)


def _draw_shape(
    meshcat: Meshcat, path: str, shape: Shape, place: Array, color: str
) -> None:
    _draw_part(meshcat, path, Part("", shape, color, RigidTransform(place)))


def _draw_ring(
    meshcat: Meshcat,
    path: str,
    radius: float,
    thickness: float,
    color: str,
    pose: RigidTransform | None = None,
) -> None:
    """A ring about the z axis of a frame."""
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    vertices, faces = tube(circle, [0.0, 0.0, 1.0], thickness)
    meshcat.SetTriangleMesh(path, vertices.T, faces.T, rgba(color))
    meshcat.SetTransform(path, pose or RigidTransform())


def _draw_edges(meshcat: Meshcat, stage: Stage) -> None:
    """The boundaries of the distances to obstacles, on the ground."""
    thin, up = 0.0015 * stage.view.span, np.array([0.0, 0.0, 1.0])
    for index, solid in enumerate(stage.solids):
        if stage.run.is_flat and solid.keep_out is not None:
            edge = in_space(hull(solid.surface[:, :2]))
            vertices, faces = tube(np.vstack([edge, edge[:1]]) + thin * up, up, thin)
            path = f"obstacles/{index}/edge"
            meshcat.SetTriangleMesh(path, vertices.T, faces.T, rgba(SHELL))


def _draw_markers(meshcat: Meshcat, stage: Stage) -> None:
    """Every start, every target with the distance that counts as arrival, the ways."""
    size, ground = stage.view.mark, stage.view.low[2]
    radius = max(stage.run.scenario.arrival_distance, 2.0 * size)
    for number, (_, start, target) in enumerate(stage.tasks):
        for name, place, color, reach in (
            ("start", start, START, 2.0 * size),
            ("target", target, TARGET, radius),
        ):
            path = f"{name}/{number}"
            foot = np.array([place[0], place[1], ground])
            _draw_shape(meshcat, f"{path}/centre", Sphere(size), place, color)
            pose = RigidTransform(foot)
            _draw_ring(meshcat, f"{path}/ring", reach, 0.25 * size, color, pose)
            if (height := place[2] - ground) > size:
                pole, middle = Cylinder(0.2 * size, height), 0.5 * (foot + place)
                _draw_shape(meshcat, f"{path}/pole", pole, middle, color)
        path, halo = f"target/{number}/halo", Sphere(radius)
        _draw_shape(meshcat, path, halo, target, TARGET + HALO)
        along = target - start
        if not along.any():
            continue
        sideways = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        sideways /= np.linalg.norm(sideways)
        way = np.linspace(start, target, 91)
        vertices, faces = tube(way, sideways, 0.15 * size, sides=6)
        dashes = faces.reshape(90, -1, 3)[::2].reshape(-1, 3)
        meshcat.SetTriangleMesh(f"plan/{number}", vertices.T, dashes.T, rgba(PLAN))


def _sun(points: Array) -> dict[str, Any]:
    """The light's properties; it shines at the origin and its shadow reaches far."""
    reach = 1.1 * float(np.linalg.norm(points, axis=1).max())
    camera = dict(left=-reach, right=reach, bottom=-reach, top=reach)
    camera |= dict(near=0.1, far=6.0 * reach)
    return {
        "intensity": 1.7,
        "position": [-0.5 * reach, -0.7 * reach, 3.0 * reach],
        **{f"shadow.camera.{name}": value for name, value in camera.items()},
        "shadow.mapSize.x": 4096.0,
        "shadow.mapSize.y": 4096.0,
        "shadow.bias": -0.0005,
        "shadow.normalBias": 0.02,
        "shadow.radius": 3.0,
        "castShadow": True,
    }


def _rgb(color: str) -> list[float]:
    return list(rgba(color).rgba[:3])
