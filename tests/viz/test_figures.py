import copy
import dataclasses
from itertools import combinations
import struct
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from tests.helpers.pages import page_data
from tests.helpers.synthetic_results import blimp_result, blimp_results, car_result
from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.safety.settings import METHODS
from vcbf_drake.simulation import InputLimits, load_scenario, simulate
from vcbf_drake.viz import write_figures, write_replay
from vcbf_drake.viz.feasible_set import (
    feasible_set_at,
    feasible_set_figure,
    polytope_vertices,
    shadow,
    telling_times,
)
from vcbf_drake.viz.figures import parallel_view
from vcbf_drake.viz.runs import label_runs
from vcbf_drake.viz.series_figures import input_figure, volume_figure
from vcbf_drake.viz.solids import hull
from vcbf_drake.viz.style import METHOD_STYLES, figure_style, save_figure

BLIMP_FIGURES = [
    "overview",
    "paths",
    "barriers",
    "volume",
    "slack",
    "disturbance",
    "inputs",
    "feasible_sets",
]


def png_size_and_dpi(path):
    """Read from the file's own chunks."""
    content = path.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", content[16:24])
    at = content.index(b"pHYs") + 4
    per_metre = struct.unpack(">I", content[at : at + 4])[0]
    return width, height, per_metre * 0.0254


def random_polytope(rng, inputs):
    """Rows around the origin with a box to close them."""
    rows = rng.normal(size=(2 * inputs + 3, inputs))
    A = np.vstack([rows, np.eye(inputs), -np.eye(inputs)])
    return A, np.concatenate([rng.uniform(0.3, 1.0, len(rows)), np.ones(2 * inputs)])


def same_points(first, second):
    """Every point of one set is a point of the other."""
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    return distance.min(axis=0).max() < 1e-7 and distance.min(axis=1).max() < 1e-7


def test_a_blimps_figures(tmp_path):
    paths = write_figures(blimp_results()[1:], tmp_path / "made" / "here")
    assert [p.name for p in paths] == [
        f"{name}.{ending}" for name in BLIMP_FIGURES for ending in ("png", "svg")
    ]
    for path in paths:
        if path.suffix == ".png":
            width, height, dpi = png_size_and_dpi(path)
            assert dpi == pytest.approx(160, abs=0.1)
            assert 900 < width < 1600 and 300 < height < 2000
        else:
            assert ElementTree.parse(path).getroot().tag.endswith("svg")
            assert b"dc:date" not in path.read_bytes()


def test_a_method_without_a_volume_row_has_no_volume_to_show(tmp_path):
    result = car_result("cbf-qp", 2.0)
    assert {p.stem for p in write_figures([result], tmp_path)} == {*BLIMP_FIGURES} - {
        "volume"
    }
    page = page_data(write_replay([result], tmp_path / "page.html").read_text())
    assert "volume" not in [plot["key"] for plot in page["plots"]]


def test_a_cars_figures_are_those_of_two_inputs(tmp_path):
    runs = [car_result("cbf-qp", 4.0, "collision", 0.3), car_result()]
    paths = write_figures(runs, tmp_path)
    assert {p.stem for p in paths} == set(BLIMP_FIGURES)


def test_the_same_result_gives_the_same_bytes(tmp_path):
    contents = []
    for name in ("first", "second"):
        with figure_style():
            figure = volume_figure(label_runs(blimp_results()))
            (tmp_path / name).mkdir()
            saved = save_figure(figure, tmp_path / name, "volume")
        contents.append([path.read_bytes() for path in saved])
    assert contents[0] == contents[1]


def test_the_users_settings_stay_as_they_are(tmp_path):
    before = dict(matplotlib.rcParams)
    with figure_style():
        assert matplotlib.rcParams["svg.hashsalt"] == "vcbf_drake"
    assert dict(matplotlib.rcParams) == before


def test_every_method_has_its_own_colour_and_dashes():
    assert list(METHOD_STYLES) == list(METHODS)
    for field in ("label", "color", "dashes"):
        assert len({getattr(s, field) for s in METHOD_STYLES.values()}) == len(METHODS)


def test_a_run_without_a_state_of_the_filter_is_drawn(tmp_path):
    # A run that never solved: no volume, no ellipsoid, limits instead of barriers.
    result = blimp_result(end=2.0)
    names = ("volume", "ellipsoid_shape", "ellipsoid_center")
    missing = {name: np.full_like(result.log[name], np.nan) for name in names}
    barriers = result.log["barriers"].copy()
    barriers[:, 0] = np.nan
    log = result.log | missing | {"barriers": barriers}
    assert write_figures([dataclasses.replace(result, log=log)], tmp_path)


def test_a_reference_that_is_not_finite_has_no_place_in_pictures(tmp_path):
    result = car_result(end=2.0)
    reference = result.log["reference"].copy()
    reference[:, 1] = np.nan
    log = result.log | {"reference": reference}
    run = dataclasses.replace(result, log=log)
    assert write_figures([run], tmp_path)
    assert write_replay([run], tmp_path / "replay.html").exists()


def test_the_least_barrier_leaves_out_what_is_not_a_number():
    result = blimp_result(end=1.0)
    result.log["barriers"][:, 2] = np.nan
    result.log["barriers"][4] = np.nan
    least = label_runs([result])[0].least_barrier
    assert np.isnan(least[4])
    assert least[7] == np.nanmin(result.log["barriers"][7])


def test_the_failure_is_at_its_tick():
    run = label_runs([blimp_result("dob-cbf-qp", 7.6, infeasible=True)])[0]
    assert run.time[run.failure_tick] == pytest.approx(7.6)
    assert label_runs([blimp_result(end=1.0)])[0].failure_tick is None


def corners_by_enumeration(A, b):
    """Where m rows meet and the others hold."""
    corners = []
    for rows in map(list, combinations(range(len(A)), A.shape[1])):
        if abs(np.linalg.det(A[rows])) > 1e-9:
            point = np.linalg.solve(A[rows], b[rows])
            if np.all(A @ point <= b + 1e-9):
                corners.append(point)
    return np.array(corners)


@pytest.mark.parametrize("inputs", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", range(6))
def test_corners_are_where_rows_meet(inputs, seed):
    A, b = random_polytope(np.random.default_rng(seed), inputs)
    corners = polytope_vertices(A, b, -np.ones(inputs), np.ones(inputs))
    assert same_points(corners, corners_by_enumeration(A, b))


def test_a_thousand_rows_that_do_not_cut_change_nothing():
    rng = np.random.default_rng(0)
    A, b = random_polytope(rng, 3)
    far = rng.normal(size=(5000, 3))
    far_sides = np.abs(far).sum(axis=1) + rng.uniform(1e-3, 9.0, 5000)
    all_rows, sides = np.vstack([far, A]), np.concatenate([far_sides, b])
    corners = polytope_vertices(all_rows, sides, -np.ones(3), np.ones(3))
    assert same_points(corners, corners_by_enumeration(A, b))


def test_a_thousand_rows_that_cut_leave_a_set_inside_them():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(1000, 3))
    b = np.linalg.norm(A, axis=1)  # All touch the unit ball.
    corners = polytope_vertices(A, b, -2.0 * np.ones(3), 2.0 * np.ones(3))
    assert np.all(corners @ A.T <= b + 1e-8)
    # A little more than the ball that all of them touch.
    assert ConvexHull(corners).volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.02)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_corners_of_a_box_in_any_unit(scale):
    A = np.vstack([np.eye(3), -np.eye(3)])
    b = scale * np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    reach = 5.0 * scale * np.ones(3)
    corners = polytope_vertices(A, b, -reach, reach)
    assert len(corners) == 8
    np.testing.assert_allclose(corners.max(axis=0), scale * np.array([1.0, 2.0, 3.0]))


def test_an_input_that_is_fixed_leaves_a_flat_set():
    A, b = np.array([[1.0, 1.0, 0.0]]), np.array([0.5])
    low, high = np.array([-1.0, -1.0, 0.3]), np.array([1.0, 1.0, 0.3])
    corners = polytope_vertices(A, b, low, high)
    np.testing.assert_allclose(corners[:, 2], 0.3)
    around = [[-1, -1], [1, -1], [1, -0.5], [-0.5, 1], [-1, 1]]
    assert same_points(hull(corners[:, :2]), np.array(around))


@pytest.mark.parametrize("widths", [[2.0, 3.0, 1.0], [2.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
def test_the_shadow_of_an_ellipsoid_flat_or_not(widths):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    B = np.diag(widths) @ turn
    L = shadow(B)
    np.testing.assert_allclose(L @ L.T, (B @ B.T)[:2, :2], atol=1e-12)
    assert L[0, 1] == 0.0 and (np.diag(L) >= 0.0).all()


@pytest.mark.filterwarnings("error")
def test_the_inputs_of_a_dead_actuator_are_drawn(tmp_path):
    scenario = load_scenario(
        "car-avoidance",
        {"duration": 0.1, "input_set": {"lower": [-3, 0], "upper": [3, 0]}},
    )
    runs = label_runs([simulate(scenario)])
    for figure in (feasible_set_figure(runs, [0.1]), input_figure(runs)):
        figure.savefig(tmp_path / "figure.png")


def test_an_empty_set_has_no_corners():
    A, reach = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.ones(2)
    assert polytope_vertices(A, -np.ones(2), -reach, reach).shape == (0, 2)
    impossible = polytope_vertices(np.zeros((1, 2)), -np.ones(1), -reach, reach)
    assert impossible.shape == (0, 2)


def test_the_telling_times():
    assert telling_times(label_runs(blimp_results())) == pytest.approx([2, 7.58, 7.6])
    assert telling_times(label_runs([blimp_result(end=12.0)])) == [2.0, 6.0, 9.0]


def test_an_empty_set_names_its_conflict():
    run = label_runs([blimp_result("dob-cbf-qp", 7.6, infeasible=True)])[0]
    assert not feasible_set_at(run, 7.58).empty
    empty = feasible_set_at(run, 7.6)
    assert empty.empty
    assert 6 in empty.conflict  # The first obstacle's row follows six input limits.
    assert len(empty.conflict) <= 4


def test_the_set_is_that_of_the_last_tick():
    run = label_runs([blimp_result(end=4.0)])[0]
    log = run.result.log
    np.testing.assert_array_equal(feasible_set_at(run, 2.0).b, log["polytope_b"][100])
    np.testing.assert_array_equal(feasible_set_at(run, 2.019).b, log["polytope_b"][100])
    np.testing.assert_array_equal(feasible_set_at(run, 99.0).b, log["polytope_b"][-1])


def test_rows_that_are_not_finite_are_left_out():
    result = blimp_result(end=1.0)
    result.log["polytope_A"][:, 7] = np.nan
    chosen = feasible_set_at(label_runs([result])[0], 0.5)
    assert np.all(np.isfinite(chosen.A))
    assert not chosen.empty


def test_a_parallel_view_keeps_lengths_across_it():
    view = parallel_view(azimuth=-112.0, elevation=24.0)
    right, up, toward = view
    np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, up), toward, atol=1e-12)
    assert up[2] > 0.0


def crowd(count, dims=2):
    """So many small obstacles beside the way."""
    rng = np.random.default_rng(0)
    low, high = [[0.0, 1.0, 0.0][:dims], [60.0, 31.0, 9.0][:dims]]
    centers = rng.uniform(low, high, size=(count, dims))
    return [SphereObstacle(center.tolist(), 0.2) for center in centers]


def test_infinite_limits_are_no_rows(tmp_path):
    result = car_result(end=3.0)
    limits = InputLimits([-0.8, -0.7], [0.8, 0.7], [[0.0, 1.0]], [2.0])
    limits.lower[1], limits.upper[1] = -np.inf, np.inf
    scenario = copy.copy(result.scenario)
    scenario.input_set = limits
    log = result.log | {"polytope_b": result.log["polytope_b"].copy()}
    log["polytope_b"][:, [1, 3]] = np.inf
    result = dataclasses.replace(result, scenario=scenario, log=log)
    chosen = feasible_set_at(label_runs([result])[0], 1.0)
    assert np.all(np.isfinite(chosen.corners)) and len(chosen.corners) >= 3
    assert write_figures([result], tmp_path)


@pytest.mark.slow
def test_a_minute_among_a_thousand_discs_has_figures_within_bounds(tmp_path):
    result = car_result(end=60.0, obstacles=crowd(1000))
    assert result.log["polytope_A"].shape == (3001, 1004, 2)
    paths = write_figures([result], tmp_path)
    assert max(path.stat().st_size for path in paths) < 3e6
