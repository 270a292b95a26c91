"""Obstacles in Drake's SceneGraph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder

from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.plants.mesh import Mesh, Part, cylinder, sphere
from vcbf_drake.viz.posed_geometry import Body, PosedGeometry
from vcbf_drake.viz.style import OBSTACLE

PILLAR_HEIGHT = 0.3  # Of an obstacle in the plane [m].


class ObstacleGeometry(PosedGeometry):
    """Shows spheres, in the plane pillars, where they are at the context's time.

    .. pydrake_system::

        name: ObstacleGeometry
        output_ports:
        - geometry_pose
    """

    def __init__(
        self,
        scene_graph: SceneGraph,
        obstacles: Sequence[SphereObstacle],
        name: str = "obstacle",
        color: str = OBSTACLE,
    ) -> None:
        """Registers the obstacles, margins left out.

        Args:
            scene_graph: Where to.
            obstacles: What to show.
            name: What the frames are called; a number is added.
            color: A hexadecimal colour.
        """
        bodies = [
            Body(f"{name}_{i}", [Part("body", _mesh(obstacle), color)])
            for i, obstacle in enumerate(obstacles)
        ]
        super().__init__(scene_graph, bodies)
        self._obstacles = tuple(obstacles)

    def poses(self, context: Context) -> Sequence[RigidTransform]:
        """Returns every obstacle's pose."""
        time = context.get_time()
        places = np.zeros((len(self._obstacles), 3))
        for place, obstacle in zip(places, self._obstacles, strict=True):
            center = obstacle.center_at(time)
            place[: len(center)] = center
        return [RigidTransform(place) for place in places]

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        obstacles: Sequence[SphereObstacle],
        scene_graph: SceneGraph,
        name: str = "obstacle",
        color: str = OBSTACLE,
    ) -> ObstacleGeometry:
        """Adds the obstacles' geometry and connects it to the SceneGraph.

        Args:
            builder: Holds the SceneGraph.
            obstacles: What to show.
            scene_graph: What to register with.
            name: What the frames are called; a number is added.
            color: A hexadecimal colour.
        """
        geometry = ObstacleGeometry(scene_graph, obstacles, name, color)
        builder.AddNamedSystem(f"{name}_geometry", geometry)
        geometry.ConnectTo(builder, scene_graph)
        return geometry


def _mesh(obstacle: SphereObstacle) -> Mesh:
    if len(obstacle.center) == 2:
        return cylinder(obstacle.radius, PILLAR_HEIGHT)
    return sphere(obstacle.radius)
