"""Vehicles and obstacles in a SceneGraph: poses, roles, a Meshcat page, a camera."""

import base64
import dataclasses
from dataclasses import dataclass
import re

import numpy as np
from pydrake.geometry import (
    Box,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
import pytest

from tests.helpers.synthetic_results import car_result
from vcbf_drake import BoxObstacle, SphereObstacle
from vcbf_drake.barriers import MovingObstacle
from vcbf_drake.plants import BlimpVehicle, CarVehicle
from vcbf_drake.plants.shapes import Part
from vcbf_drake.viz import ObstacleGeometry, VehicleGeometry, write_replay
from vcbf_drake.viz.stage import set_stage

BLIMP = [1.0, 2.0, 3.0, 0.5, 0.0, 0.0, 0.0, 0.0]
CAR = [-1.0, -2.0, 0.7, 2.0]
STONES = [
    SphereObstacle([4.0, 0.0, 1.0], 0.5, velocity=[0.0, 0.2, 0.0]),
    SphereObstacle([1.0, 1.0], 0.4),
]


@pytest.fixture
def scene():
    """A diagram with one of each, its SceneGraph and its Meshcat."""
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    for name, vehicle, state in (
        ("airship", BlimpVehicle(), BLIMP),
        ("buggy", CarVehicle(), CAR),
    ):
        source = builder.AddSystem(ConstantVectorSource(state))
        VehicleGeometry.AddToBuilder(
            builder, vehicle, source.get_output_port(), scene_graph, name
        )
    ObstacleGeometry.AddToBuilder(builder, STONES, scene_graph, "stone")
    meshcat = Meshcat(MeshcatParams(host="127.0.0.1", port=0))
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    return builder.Build(), scene_graph, meshcat


def pose(scene, name, time):
    """Where SceneGraph has a frame."""
    diagram, scene_graph, _ = scene
    context = diagram.CreateDefaultContext()
    context.SetTime(time)
    port = scene_graph.get_query_output_port()
    query = port.Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = query.inspector()
    frames = {inspector.GetName(f): f for f in inspector.GetAllFrameIds()}
    return query.GetPoseInWorld(frames[name])


def test_frames_follow_the_states(scene):
    airship, buggy = pose(scene, "airship", 0.0), pose(scene, "buggy", 0.0)
    assert airship.translation().tolist() == [1.0, 2.0, 3.0]
    assert buggy.translation().tolist() == [-1.0, -2.0, 0.0]
    nose = np.array([1.0, 0.0, 0.0])
    for found, heading in ((airship, 0.5), (buggy, 2.0)):
        ahead = found.rotation() @ nose
        assert ahead == pytest.approx([np.cos(heading), np.sin(heading), 0.0])


def test_obstacles_move_with_time(scene):
    assert pose(scene, "stone_0", 5.0).translation() == pytest.approx([4.0, 1.0, 1.0])
    assert pose(scene, "stone_1", 5.0).translation() == pytest.approx([1.0, 1.0, 0.0])


def test_an_obstacle_goes_along_its_waypoints():
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    box = BoxObstacle([1.0, 0.0], [0.2, 0.3])
    moving = MovingObstacle(box, [0.0, 4.0], [[2.0, 1.0], [3.0, -1.0]])
    ObstacleGeometry.AddToBuilder(builder, [moving], scene_graph, "cart")
    scene = builder.Build(), scene_graph, None
    for time, place in ((-1.0, [2.0, 1.0]), (2.0, [2.5, 0.0]), (9.0, [3.0, -1.0])):
        there = pose(scene, "cart_0", time).translation()
        assert there == pytest.approx([*place, 0.0])


def test_every_piece_is_there_for_visualisers_and_cameras(scene):
    inspector = scene[1].model_inspector()
    frames = inspector.GetAllFrameIds()
    for role in (Role.kIllustration, Role.kPerception):
        pieces = [inspector.NumGeometriesForFrameWithRole(f, role) for f in frames]
        assert sorted(pieces) == [0, 1, 1, 1, 1]  # World, stones, car, blimp.


def test_shapes_are_of_true_size(scene):
    inspector = scene[1].model_inspector()
    size = {
        inspector.GetName(each): 2.0
        * inspector.GetObbInGeometryFrame(each).half_width()
        for each in inspector.GetAllGeometryIds(Role.kIllustration)
    }
    assert size["stone_0/body"] == pytest.approx([1.0] * 3, rel=0.02)
    assert sorted(size["stone_1/body"])[1:] == pytest.approx([0.8] * 2, rel=0.02)
    assert max(size["airship/airship"]) == pytest.approx(0.81, rel=0.1)
    assert max(size["buggy/car"]) == pytest.approx(0.42, rel=0.02)


def test_meshcat_shows_them(scene):
    diagram, _, meshcat = scene
    diagram.ForcedPublish(diagram.CreateDefaultContext())
    page = meshcat.StaticHtml()
    assert len(page) > 2_300_000
    for name in ("airship", "buggy", "stone_0", "stone_1"):
        assert meshcat.HasPath(f"visualizer/{name}")


@dataclass
class Lorry(CarVehicle):
    """A car that pulls a trailer, which is always right behind it."""

    def geometry(self, color):
        trailer = Part("box", Box(0.6, 0.3, 0.2), color, body="trailer")
        return [Part("cab", Box(0.3, 0.3, 0.3), color, body="cab"), trailer]

    def poses(self, state):
        cab = self.pose(state)
        return {"trailer": cab @ RigidTransform([-0.6, 0.0, 0.0]), "cab": cab}


def test_every_body_of_a_vehicle_has_a_pose(tmp_path):
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    state = builder.AddSystem(ConstantVectorSource(CAR)).get_output_port()
    VehicleGeometry.AddToBuilder(builder, Lorry(), state, scene_graph, "lorry")
    lorry = builder.Build(), scene_graph, None
    assert pose(lorry, "lorry/cab", 0.0).translation() == pytest.approx([-1, -2, 0])
    behind = np.array([-1.0, -2.0, 0.0]) - 0.6 * np.array([np.cos(2), np.sin(2), 0])
    assert pose(lorry, "lorry/trailer", 0.0).translation() == pytest.approx(behind)
    result = car_result()
    scenario = dataclasses.replace(result.scenario, vehicle=Lorry())
    result = dataclasses.replace(result, scenario=scenario)
    stage = set_stage([result])
    assert stage.fraction == 1  # Bodies on joints are at their true size.
    x, y, _, heading = result.log["state"][0]
    behind = [x - 0.6 * np.cos(heading), y - 0.6 * np.sin(heading), 0.0]
    trailer = next(b for b in stage.bodies if b.path.endswith("trailer"))
    assert trailer.poses[0].translation() == pytest.approx(behind)
    page = write_replay([result], tmp_path / "page.html").read_text()
    commands = b"".join(map(base64.b64decode, re.findall(r'base64,([^"]+)"', page)))
    for body in (b"vehicle/0/cab", b"vehicle/0/trailer"):
        assert body in commands
