"""Obstacles from files, on paths, and for several points of the robot's body."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from vcbf_drake import BarrierSet, ControlAffineModel, ScenarioError, load_scenario
from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.simulation import barriers, dump_scenario, simulate
from vcbf_drake.simulation.loading import parse_scenario

CAR = """yard:
  vehicle: !Car {{}}
  input_set: {{lower: [-1, -0.8], upper: [1, 0.8]}}
  obstacles: [{obstacles}]
  barrier: {{gains: [4.0, 3.0]}}
  initial_state: [0, 0, 0, 0]
  target: [6.0, 0.0]
  method: cbf-qp
"""
SQUARE = [[4, 2], [5, 2], [5, 3], [4, 3], [4, 2]]


def write(tmp_path, obstacles, **files):
    for name, content in files.items():
        path = tmp_path / name.replace("_", ".")
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    scenario = tmp_path / "yard.yaml"
    scenario.write_text(CAR.format(obstacles=obstacles))
    return scenario


def heights(scenario, *places, time=0.0):
    """The least h of a scenario's barriers with the car at each place."""
    model = ControlAffineModel.from_system(scenario.vehicle.make_plant())
    rows = BarrierSet(model, barriers(scenario))
    states = [np.array([*place, 0.0, 0.0]) for place in places]
    return [rows.values(state, time).min() for state in states]


def test_spheres_come_from_a_table_beside_the_scenario(tmp_path, monkeypatch):
    table = "x, y, radius, velocity_x, velocity_y\n3, 0.1, 0.5, 0, 0\n\n5,2,.3,0,-0.1\n"
    path = write(tmp_path, "!Spheres {file: discs.csv, margin: 0.2}", discs_csv=table)
    monkeypatch.chdir(Path.cwd().root)
    scenario = load_scenario(path)
    assert scenario.obstacles == [
        SphereObstacle([3.0, 0.1], 0.5, [], 0.2),
        SphereObstacle([5.0, 2.0], 0.3, [0.0, -0.1], 0.2),
    ]
    assert scenario.spheres == scenario.obstacles
    (tmp_path / "discs.csv").unlink()  # What is written down needs it no more.
    assert parse_scenario(dump_scenario(scenario), "again") == scenario


def test_a_map_in_geojson_is_kept_or_covered_and_that_is_said(tmp_path, caplog):
    hole = [[4.2, 2.2], [4.8, 2.2], [4.5, 2.8], [4.2, 2.2]]
    bow = [[8, 3], [9, 3], [8, 4], [9, 4], [8, 3]]
    ell = [[1, 1], [2, 1], [2, 3], [1.8, 3], [1.8, 1.2], [1, 1.2], [1, 1]]
    collection = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "geometry": {"type": "Polygon", "coordinates": [SQUARE, hole]},
            },
            {
                "type": "Feature",
                "geometry": {"type": "MultiPolygon", "coordinates": [[bow], [ell]]},
            },
        ],
    }
    path = write(
        tmp_path, "!PolygonMap {file: map.json, margin: 0.1}", map_json=collection
    )
    with caplog.at_level(logging.WARNING, logger="vcbf_drake"):
        scenario = load_scenario(path)
    filled, around = [each.getMessage() for each in caplog.records]
    assert "features[0].geometry.coordinates has a hole" in filled
    assert "features[1].geometry.coordinates[0] is taken as its convex hull" in around
    inside = heights(scenario, [4.5, 2.4], [8.1, 3.5], [1.9, 2.0], [1.5, 1.1])
    assert max(inside) < 0.0
    # 0.5 beside the square and within the L: never more than the distance, 0.1 less.
    for place, distance in (([5.5, 2.5], 0.5), ([1.5, 1.5], 0.3)):
        (h,) = heights(scenario, place)
        assert distance - 0.1 - 0.1 <= h <= distance - 0.1


def test_a_map_in_a_table_has_a_line_a_corner(tmp_path):
    corners = "".join(f"7,{x},{y}\n" for x, y in SQUARE)
    path = write(tmp_path, "!PolygonMap {file: m.csv}", m_csv="polygon,x,y\n" + corners)
    (polygon,) = load_scenario(path).obstacles
    assert polygon.vertices == SQUARE[:-1]


@pytest.mark.parametrize(
    ("entry", "content", "words"),
    [
        ("!Spheres {file: f.csv}", None, "No such file"),
        ("!Spheres {file: f.csv}", "", "line 1: nothing; it must name x, y, radius"),
        ("!Spheres {file: f.csv}", "x,y,r\n1,2,3", "line 1: x, y, r; it must name"),
        (
            "!Spheres {file: f.csv}",
            "x,y,radius\n1,2",
            "line 2: radius: ''; it must be a finite",
        ),
        ("!Spheres {file: f.csv}", "x,y,radius\n1,2,3,4", "line 2: no column: .*'4'"),
        ("!Spheres {file: f.csv}", "x,y,radius\n1,b,2", "line 2: y: 'b'; it must be a"),
        ("!Spheres {file: f.csv}", "x,y,radius\n1,nan,2", "line 2: y: 'nan'"),
        ("!Spheres {file: f.csv}", "x,y,radius\n9,9,1\n1,2,-3", "line 3: radius: -3"),
        ("!Spheres {file: f.csv}", "x,y,z,radius\n1,2,3,1", "a list of 2 numbers"),
        ("!Spheres {file: f.csv}", "x,y,radius\n6,0,1", "target: .* outside obstacles"),
        ("!Spheres {file: f.csv, margin: -1}", "x,y,radius", "margin: -1"),
        ("!PolygonMap {file: f.json}", "[", "not JSON"),
        ("!PolygonMap {file: f.json}", "{}", "the file is of type None"),
        ("!PolygonMap {file: f.json}", '{"type": "Point"}', "is of type 'Point'"),
        (
            "!PolygonMap {file: f.json}",
            '{"type": "Feature", "geometry": null}',
            "geometry is of type None",
        ),
        (
            "!PolygonMap {file: f.json}",
            '{"type": "Polygon", "coordinates": [[[1, 2], [3, 4]]]}',
            "rings of 3 corners",
        ),
        (
            "!PolygonMap {file: f.json}",
            '{"type": "Polygon", "coordinates": [[[1, 2], [3, 4], [5, 6]]]}',
            "polygon: ",
        ),
        (
            "!PolygonMap {file: f.json}",
            '{"type": "Polygon", "coordinates": [[[1, 2], [3, "a"], [5, 6]]]}',
            "rings of 3 corners",
        ),
        (
            "!PolygonMap {file: f.json}",
            '{"type": "GeometryCollection", "geometries": 3}',
            "its geometries must be a list",
        ),
        (
            "!PolygonMap {file: f.json}",
            '{"type": "FeatureCollection", "features": []}',
            "no polygon",
        ),
        ("!PolygonMap {file: f.csv}", "polygon,x,y\n1,0,0\n1,1,0", "polygon 1: "),
        ("!Spheres {file: f.csv}", "x,y,radius\n", "no sphere"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, entry, content, words):
    name = "f_csv" if "f.csv" in entry else "f_json"
    path = write(tmp_path, entry, **({} if content is None else {name: content}))
    with pytest.raises(ScenarioError, match=words) as error:
        load_scenario(path)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{path}:4: ") or "target" in words


MOVING = (
    "!Moving {shape: !Box {center: [0, 0], half_widths: [0.2, 0.3]},"
    " times: [0, 5, 10], waypoints: [[4, -2], [4, -1], [5, -1.5]]}"
)


def test_a_shape_goes_from_waypoint_to_waypoint(tmp_path):
    scenario = load_scenario(write(tmp_path, MOVING))
    (moving,) = scenario.obstacles
    for time, place in ((-1, [4, -2]), (0, [4, -2]), (5, [4, -1]), (12, [5, -1.5])):
        np.testing.assert_allclose(moving.offset_at(time), place, atol=1e-12)
    assert heights(scenario, [4.0, -1.0], time=5.0)[0] < 0.0
    (h,) = heights(scenario, [4.7, -1.0], time=5.0)  # 0.5 beside it.
    assert 0.45 <= h <= 0.5
    result = simulate(scenario)
    assert result.summary["outcome"] == "reached"
    assert parse_scenario(dump_scenario(scenario), "again") == scenario


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("times: [0, 5]", "waypoints: .* 2 rows, one a time, of 2 finite numbers each"),
        ("times: [0, 5, 5]", "times: .* two at least, increasing"),
        ("times: [0]", "times: .* two at least, increasing"),
        ("waypoints: [[4, -2, 0], [4, -1, 0], [5, 1, 0]]", "3 rows.* of 2 finite"),
        ("shape: {center: [0, 0], radius: 1, velocity: [1, 0]}", "waypoints move it"),
    ],
)
def test_wrong_waypoints_are_one_line(tmp_path, wrong, words):
    keys = {
        "shape": "shape: {center: [0, 0], radius: 0.3}",
        "times": "times: [0, 5, 10]",
        "waypoints": "waypoints: [[4, -2], [4, -1], [5, -1.5]]",
    }
    keys[wrong.split(":")[0]] = wrong
    path = write(tmp_path, f"!Moving {{{', '.join(keys.values())}}}")
    with pytest.raises(ScenarioError, match=rf"obstacles\[0\].*{words}"):
        load_scenario(path)


def test_every_point_of_the_body_keeps_clear():
    """A blimp's nose: 0.4 m ahead of its position, turned by its heading."""
    course = {"obstacles": [{"center": [2.0, 0.0, 0.0], "radius": 0.5}]}
    nose = {"point": [0.4, 0.0, 0.0], "radius": 0.1}
    scenario = load_scenario(
        "blimp-single-obstacle", course | {"body": [{"radius": 0.2}, nose]}
    )
    model = ControlAffineModel.from_system(scenario.vehicle.make_plant())
    rows = BarrierSet(model, barriers(scenario))
    assert rows.names == ("obstacle 1 (point 1)", "obstacle 1 (point 2)")
    state = np.zeros(8)
    np.testing.assert_allclose(rows.values(state, 0.0), [1.3, 1.0])
    state[3] = np.pi / 2.0
    beside = np.hypot(2.0, 0.4) - 0.6
    np.testing.assert_allclose(rows.values(state, 0.0), [1.3, beside])


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ({"point": [0.1]}, r"body\[0\]\.point: \[0\.1\]; it must be 2 numbers"),
        ({"frame": "hand"}, "empty, for !Car is one body"),
        ({"radius": -1.0}, "radius: -1"),
        ({"radius": 10.0}, "initial_state: .* outside obstacles"),
    ],
)
def test_a_wrong_point_of_the_body_is_one_line(point, words):
    with pytest.raises(ScenarioError, match=words):
        load_scenario("car-avoidance", {"body": [point]})


def test_every_link_of_an_arm_keeps_clear():
    """Each point by Drake's own kinematics, less the balls around obstacle and link."""
    examples = Path(__file__).parents[2] / "examples"
    points = [
        {"frame": "hand"},
        {"frame": "link_4", "point": [0, 0, 0.1], "radius": 0.06},
    ]
    scenario = load_scenario(examples / "arm.yaml", {"body": points})
    plant = scenario.vehicle.make_plant()
    model = ControlAffineModel.from_system(plant)
    found = [each for each in barriers(scenario) if each.name.startswith("obstacle")]
    state = np.array(scenario.initial_state)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, state[:7])
    ball = scenario.obstacles[0]
    distances = []
    for frame, point, radius in (
        ("hand", [0, 0, 0], 0.0),
        ("link_4", [0, 0, 0.1], 0.06),
    ):
        place = plant.GetFrameByName(frame).CalcPoseInWorld(context) @ np.array(point)
        away = np.linalg.norm(place - ball.center)
        distances.append(away - ball.radius - radius)
    values = BarrierSet(model, found).values(state, 0.0)
    np.testing.assert_allclose(values, distances, atol=1e-12)
    with pytest.raises(ScenarioError, match=r"body\[0\].*no frame 'foot'"):
        load_scenario(examples / "arm.yaml", {"body": [{"frame": "foot"}]})


def test_the_yard_of_the_gallery_is_driven_through():
    yard = Path(__file__).parents[2] / "examples" / "yard" / "yard.yaml"
    result = simulate(load_scenario(yard))
    assert result.summary["outcome"] == "reached" and result.summary["guaranteed"]
    assert result.summary["min_barrier"] > 0.0
