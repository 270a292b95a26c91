"""Unions, polygons, shapes along trajectories, class-K functions, by other routes."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.systems.primitives import LinearSystem
from pydrake.trajectories import BsplineTrajectory, PiecewisePolynomial
import pytest
from scipy.spatial import ConvexHull

from tests.helpers.row_gradients import row_gradients
from vcbf_drake.barriers import (
    Barrier,
    BarrierSet,
    BoxObstacle,
    PolygonObstacle,
    SphereObstacle,
    all_of,
    any_of,
)
from vcbf_drake.between_ticks import HeldRows
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car

GAINS = [3.0, 2.0]
L_SHAPE = [[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]]
STAR = [
    [np.cos(a) * (2.0 if i % 2 else 0.7), np.sin(a) * (2.0 if i % 2 else 0.7)]
    for i, a in enumerate(np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False))
]


@pytest.fixture(scope="module")
def car() -> ControlAffineModel:
    return ControlAffineModel.from_system(Car())


@pytest.fixture(scope="module")
def point() -> ControlAffineModel:
    """A point in the plane that forces accelerate."""
    A, B = np.zeros((4, 4)), np.zeros((4, 2))
    A[:2, 2:] = B[2:] = np.eye(2)
    plant = LinearSystem(A, B, np.eye(4))
    return ControlAffineModel.from_system(plant)


def values(model, barrier, places, t=0.0):
    barriers = BarrierSet(model, [barrier])
    x = np.zeros(model.num_states)
    found = []
    for place in places:
        x[:2] = place
        found.append(barriers.values(x, t)[0])
    return np.array(found)


def places(scale=4.0, count=60):
    return scale * np.random.default_rng(5).normal(size=(count, 2))


def inside(polygon, place) -> bool:
    """Even-odd rule."""
    crossings = 0
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if (y1 > place[1]) != (y2 > place[1]):
            crossings += place[0] < x1 + (place[1] - y1) * (x2 - x1) / (y2 - y1)
    return crossings % 2 == 1


def distance(polygon, place) -> float:
    """Signed, by the nearest point of each side."""
    polygon, place = np.array(polygon), np.array(place)
    ends = np.roll(polygon, -1, axis=0)
    along = ends - polygon
    s = np.sum((place - polygon) * along, axis=1) / np.sum(along**2, axis=1)
    nearest = polygon + np.clip(s, 0.0, 1.0)[:, None] * along
    least = np.linalg.norm(nearest - place, axis=1).min()
    return -least if inside(polygon, place) else least


@pytest.mark.parametrize("smoothing", [0.01, 0.3])
def test_all_of_is_a_minimum_from_below_and_any_of_a_maximum(car, smoothing):
    discs = [SphereObstacle(c, 0.5) for c in ([0.0, 0.0], [2.0, 0.3], [-1.0, 2.0])]
    each = [disc.barrier(GAINS) for disc in discs]
    h = np.array(
        [[np.linalg.norm(p - disc.center) - 0.5 for disc in discs] for p in places()]
    )
    least = values(car, all_of(each, smoothing), places())
    most = values(car, any_of(each, smoothing), places())
    for exact, found in ((h.min(axis=1), least), (h.max(axis=1), most)):
        assert np.all(found <= exact + 1e-12)
        assert np.all(found >= exact - smoothing)


def test_a_union_overflows_nowhere(car):
    """Where exp(200 h) and exp(-200 h) do: kilometres away, and sharply blended."""
    discs = [SphereObstacle([c, 0.0], 0.5).barrier(GAINS) for c in (-1.0, 0.0, 1.0)]
    for combine in (all_of, any_of):
        union = BarrierSet(car, [combine(discs, 2.0 * np.log(2.0) / 200.0)])
        for x in (0.3, 5.0, -1e3, 1e6):
            rows = union.rows(np.array([x, 0.2, 1.0, 0.1]), 0.0)
            assert np.isfinite([*rows.A[0], *rows.b, *rows.value]).all()
            assert np.isfinite(row_gradients(rows).b).all()


def test_what_cannot_be_combined_is_refused(car):
    disc = SphereObstacle([0.0, 0.0], 0.5)
    for barriers, message in (
        ([], "one at least"),
        ([disc.barrier(GAINS), disc.barrier([4.0, 3.0])], "those of 'obstacle'"),
        ([disc.barrier(GAINS), disc.barrier(GAINS, [0, 1])], "to all of them"),
        ([disc.barrier(GAINS).robust_to(0.1)], "as its shape makes it"),
        ([disc], r"must be a Barrier, as shape.barrier\(gains\) makes it"),
    ):
        with pytest.raises(ValueError, match=message):
            all_of(barriers, 0.1)
    with pytest.raises(ValueError, match="smoothing"):
        any_of([disc.barrier(GAINS)], 0.0)


@pytest.mark.parametrize("vertices", [L_SHAPE, L_SHAPE[::-1], STAR, STAR[:3]])
def test_a_polygon_keeps_its_distance_and_is_tight(point, vertices):
    """Never beyond the distance; and positive a little outside of every side."""
    polygon = PolygonObstacle(vertices, smoothing=1e-3)
    h = values(point, polygon.barrier(GAINS, [0, 1]), places(2.0))
    exact = np.array([distance(vertices, p) for p in places(2.0)])
    assert np.all(np.where(exact > 0.0, h <= exact + 1e-12, h < 0.0))
    corners = np.array(vertices)
    along = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    middles = corners + 0.5 * along
    for side in (1.0, -1.0):
        near = middles + side * 0.02 * normals
        outside = [not inside(vertices, p) for p in near]
        assert len(set(outside)) == 1
        h = values(point, polygon.barrier(GAINS, [0, 1]), near)
        assert np.all(h > 0.0) if outside[0] else np.all(h < 0.0)


@pytest.mark.parametrize("vertices", [L_SHAPE, STAR])
def test_pieces_are_convex_and_make_up_the_polygon(vertices):
    pieces = PolygonObstacle(vertices).pieces

    def area(corners):
        x, y = np.array(corners).T
        return 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))

    assert sum(map(area, pieces)) == pytest.approx(area(vertices))
    for piece in pieces:
        assert area(piece) == pytest.approx(ConvexHull(piece).volume)
    assert len(pieces) < len(vertices) - 2
    assert len(PolygonObstacle(vertices).barriers(GAINS)) == len(pieces)


@pytest.mark.parametrize("size", [1e-3, 1.0])
@pytest.mark.parametrize("vertices", [L_SHAPE, L_SHAPE[::-1], STAR, STAR[:3]])
def test_a_polygon_in_map_coordinates_is_not_turned_inside_out(size, vertices):
    """So far from the origin that the products of coordinates exceed its area."""
    away = np.array([5e5, 5e6])
    pieces = PolygonObstacle(size * np.array(vertices) + away).pieces
    expected = PolygonObstacle(vertices).pieces
    assert len(pieces) == len(expected)
    for piece, right in zip(pieces, expected, strict=True):
        assert_allclose(piece - away, size * right, atol=1e-9)


def test_a_margin_moves_the_sides_out(point):
    square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    polygon = PolygonObstacle(square, margin=0.2, smoothing=1e-4)
    h = values(point, polygon.barrier(GAINS, [0, 1]), [[3.0, 0.5], [0.5, -1.0]])
    assert_allclose(h, [1.8, 0.8], atol=1e-3)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        ([[0.0, 0.0], [1.0, 0.0]], "at least 3 corners"),
        ([[0.0, 0.0, 0.0]] * 3, "at least 3 corners"),
        ([[0.0, 0.0], [1.0, 0.0], [np.nan, 1.0]], "finite"),
        ([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]], "sides 0 and 2 meet"),
        ([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], "corner 2 is corner 1 "),
        (
            [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]],
            "corner 3 is corner 0 again; give it once",
        ),
        ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], "meet"),
    ],
)
def test_bad_polygons_are_refused(vertices, message):
    with pytest.raises(ValueError, match=message):
        PolygonObstacle(vertices)


def trajectories():
    times, knots = [0.0, 1.0, 2.5, 4.0], np.array([[0, 1, 3, 2.0], [0, 2, 1, -1.0]])
    cubic = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(times, knots)
    basis = BsplineBasis(4, 4, KnotVectorType.kClampedUniform, 0.0, 4.0)
    points = [column[:, None] for column in knots.T]
    spline = BsplineTrajectory(basis, points)
    return [cubic, PiecewisePolynomial.FirstOrderHold(times, knots), spline]


@pytest.mark.parametrize("kind", [0, 1, 2])
@pytest.mark.parametrize(
    "shape",
    [
        SphereObstacle([0.5, -0.5], 0.4),
        BoxObstacle([0.5, -0.5], [0.2, 0.3]),
        PolygonObstacle([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]]),
    ],
)
def test_rows_along_a_trajectory_are_its_differences(point, kind, shape):
    """H' and h'' along a motion, with the trajectory itself asked at every instant."""
    trajectory = trajectories()[kind]
    moving = shape.barrier_along(trajectory, GAINS, [0, 1])
    standing = BarrierSet(point, [shape.barrier(GAINS, [0, 1])])
    barriers, u = BarrierSet(point, [moving]), np.array([0.3, -0.2])
    start = np.array([4.0, 3.0, -0.4, 0.2])

    def motion(t):
        place = start[:2] + start[2:] * t + 0.5 * u * t**2
        return np.array([*place, *(start[2:] + u * t)])

    def h(t):
        x = motion(t)
        x[:2] -= trajectory.value(t).ravel()
        return standing.values(x, 0.0)[0]

    for t in (0.4, 1.7, 3.1):
        step = 1e-3
        ahead, here, behind = h(t + step), h(t), h(t - step)
        rate = (ahead - behind) / (2 * step)
        second = (ahead - 2 * here + behind) / step**2
        rows = barriers.rows(motion(t), t)
        assert rows.value[0] == pytest.approx(here)
        chi = rows.b[0] - rows.A[0] @ u
        expected = second + GAINS[0] * rate + GAINS[1] * here
        assert chi == pytest.approx(expected, abs=2e-5)
        assert barriers.values_along([motion(t)], [t])[0, 0] == pytest.approx(here)


def test_a_shape_stands_before_and_after_its_trajectory(point):
    trajectory = trajectories()[0]
    moving = SphereObstacle([0.0, 0.0], 0.4).barrier_along(trajectory, GAINS, [0, 1])
    for t, place in ((-1.0, [0.0, 0.0]), (9.0, [2.0, -1.0])):
        rows = BarrierSet(point, [moving]).rows(np.array([5.0, 0.0, 0.0, 0.0]), t)
        expected = np.linalg.norm(np.subtract([5.0, 0.0], place)) - 0.4
        assert rows.value[0] == pytest.approx(expected)
        assert rows.b[0] == pytest.approx(GAINS[1] * expected)


def test_what_cannot_be_followed_is_refused(point):
    sphere = SphereObstacle([0.0, 0.0, 0.0], 0.4)
    with pytest.raises(ValueError, match=r"shape of the trajectory: .*\(3, 1\)"):
        sphere.barrier_along(trajectories()[0], GAINS)
    moving = SphereObstacle([0.0, 0.0], 0.4).barrier_along(
        trajectories()[0], GAINS, [0, 1], "truck"
    )
    with pytest.raises(ModelError, match="'truck': no enclosure between ticks"):
        HeldRows(point, BarrierSet(point, [moving]), 0.02, 0.0)


def test_a_cube_is_a_class_k_function(point):
    """Chi = h'' + lambda_1 h' + (h' + lambda_1 h)^3 beside the plain one."""
    sphere = SphereObstacle([0.0, 0.0], 0.5).barrier([5.0, 6.0], [0, 1])  # 3 and 2
    x = np.array([2.0, 0.0, -0.5, 0.0])
    plain = BarrierSet(point, [sphere]).rows(x, 0.0)
    cubic = BarrierSet(point, [sphere.with_class_k(lambda s: s**3)]).rows(x, 0.0)
    h, rate = 1.5, -0.5
    level = rate + 3.0 * h
    assert plain.chain[0] == pytest.approx([h, level])
    assert cubic.chain[0] == pytest.approx([h, level])
    assert cubic.b[0] - plain.b[0] == pytest.approx(level**3 - 2.0 * level)
    assert cubic.A == pytest.approx(plain.A)


def test_a_class_k_function_of_relative_degree_1(car):
    speed = Barrier(lambda x, t, p: 2.0 - x[2], [1.0]).with_class_k(np.tanh)
    rows = BarrierSet(car, [speed]).rows(np.array([0.0, 0.0, 0.5, 0.0]), 0.0)
    assert rows.b[0] == pytest.approx(np.tanh(1.5))
    (gradient,) = row_gradients(rows).b
    assert gradient[2] == pytest.approx(-(1.0 - np.tanh(1.5) ** 2))


@pytest.mark.parametrize(
    "class_k",
    [
        lambda s: s**2,
        lambda s: 1.0 + s,
        lambda s: -s,
        lambda s: 0.0 * s,
        lambda s: s**0.5,  # Nothing at all on one side.
        lambda s: None,
        lambda s: "s",
        lambda s: s + 0.3 * np.sin(30.0 * s),
        # It falls between 0.52 and 0.55 alone.
        lambda s: s * (1.0 - 0.999 * np.exp(-(((s - 0.55) / 0.02) ** 2))),
    ],
)
def test_what_is_no_class_k_function_is_refused(class_k):
    barrier = Barrier(lambda x, t, p: x[0], GAINS, name="b")
    with pytest.raises(ValueError, match="'b': class_k must be 0 at 0 and increase"):
        barrier.with_class_k(class_k)


def test_a_class_k_function_is_a_function():
    barrier = Barrier(lambda x, t, p: x[0], GAINS, name="b")
    with pytest.raises(ValueError, match=r"'b': class_k: 0.5; it must be a function"):
        barrier.with_class_k(0.5)


def test_a_class_k_function_that_its_symbols_misread_is_refused(car):
    barrier = Barrier(lambda x, t, p: 2.0 - x[2], [1.0], name="b")
    odd = barrier.with_class_k(lambda s: (s**2) ** 0.5 * s)
    with pytest.raises(ModelError, match=r"barrier 'b': class_k is .* of its symbols"):
        BarrierSet(car, [odd])


def test_a_polygon_of_many_corners_comes(car):
    """Its formula uses each piece many times; it is that of the pieces all the same."""
    turn = np.linspace(0.0, 2.0 * np.pi, 80, endpoint=False)
    reach = 5.0 + np.random.default_rng(0).uniform(-1.0, 1.0, turn.size)
    corners = np.column_stack([reach * np.cos(turn), reach * np.sin(turn)])
    polygon = PolygonObstacle(corners)
    size, formula, parameters = polygon.formula()
    whole = BarrierSet(car, [polygon.barrier([2.0, 1.0])])
    pieces = BarrierSet(car, polygon.barriers([2.0, 1.0]))
    for x, y in ((8.0, 0.0), (-3.0, 7.0), (0.0, 0.0)):
        state = np.array([x, y, 1.0, 0.3])
        (h,) = whole.values(state, 0.0)
        (written,) = [formula(state[:size], 0.0, np.array(parameters))]
        assert h == pytest.approx(written)
        assert h <= pieces.values(state, 0.0).min()
