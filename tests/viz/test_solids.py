"""Obstacles that are no spheres, as pictures show them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.obstacle_kinds import EVERY_KIND
from vcbf_drake import load_scenario
from vcbf_drake.simulation import simulate
from vcbf_drake.viz import write_figures, write_replay
from vcbf_drake.viz.solids import hull, solids_of, walls_of


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("car-avoidance", EVERY_KIND)


def area(corners):
    x, y = corners.T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def test_outlines_have_the_true_size(scenario):
    ellipse, capsule, box = solids_of(scenario, height=0.2)
    sizes = [area(each.outline([0, 1], 0.0)) for each in (ellipse, capsule, box)]
    length = np.hypot(4.0, 0.5)
    true = [np.pi * 0.5 * 0.3, 2 * 0.2 * length + np.pi * 0.2**2, 4 * 0.4 * 0.2]
    np.testing.assert_allclose(sizes, true, rtol=0.01)
    # The box is turned by a right angle.
    low, high = (
        box.outline([0, 1], 0.0).min(axis=0),
        box.outline([0, 1], 0.0).max(axis=0),
    )
    np.testing.assert_allclose(high - low, [0.4, 0.8])
    np.testing.assert_allclose((high + low) / 2.0, [2.5, -2.0])


def test_moving_solids_move(scenario):
    _, capsule, _ = solids_of(scenario, height=0.2)
    offset = capsule.pose_at(5.0).translation() - capsule.pose.translation()
    np.testing.assert_allclose(offset, [0.0, 0.05, 0.0])
    before, after = (capsule.outline([0, 1], time) for time in (0.0, 5.0))
    np.testing.assert_allclose(after - before, 0.0 * before + [0.0, 0.05], atol=1e-12)


def test_walls_are_where_the_half_spaces_end(scenario):
    normals = [each.normal.tolist() for each in walls_of(scenario)]
    assert normals == [[0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, -1, 0]]
    assert [each.offset for each in walls_of(scenario)] == [-3.0, -1.0, -20.0, -4.0]
    for wall in walls_of(scenario):
        slab, matrix = wall.slab(np.zeros(3), size=10.0, height=0.5)
        face = matrix[:3, 3] + 0.5 * slab.width() * wall.normal
        assert wall.normal @ face == pytest.approx(wall.offset)
        assert matrix[2, 3] == pytest.approx(0.25)


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
    page = write_replay([result], tmp_path / "page.html").read_text()
    assert len(page) > 1_000_000
    write_figures([result], tmp_path)
    assert (tmp_path / "paths.png").read_bytes().startswith(b"\x89PNG")
