"""The still parts of the replay: light, ground, obstacles, start and target."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, Shape, Sphere
from pydrake.math import RigidTransform

from vcbf_drake.checks import Array
from vcbf_drake.plants.shapes import Part
from vcbf_drake.viz.replay.tubes import Mesh, merge, ring, tube
from vcbf_drake.viz.scene_graph import rgba
from vcbf_drake.viz.solids import Piece, hull, in_space, walls_of
from vcbf_drake.viz.stage import Stage, multiples
from vcbf_drake.viz.style import OBSTACLE, START, TARGET

GROUND, GROUND_LINES, SKY, HORIZON = "#eceff3", "#c3ccd7", "#dfe8f2", "#f8fafc"
SHELL, PLAN, DEFAULT = "#5f7fa8", "#8894a3", "#e6e6e6"
UPRIGHT = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def add_mesh(
    meshcat: Meshcat, path: str, mesh: Mesh, color: str, alpha: float = 1.0
) -> None:
    """Puts a mesh into the scene."""
    meshcat.SetTriangleMesh(path, mesh.vertices.T, mesh.faces.T, rgba(color, alpha))


def add_shape(
    meshcat: Meshcat,
    path: str,
    shape: Shape,
    place: Array,
    color: str,
    alpha: float = 1.0,
) -> None:
    """Puts one of Drake's shapes into the scene, upright, its middle at a place."""
    meshcat.SetObject(path, shape, rgba(color, alpha))
    meshcat.SetTransform(path, RigidTransform(place))


def add_part(meshcat: Meshcat, path: str, part: Part) -> None:
    """Puts a part of a vehicle into the scene."""
    meshcat.SetObject(path, part.shape, rgba(part.color or DEFAULT))
    meshcat.SetTransform(path, part.pose)


def add_trail(
    meshcat: Meshcat, path: str, places: Array, thickness: float, color: str
) -> None:
    """The way along places (n, 3); the page lets it grow."""
    add_mesh(meshcat, path, tube(places, thickness), color)


def add_light(meshcat: Meshcat, points: Array) -> None:
    """A bright room with one sun; the shadows of all points (k, 3) are in it."""
    properties: dict[str, dict[str, Any]] = {
        "/Background": {"top_color": _rgb(SKY), "bottom_color": _rgb(HORIZON)},
        "/Grid": {"visible": False},
        "/Axes": {"visible": False},
        "/Lights/PointLightNegativeX": {"visible": False},
        "/Lights/PointLightPositiveX": {"visible": False},
        "/Lights/AmbientLight/<object>": {"intensity": 1.9},
        "/Lights/FillLight/<object>": _sun(points),
        "/Cameras/default/rotated/<object>": {"fov": 32.0, "far": 400.0},
    }
    for path, values in properties.items():
        for name, value in values.items():
            meshcat.SetProperty(path, name, value)


def add_ground(meshcat: Meshcat, low: Array, high: Array, cell: float) -> None:
    """A pale floor between two corners with lines at multiples of a length."""
    corners = [low, [high[0], low[1], low[2]], [*high[:2], low[2]]]
    corners.append([low[0], high[1], low[2]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    add_mesh(meshcat, "ground/floor", Mesh(np.array(corners), faces), GROUND)
    lines = [
        ([x, low[1], low[2]], [x, high[1], low[2]])
        for x in multiples(low[0], high[0], cell)
    ] + [
        ([low[0], y, low[2]], [high[0], y, low[2]])
        for y in multiples(low[1], high[1], cell)
    ]
    ends = np.array(lines)
    ends[..., 2] += 0.004 * cell  # Above the floor, not in it.
    meshcat.SetLineSegments(
        "ground/lines", ends[:, 0].T, ends[:, 1].T, 1.0, rgba(GROUND_LINES)
    )


def add_obstacles(meshcat: Meshcat, stage: Stage) -> None:
    """The obstacles, and around each the distance that has to be kept."""
    thin, up = 0.0015 * stage.span, np.array([0.0, 0.0, 1.0])
    for index, solid in enumerate(stage.solids):
        path = f"obstacles/{index}"
        _add_piece(meshcat, f"{path}/body", solid.body, OBSTACLE)
        if solid.keep_out is None:
            continue
        _add_piece(meshcat, f"{path}/keep_out", solid.keep_out, SHELL, 0.2)
        if stage.run.is_flat:
            edge = in_space(hull(solid.keep_out.surface[:, :2]))
            loop = np.vstack([edge, edge[:1]]) + thin * up
            add_mesh(meshcat, f"{path}/edge", tube(loop, thin, 9), SHELL)


def add_walls(meshcat: Meshcat, stage: Stage) -> None:
    """The walls, and before each the distance that has to be kept."""
    middle, size = 0.5 * (stage.low + stage.high), 1.2 * stage.span
    for index, wall in enumerate(walls_of(stage.run.scenario)):
        for name, thick, alpha in (
            ("body", -0.004 * size, 0.3),  # More would throw a shadow.
            ("keep_out", wall.margin, 0.15),
        ):
            if thick != 0.0:
                path, high = f"walls/{index}/{name}", 0.06 * stage.span
                slab, pose = wall.slab(middle, size, high, thick)
                meshcat.SetObject(path, slab, rgba(SHELL, alpha))
                meshcat.SetTransform(path, pose)


def add_markers(meshcat: Meshcat, stage: Stage) -> None:
    """The start, the target with the distance that counts as arrival, and the way."""
    size, ground = stage.mark, stage.low[2]
    tolerance = stage.run.scenario.arrival_distance
    radius = max(tolerance, 2.0 * size)
    for name, place, color, reach in (
        ("start", stage.start, START, 2.0 * size),
        ("target", stage.target, TARGET, radius),
    ):
        circle = ring(reach, 0.25 * size).moved(turn=UPRIGHT)
        foot = np.array([place[0], place[1], ground])
        add_shape(meshcat, f"{name}/centre", Sphere(size), place, color)
        add_mesh(meshcat, f"{name}/ring", circle.moved(foot), color)
        if (height := place[2] - ground) > size:
            pole = Cylinder(0.2 * size, height)
            add_shape(meshcat, f"{name}/pole", pole, 0.5 * (foot + place), color)
    add_shape(meshcat, "target/halo", Sphere(radius), stage.target, TARGET, 0.16)
    way = _dashes(stage.start, stage.target, 0.15 * size)
    add_mesh(meshcat, "plan", way, PLAN)


def _add_piece(
    meshcat: Meshcat, path: str, piece: Piece, color: str, alpha: float = 1.0
) -> None:
    meshcat.SetObject(path, piece.shape, rgba(color, alpha))
    meshcat.SetTransform(path, piece.pose)


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
