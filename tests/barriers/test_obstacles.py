"""Obstacles, against plain geometry."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.row_gradients import row_gradients
from vcbf_drake.barriers import BarrierSet, SphereObstacle
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car

K = (4.0, 3.0)


@pytest.fixture(scope="module")
def car() -> ControlAffineModel:
    return ControlAffineModel.from_system(Car())


def test_the_centre_moves() -> None:
    obstacle = SphereObstacle([1.0, 2.0, 3.0], 0.5, velocity=[0.1, 0.0, -0.2])
    assert_allclose(obstacle.center_at(0.0), [1.0, 2.0, 3.0])
    assert_allclose(obstacle.center_at(10.0), [2.0, 2.0, 1.0])
    assert_allclose(obstacle.center_at(np.array([0.0, 10.0])), [[1, 2, 3], [2, 2, 1]])


@pytest.mark.parametrize("velocity", [None, [], [0.0, 0.0]])
def test_the_centre_stands(velocity) -> None:
    obstacle = SphereObstacle([1.0, 2.0], 0.5, velocity)
    assert_allclose(obstacle.center_at(7.0), [1.0, 2.0])
    assert obstacle.center_at(np.arange(4.0)).shape == (4, 2)


@pytest.mark.parametrize(
    ("form", "expected"), [("distance", 5.0 - 1.3), ("squared", 25.0 - 1.3**2)]
)
def test_the_barrier_keeps_radius_and_margin(car, form, expected) -> None:
    obstacle = SphereObstacle([1.0, 1.0], 1.0, form=form, margin=0.3)
    assert obstacle.safety_distance == pytest.approx(1.3)
    x = np.array([4.0, 5.0, 0.7, 0.1])
    barriers = BarrierSet(car, [obstacle.barrier(K, name="rock")])
    assert barriers.names == ("rock",)
    assert barriers.values(x, 3.0) == pytest.approx([expected])


@pytest.mark.parametrize("form", ["distance", "squared"])
def test_a_standing_obstacle_is_a_moving_one_of_no_speed(car, form) -> None:
    # They compile to different code.
    standing = SphereObstacle([1.0, 1.0], 0.4, form=form).barrier(K)
    moving = SphereObstacle([1.0, 1.0], 0.4, [0.0, 1e-200], 0.0, form).barrier(K)
    x = np.array([0.2, -0.3, 0.7, 0.1])
    rows = BarrierSet(car, [standing, moving]).rows(x, 2.0)
    for array in (rows.A, rows.b, rows.w, row_gradients(rows).A, row_gradients(rows).b):
        assert_allclose(array[0], array[1], rtol=1e-12, atol=1e-12)


def test_a_moving_obstacle_is_a_moving_frame(car) -> None:
    # Where a car drives with the obstacle, the distance keeps its value.
    heading, speed, t = 0.4, 0.8, 2.5
    velocity = speed * np.array([np.cos(heading), np.sin(heading)])
    obstacle = SphereObstacle([1.0, 1.0], 0.4, velocity.tolist())
    x = np.array([0.0, 0.0, speed, heading])
    x[:2] = velocity * t
    rows = BarrierSet(car, [obstacle.barrier(K)]).rows(x, t)
    h = np.sqrt(2.0) - 0.4
    assert_allclose(rows.chain[0], [h, 3.0 * h], rtol=1e-12)
    assert rows.b == pytest.approx([3.0 * h])


def test_the_position_may_be_any_states(car) -> None:
    obstacle = SphereObstacle([1.0, 1.0], 0.5)
    barrier = obstacle.barrier(K, position=(1, 0))
    x = np.array([1.0, 4.0, 0.0, 0.0])
    assert BarrierSet(car, [barrier]).values(x, 0.0) == pytest.approx([2.5])
    with pytest.raises(ValueError, match="position must name 2 states, got"):
        obstacle.barrier(K, position=(0, 1, 2))
    with pytest.raises(ModelError, match=r"'obstacle'.*out of bounds"):
        BarrierSet(car, [obstacle.barrier(K, position=(0, 9))])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"center": [1.0]}, "center: .* 2 or 3 numbers"),
        ({"center": [1.0, np.nan]}, r"center: .*finite numbers"),
        ({"center": [[1.0, 2.0]]}, r"center.*a number"),
        ({"radius": -1.0}, "radius: -1; it must be finite and not below 0"),
        ({"radius": np.inf}, "radius: inf; it must be finite"),
        ({"margin": -0.1}, "margin: -0.1; it must be finite and not below 0"),
        ({"radius": 0.0}, "margin: 0; it must be finite and above 0"),
        ({"velocity": [1.0]}, "velocity: .* a list of 2 numbers"),
        ({"velocity": [1.0, np.inf]}, r"velocity.*finite"),
        ({"form": "round"}, "form: 'round'; it must be one of distance, squared"),
    ],
)
def test_bad_obstacles_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"^obstacle: .*{message}"):
        SphereObstacle(**{"center": [1.0, 2.0], "radius": 0.5, **arguments})
