"""Barriers on MultibodyPlants: rows by Drake's kinematics and dynamics."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from tests.helpers.multibody_plants import (
    PLANAR,
    SEVEN,
    free_body_with_arm,
    load,
    quadrotor,
    states,
)
from tests.helpers.row_gradients import row_gradients
from tests.helpers.trajectory_rows import assert_rows_are_derivatives
from vcbf_drake import Barrier, ControlAffineModel, ModelError, SphereObstacle
from vcbf_drake.barriers import BarrierSet, HalfSpace, StateLimit
from vcbf_drake.between_ticks.enclosures import RowEnclosures
from vcbf_drake.model import point_position


def barriers_of(plant, frame, offset):
    """A moving sphere, a wall, a joint's and a speed's limit, one of one's own."""
    hand = point_position(plant, frame, offset)
    nq = plant.num_positions()

    def braking(x, t, p):
        """H = 2 - q - v²/6: room left to brake in."""
        return 2.0 - x[0] - x[nq] ** 2 / 6.0 + p[0] * t

    def sum_of_joint_and_height(x, t, p):
        return hand(x)[2] + p[0] * x[nq - 1] ** 2 - 0.1 * t * t

    moving = SphereObstacle([0.6, 0.3, 1.2], 0.2, velocity=[0.1, 0.2, 0.0])
    wall = HalfSpace([1.0, 0.0, 0.3], -2.0)
    return [
        moving.barrier([4.0, 3.0], position=hand, name="sphere"),
        wall.barrier([5.0, 4.0], position=hand, name="wall"),
        StateLimit(nq - 1, upper=2.5).barriers([12.0, 32.0], "joint")[0],
        StateLimit(nq, lower=-2.0).barriers([12.0], "speed")[0],
        Barrier(braking, [3.0], [0.2], "braking"),
        Barrier(sum_of_joint_and_height, [4.0, 3.0], [0.7], "own"),
    ]


def test_numbers_and_symbols_give_the_same_rows():
    plant = load(PLANAR)
    each = barriers_of(plant, "forearm", [0.5, 0.0, 0.1])
    numbers = BarrierSet(ControlAffineModel.from_system(plant, "actuation"), each)
    symbols = BarrierSet(
        ControlAffineModel.from_system(plant, "actuation", symbolic=True), each
    )
    for i, x in enumerate(states(plant, 20)):
        t = 0.3 * i - 1.0
        ours, theirs = numbers.rows(x, t), symbols.rows(x, t)
        slopes = zip(row_gradients(ours)[:2], row_gradients(theirs)[:2], strict=True)
        for a, b in (
            (ours.A, theirs.A),
            (ours.b, theirs.b),
            (ours.value, theirs.value),
            *slopes,
        ):
            assert_allclose(a, b, rtol=1e-9, atol=1e-9 * (1.0 + np.abs(b).max()))
        for a, b in zip(ours.chain, theirs.chain, strict=True):
            assert_allclose(a, b, rtol=1e-9, atol=1e-9)
        assert_allclose(numbers.values(x, t), symbols.values(x, t), rtol=1e-9)


@pytest.mark.parametrize("which", range(6))
def test_rows_of_seven_joints_are_derivatives_along_a_flight(which):
    plant = load(SEVEN)
    barrier = barriers_of(plant, "hand", [0.02, 0.0, 0.05])[which]
    context = plant.CreateDefaultContext()

    def h(x, t):
        plant.SetPositionsAndVelocities(context, x)
        world, hand = plant.world_frame(), plant.GetFrameByName("hand")
        point = np.array([[0.02], [0.0], [0.05]])
        p = plant.CalcPointsPositions(context, hand, point, world).ravel()
        center = np.array([0.6 + 0.1 * t, 0.3 + 0.2 * t, 1.2])
        normal = np.array([1.0, 0.0, 0.3])
        return (
            np.linalg.norm(p - center) - 0.2,
            (normal @ p + 2.0) / np.hypot(1.0, 0.3),
            2.5 - x[6],
            x[7] + 2.0,
            2.0 - x[0] - x[7] ** 2 / 6.0 + 0.2 * t,
            p[2] + 0.7 * x[6] ** 2 - 0.1 * t * t,
        )[which]

    start = [0.2, 0.7, -0.3, 0.9, 0.2, -0.5, 0.3, *np.linspace(-0.4, 0.5, 7)]
    u = np.array([0.5, -23.0, 2.5, -5.0, 0.2, 0.8, 0.05])
    assert_rows_are_derivatives(plant, barrier, h, start, u, input_port="actuation")


def test_a_free_body_and_its_arm_keep_their_distance():
    """A frame with propellers at an offset mass; a free body with a link on it."""
    quad, frame_plant = quadrotor()
    corner = point_position(frame_plant, "frame", [0.2, 0.0, 0.0])
    ball = SphereObstacle([3.0, 0.5, 0.2], 0.4).barrier([2.0, 1.0], position=corner)
    model = ControlAffineModel.from_system(quad)
    rows = BarrierSet(model, [ball])
    for x in states(frame_plant, 5):
        assert np.isfinite(row_gradients(rows.rows(x, 0.0)).b).all()
    plant = free_body_with_arm()
    context = plant.CreateDefaultContext()
    tip = point_position(plant, "link", [0.4, 0.0, 0.0])
    floor = HalfSpace([0.0, 0.0, 1.0], -1.0).barrier([4.0, 3.0], position=tip)
    model = ControlAffineModel.from_system(plant, "applied_generalized_force")
    rows = BarrierSet(model, [floor])
    for x in states(plant, 5):
        plant.SetPositionsAndVelocities(context, x)
        place = plant.CalcPointsPositions(
            context,
            plant.GetFrameByName("link"),
            np.array([[0.4], [0.0], [0.0]]),
            plant.world_frame(),
        )
        assert rows.values(x, 0.0)[0] == pytest.approx(place[2, 0] + 1.0)


def test_a_robust_barrier_is_a_plain_one_for_forces_disturb_no_position_first():
    plant = load(PLANAR)
    model = ControlAffineModel.from_system(plant, "actuation")
    hand = point_position(plant, "forearm", [0.5, 0.0, 0.0])
    plain = SphereObstacle([0.6, 0.3, 1.2], 0.2).barrier([4.0, 3.0], position=hand)
    rows = BarrierSet(model, [plain, plain.robust_to(0.3)])
    for x in states(plant, 5):
        found = rows.rows(x, 0.0)
        assert_allclose(found.A[0], found.A[1])
        assert_allclose(found.b[0], found.b[1])


def test_certificates_between_ticks_ask_for_symbols():
    plant = load(PLANAR)
    model = ControlAffineModel.from_system(plant, "actuation")
    rows = BarrierSet(model, StateLimit(2, upper=1.0).barriers([5.0]))
    with pytest.raises(ModelError, match=r"Drake evaluates .* symbolic=True"):
        RowEnclosures.at(rows, 0.0)


def test_what_cannot_be_done_says_so_with_a_way_out():
    plant = load(SEVEN)
    model = ControlAffineModel.from_system(plant, "actuation")
    hand = point_position(plant, "hand")

    def height(x, t, p):
        return hand(x)[2]

    def speed_at_rest(x, t, p):
        return 1.0 - x[7] * x[7]

    def time_alone(x, t, p):
        return t

    for function, gains, message in (
        (height, [1.0], "its relative degree is 2, not 1: give 2 gains"),
        (height, [6.0, 11.0, 6.0], "its relative degree is 2, not 3: give 2 gains"),
        (speed_at_rest, [3.0, 2.0], "its relative degree is 1, not 2: give 1 gain$"),
        (time_alone, [3.0, 2.0], "no input enters derivative 2 of h"),
    ):
        with pytest.raises(ModelError, match=message):
            BarrierSet(model, [Barrier(function, gains)])
    floating = free_body_with_arm()
    model = ControlAffineModel.from_system(floating, "actuation")
    with pytest.raises(ModelError, match="base_body_qw, whose rate is no velocity"):
        BarrierSet(model, [StateLimit(0, upper=0.5).barriers([4.0, 3.0])[0]])


def test_a_point_of_another_robot_is_refused():
    """Its joints were taken to be the first of the plant's."""
    robot, other = load(SEVEN), load(PLANAR)
    elsewhere = point_position(other, "forearm")
    wall = HalfSpace([1.0, 0.0, 0.0], -2.0).barrier([3.0, 2.0], position=elsewhere)
    with pytest.raises(ModelError, match=r"which has 2 positions; the filter's .* 7"):
        BarrierSet(ControlAffineModel.from_system(robot), [wall])
