"""What is drawn into Meshcat's scene, and the recording of what moves there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import logging
from typing import Any, TypeAlias

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, MeshcatParams, Shape, Sphere
from pydrake.math import RigidTransform

from vcbf_drake.checks import Array
from vcbf_drake.viz.replay.tubes import Mesh, merge, ring, tube
from vcbf_drake.viz.scene_graph import rgba
from vcbf_drake.viz.solids import Piece, hull, in_space, walls_of
from vcbf_drake.viz.stage import Moving, Stage, View
from vcbf_drake.viz.style import ALARM, OBSTACLE, START, TARGET, multiples

GROUND, GROUND_LINES, SKY, HORIZON = "#eceff3", "#c3ccd7", "#dfe8f2", "#f8fafc"
SHELL, PLAN, DEFAULT = "#5f7fa8", "#8894a3", "#e6e6e6"
UPRIGHT = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
THICKNESS = 0.0022  # Of a trail, as a share of the span.
MAX_TRAIL_POINTS = 1000

# A path in Meshcat's tree, and where it is at which times [s].
Track: TypeAlias = tuple[str, Iterable[float], Iterable[RigidTransform]]


def private_meshcat() -> Meshcat:
    """A Meshcat that no other machine can see, on any free port, without a word."""
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
    tracks: Iterable[Track],
    appearing: Mapping[str, float] | None = None,
) -> str:
    """Meshcat's own page with its scene and a recording; the page fills in between.

    Args:
        meshcat: The scene.
        rate: The recording's frames a second.
        tracks: What moves.
        appearing: The paths of what is not there before a time [s].
    """
    meshcat.StartRecording(rate, set_visualizations_while_recording=False)
    for path, times, poses in tracks:
        for time, pose in zip(times, poses, strict=True):
            meshcat.SetTransform(path, pose, float(time))
    for path, time in (appearing or {}).items():
        meshcat.SetProperty(path, "visible", False, 0.0)
        meshcat.SetProperty(path, "visible", True, np.ceil(time * rate - 1e-9) / rate)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return str(meshcat.StaticHtml())


def draw_stage(meshcat: Meshcat, stage: Stage) -> None:
    """Draws a scenario's scene where everything is at the start."""
    draw_room(meshcat, stage.view)
    _draw_obstacles(meshcat, stage)
    _draw_walls(meshcat, stage)
    _draw_markers(meshcat, stage)
    most = max(MAX_TRAIL_POINTS // len(stage.runs), 2)
    thickness = THICKNESS * stage.view.span
    for index, (run, motion) in enumerate(zip(stage.runs, stage.motions, strict=True)):
        for body in motion.bodies:
            draw_body(meshcat, body, 1.0 / stage.fraction)
        apart = run.scenario.separation.distance
        if run.name and apart > 0.0 and not run.ghost:
            # Of two vehicles that are as near as they may be, these touch.
            around = ring(0.5 * apart, thickness).moved(turn=UPRIGHT)
            draw_mesh(meshcat, f"{motion.bodies[0].path}/apart", around, run.color)
        count = min(len(motion.position), most)
        kept = np.linspace(0, len(motion.position) - 1, count).round().astype(int)
        way = tube(motion.position[kept], thickness * (0.7 if run.ghost else 1.0))
        draw_mesh(meshcat, f"trail/{index}", way, run.color)
        if run.failure:
            length = 0.5 * run.vehicle.length / stage.fraction
            radius = 1.5 * (length or 3.0 * stage.view.mark)
            place, path = motion.position_at(run.failure.time), f"failure/{index}"
            rings = merge([ring(radius, 0.9 * thickness).moved(turn=t) for t in _TURNS])
            draw_mesh(meshcat, f"{path}/rings", rings.moved(place), ALARM)
            halo = Sphere(radius)
            _draw_shape(meshcat, f"{path}/halo", halo, place, ALARM, 0.16)


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
    draw_mesh(meshcat, "ground/floor", Mesh(corners, faces), GROUND)
    above = z + 0.004 * view.cell  # The floor, not in it.
    ends = [([x, y0, above], [x, y1, above]) for x in multiples(x0, x1, view.cell)]
    ends += [([x0, y, above], [x1, y, above]) for y in multiples(y0, y1, view.cell)]
    begin, end = np.array(ends).transpose(1, 2, 0)
    meshcat.SetLineSegments("ground/lines", begin, end, 1.0, rgba(GROUND_LINES))


def draw_body(meshcat: Meshcat, body: Moving, scale: float = 1.0) -> None:
    """A body at the first of its poses, its parts at a scale."""
    for part in body.parts:
        path = f"{body.path}/scaled/{part.name}"
        meshcat.SetObject(path, part.shape, rgba(part.color or DEFAULT))
        meshcat.SetTransform(path, part.pose)
    small = np.diag([scale, scale, scale, 1.0])
    meshcat.SetTransform(f"{body.path}/scaled", small)
    meshcat.SetTransform(body.path, body.poses[0])


def draw_mesh(meshcat: Meshcat, path: str, mesh: Mesh, color: str) -> None:
    """A mesh; of one below ``trail`` the page lets the triangles grow with time."""
    meshcat.SetTriangleMesh(path, mesh.vertices.T, mesh.faces.T, rgba(color))


def _draw_shape(
    meshcat: Meshcat,
    path: str,
    shape: Shape,
    place: Array,
    color: str,
    alpha: float = 1.0,
) -> None:
    meshcat.SetObject(path, shape, rgba(color, alpha))
    meshcat.SetTransform(path, RigidTransform(place))


def _draw_obstacles(meshcat: Meshcat, stage: Stage) -> None:
    """The obstacles, and around each the distance that has to be kept."""
    thin, up = 0.0015 * stage.view.span, np.array([0.0, 0.0, 1.0])
    for index, solid in enumerate(stage.solids):
        path = f"obstacles/{index}"
        _draw_piece(meshcat, f"{path}/body", solid.body, OBSTACLE)
        if solid.keep_out is None:
            continue
        _draw_piece(meshcat, f"{path}/keep_out", solid.keep_out, SHELL, 0.2)
        if stage.run.is_flat:
            edge = in_space(hull(solid.keep_out.surface[:, :2]))
            loop = np.vstack([edge, edge[:1]]) + thin * up
            draw_mesh(meshcat, f"{path}/edge", tube(loop, thin, 9), SHELL)


def _draw_piece(
    meshcat: Meshcat, path: str, piece: Piece, color: str, alpha: float = 1.0
) -> None:
    meshcat.SetObject(path, piece.shape, rgba(color, alpha))
    meshcat.SetTransform(path, piece.pose)


def _draw_walls(meshcat: Meshcat, stage: Stage) -> None:
    """The walls, and before each the distance that has to be kept."""
    view = stage.view
    middle, size = 0.5 * (view.low + view.high), 1.2 * view.span
    for index, wall in enumerate(walls_of(stage.run.scenario)):
        for name, thick, alpha in (
            ("body", -0.004 * size, 0.3),  # More would throw a shadow.
            ("keep_out", wall.margin, 0.15),
        ):
            if thick != 0.0:
                path, high = f"walls/{index}/{name}", 0.06 * view.span
                slab, pose = wall.slab(middle, size, high, thick)
                meshcat.SetObject(path, slab, rgba(SHELL, alpha))
                meshcat.SetTransform(path, pose)


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
            circle = ring(reach, 0.25 * size).moved(turn=UPRIGHT)
            foot = np.array([place[0], place[1], ground])
            _draw_shape(meshcat, f"{path}/centre", Sphere(size), place, color)
            draw_mesh(meshcat, f"{path}/ring", circle.moved(foot), color)
            if (height := place[2] - ground) > size:
                pole, middle = Cylinder(0.2 * size, height), 0.5 * (foot + place)
                _draw_shape(meshcat, f"{path}/pole", pole, middle, color)
        halo = Sphere(radius)
        _draw_shape(meshcat, f"target/{number}/halo", halo, target, TARGET, 0.16)
        way = _dashes(start, target, 0.15 * size)
        draw_mesh(meshcat, f"plan/{number}", way, PLAN)


def _dashes(start: Array, end: Array, radius: float) -> Mesh:
    marks = np.linspace(0.0, 1.0, 91)[:, None] * (end - start) + start
    pairs = zip(marks[0:-1:2], marks[1::2], strict=True)
    return merge([tube(np.array(pair), radius, sides=6) for pair in pairs])


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
    return [int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]


_TURNS = (
    np.eye(3),
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
)
