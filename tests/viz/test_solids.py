"""Obstacles as pictures show them: sizes, margins, walls."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from pydrake.symbolic import Expression
import pytest
from scipy.spatial import ConvexHull

from tests.helpers.obstacle_kinds import EVERY_KIND
from vcbf_drake import load_scenario
from vcbf_drake.barriers import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    MovingObstacle,
    PolygonObstacle,
    SphereObstacle,
)
from vcbf_drake.plants.shapes import bounding_box, surface
from vcbf_drake.simulation import simulate
from vcbf_drake.viz import write_figures, write_replay
from vcbf_drake.viz.scene_graph import rgba
from vcbf_drake.viz.solids import Wall, hull, solids, solids_of, walls_of
from vcbf_drake.viz.stage import set_stage


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("car-avoidance", EVERY_KIND)


def area(corners):
    x, y = corners.T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def test_outlines_have_the_true_size(scenario):
    found = [hull(surface(each.body)[:, :2]) for each in solids_of(scenario, 0.2)]
    length, disc = np.hypot(4.0, 0.5), np.pi * 0.4**2
    true = [np.pi * 0.5 * 0.3, 2 * 0.2 * length + np.pi * 0.2**2, 4 * 0.4 * 0.2]
    np.testing.assert_allclose(list(map(area, found)), [disc, disc, *true], rtol=0.01)
    # The box is turned by a right angle.
    low, high = found[-1].min(axis=0), found[-1].max(axis=0)
    np.testing.assert_allclose(high - low, [0.4, 0.8])
    np.testing.assert_allclose((high + low) / 2.0, [2.5, -2.0])


MARGIN = 0.3


@pytest.mark.parametrize(
    "obstacle",
    [
        SphereObstacle([1.0, -2.0], 0.4, margin=MARGIN),
        SphereObstacle([1.0, -2.0, 0.5], 0.4, margin=MARGIN),
        EllipsoidObstacle([1.0, -2.0], [0.5, 0.3], margin=MARGIN),
        EllipsoidObstacle([1.0, 0.0, 2.0], [0.5, 0.3, 0.9], margin=MARGIN),
        CapsuleObstacle([0.0, 2.0], [4.0, 2.5], 0.2, margin=MARGIN),
        CapsuleObstacle([0.0, 2.0, 1.0], [4.0, 2.5, 0.0], 0.2, margin=MARGIN),
        BoxObstacle([2.5, -2.0], [0.4, 0.2], [[0, -1], [1, 0]], margin=MARGIN),
        BoxObstacle([2.5, -2.0, 1.0], [0.4, 0.2, 0.7], margin=MARGIN),
        PolygonObstacle([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], MARGIN),
    ],
    ids=lambda each: f"{type(each).__name__} of {each.formula()[0]}",
)
def test_the_margin_is_drawn_where_the_barrier_ends(obstacle):
    """What is drawn reaches as far as h = 0 does, but for its smoothed edges."""
    size, h, parameters = obstacle.formula()

    def height(point):
        return h(np.array(point, float), Expression(0.0), np.array(parameters))

    def value(point):
        found = height(point)
        return found.Evaluate() if isinstance(found, Expression) else float(found)

    drawn = list(solids(obstacle, 0.2))
    corners = [each.surface[:, :size] for each in drawn]
    corners = np.vstack([each[ConvexHull(each).vertices] for each in corners])
    heights = np.array([value(point) for point in corners])
    assert heights.max() < 1e-6
    if isinstance(obstacle, PolygonObstacle):
        # Sharp corners are drawn rounded; some of the corners are inside the union.
        assert heights.max() > -0.13
    else:
        rounding = 2.0 * getattr(obstacle, "smoothing", 0.0)
        assert heights.min() > -rounding - 1e-6
    bare = np.vstack([surface(each.body) for each in drawn])[:, :size]
    assert max(map(value, bare)) < -MARGIN + 1e-6


def test_moving_solids_move(scenario):
    capsule = solids_of(scenario, height=0.2)[3]
    assert capsule.moves
    np.testing.assert_allclose(capsule.offset_at(5.0), [0.0, 0.05, 0.0])


def test_walls_are_where_the_half_spaces_end(scenario):
    walls = walls_of(scenario)
    normals = [each.normal.tolist() for each in walls]
    assert normals == [[0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, -1, 0]]
    assert [each.offset for each in walls] == [-3.0, -1.0, -20.0, -4.0]
    assert [each.margin for each in walls] == [0.0, 0.1, 0.1, 0.1]
    for wall in walls:
        for thick in (-0.05, 0.1):
            slab, pose = wall.slab(np.zeros(3), 10.0, 0.5, thick)
            assert slab.width() == abs(thick)
            face = pose.translation() - 0.5 * thick * wall.normal
            assert wall.normal @ face == pytest.approx(wall.offset)
            assert pose.translation()[2] == pytest.approx(0.25)


def test_a_slanted_wall_stands_on_the_ground_in_its_plane():
    normal = np.array([0.8, -0.5, 0.3]) / np.sqrt(0.98)
    slab, pose = Wall(normal, 0.7, 0.0).slab(np.array([1.0, 2.0, 3.0]), 10.0, 2.0, -0.1)
    turn = pose.rotation().matrix()
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    size = np.array([slab.width(), slab.depth(), slab.height()])
    corners = 0.5 * size * np.array([[1, i, j] for i in (-1, 1) for j in (-1, 1)])
    face = (pose @ corners.T).T
    np.testing.assert_allclose(face @ normal, 0.7)
    np.testing.assert_allclose(np.sort(face[:, 2])[:2], 0.0, atol=1e-12)
    assert face[:, 2].max() > 1.8


def test_hull_is_the_smallest_convex_polygon():
    generator = np.random.default_rng(3)
    points = generator.normal(size=(200, 2))
    corners = hull(points)
    edges = np.roll(corners, -1, axis=0) - corners
    away = points[:, None] - corners
    assert (edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0] > -1e-12).all()
    assert {tuple(each) for each in corners} <= {tuple(each) for each in points}


def test_a_run_among_them_is_drawn(scenario, tmp_path):
    scenario.duration = 0.2
    result = simulate(scenario, step_time=False)
    bodies = [b for b in set_stage([result]).bodies if b.path.startswith("walls")]
    assert [len(body.parts) for body in bodies] == [1, 2, 2, 2]
    for part in (part for body in bodies for part in body.parts):
        # The page lets what is more opaque throw a shadow: a floor would hide them all.
        assert 0.1 < rgba(part.color).a() <= 0.3
    page = write_replay([result], tmp_path / "page.html").read_text()
    assert len(page) > 1_000_000
    write_figures([result], tmp_path)
    assert (tmp_path / "paths.png").read_bytes().startswith(b"\x89PNG")


def test_an_obstacle_on_waypoints_is_drawn_where_it_is():
    shape = BoxObstacle([0.0, 0.0], [0.4, 0.2], margin=0.1)
    moving = MovingObstacle(
        shape, [0.0, 5.0, 10.0], [[4.0, -2.0], [4.0, -1.0], [5.0, 0.0]]
    )
    (solid,) = solids(moving, 0.1)
    low, high = bounding_box([solid.body])
    np.testing.assert_allclose([low[:2], high[:2]], [[3.6, -2.2], [4.4, -1.8]])
    np.testing.assert_allclose(solid.body.pose.translation()[:2], [4.0, -2.0])
    for time, offset in ((0.0, [0.0, 0.0]), (5.0, [0.0, 1.0]), (99.0, [1.0, 2.0])):
        np.testing.assert_allclose(solid.offset_at(time)[:2], offset, atol=1e-12)
    # Between two of the times at which it is placed it goes straight, nearly.
    times = solid.key_times(10.0)
    for early, late in pairwise(times):
        ends = [solid.offset_at(time) for time in (early, late)]
        between = solid.offset_at(0.5 * (early + late))
        np.testing.assert_allclose(between, np.mean(ends, axis=0), atol=2e-3)
