"""Barriers and their rows, against closed forms worked out by hand."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from pydrake.symbolic import Expression
import pytest

from tests.helpers.row_gradients import row_gradients
from vcbf_drake.barriers import (
    Barrier,
    BarrierSet,
    SphereObstacle,
    StateInputLimit,
)
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, BlimpParameters, Car, CarParameters

K = (10.0, 3.55)
CENTER, RADIUS = np.array([0.5, -0.2, 0.4]), 0.3


@pytest.fixture(scope="module")
def blimp() -> ControlAffineModel:
    return ControlAffineModel.from_system(Blimp(), "input", "disturbance")


@pytest.fixture(scope="module")
def car() -> ControlAffineModel:
    return ControlAffineModel.from_system(Car(CarParameters(mass=1.7)))


def blimp_row(x, center, radius, k1, k2):
    """(E77), (E78) and (E59): h, dh, A, b, w and their gradients by x (8)."""
    parameters = BlimpParameters()
    m_x, _, m_z = parameters.effective_masses
    drag_x, _, drag_z = parameters.drag
    p, psi, v = x[:3], x[3], x[4:7]
    rho = np.linalg.norm(p - center)
    n = (p - center) / rho
    h, dh = rho - radius, n @ v
    G = np.array(
        [[np.cos(psi) / m_x, 0, 0], [np.sin(psi) / m_x, 0, 0], [0, 1 / m_z, 0]]
    )
    dG = np.array([[-np.sin(psi) / m_x, 0, 0], [np.cos(psi) / m_x, 0, 0], [0, 0, 0]])
    damping = np.diag([drag_x / m_x, drag_x / m_x, drag_z / m_z])
    f_v = -damping @ v
    Pi = (np.eye(3) - np.outer(n, n)) / rho

    b = k1 * dh + k2 * h + (v @ v - dh**2) / rho + n @ f_v
    A_gradient, b_gradient, w_gradient = np.zeros((3, 8)), np.zeros(8), np.zeros((3, 8))
    A_gradient[:, :3] = -G.T @ Pi
    A_gradient[:, 3] = -n @ dG
    b_gradient[:3] = (
        k1 * Pi @ v
        + k2 * n
        - 2 * dh * Pi @ v / rho
        - (v @ v - dh**2) * n / rho**2
        + Pi @ f_v
    )
    b_gradient[4:7] = k1 * n + 2 * (v - dh * n) / rho - damping @ n
    w_gradient[:, :3] = Pi
    return h, dh, -n @ G, b, n, A_gradient, b_gradient, w_gradient


def car_row(x, center, radius, k1, k2, mass):
    """(E80): h, dh, A, b, w."""
    r, v = x[:2] - center, x[2]
    q = np.array([np.cos(x[3]), np.sin(x[3])])
    q_perp = np.array([-q[1], q[0]])
    h, dh = r @ r - radius**2, 2 * v * (r @ q)
    A = -np.array([2 * (r @ q) / mass, 2 * v * (r @ q_perp)])
    return h, dh, A, k1 * dh + k2 * h + 2 * v**2, np.array([2 * (r @ q)])


def test_blimp_rows_match_the_closed_form(blimp: ControlAffineModel) -> None:
    obstacles = [(CENTER, RADIUS), (np.array([-1.0, 2.0, 0.0]), 0.7)]
    gains = [K, (3.0, 2.0)]
    barriers = BarrierSet(
        blimp,
        [
            SphereObstacle(center, radius).barrier(k)
            for (center, radius), k in zip(obstacles, gains, strict=True)
        ],
    )
    generator = np.random.default_rng(1)
    for _ in range(50):
        x = generator.normal(size=8)
        rows = barriers.rows(x, generator.uniform(0.0, 10.0))
        for i, ((center, radius), k) in enumerate(zip(obstacles, gains, strict=True)):
            h, dh, A, b, w, A_x, b_x, w_x = blimp_row(x, center, radius, *k)
            close = {"rtol": 1e-9, "atol": 1e-11}
            assert_allclose(rows.value[i], h, **close)
            assert_allclose(rows.A[i], A, **close)
            assert_allclose(rows.b[i], b, **close)
            assert_allclose(rows.w[i], w, **close)
            assert_allclose(row_gradients(rows).A[i, :, :8], A_x, **close)
            assert_allclose(row_gradients(rows).b[i, :8], b_x, **close)
            assert_allclose(row_gradients(rows).w[i, :, :8], w_x, **close)
            # The largest root goes first into phi^1 (R21).
            largest = (k[0] + np.sqrt(k[0] ** 2 - 4 * k[1])) / 2
            assert_allclose(rows.chain[i], [h, dh + largest * h], **close)
        # Nothing moves, so nothing depends on the time itself.
        assert not row_gradients(rows).A[:, :, 8].any()
        assert not row_gradients(rows).b[:, 8].any()
        assert not row_gradients(rows).w[:, :, 8].any()


def test_car_rows_match_the_closed_form(car: ControlAffineModel) -> None:
    obstacle = SphereObstacle([2.0, 0.3], 0.4, form="squared", margin=0.1)
    barriers = BarrierSet(car, [obstacle.barrier((4.0, 3.0))])
    generator = np.random.default_rng(2)
    for _ in range(50):
        x = generator.normal(size=4)
        rows = barriers.rows(x, 0.0)
        h, dh, A, b, w = car_row(x, [2.0, 0.3], 0.5, 4.0, 3.0, mass=1.7)
        assert_allclose(rows.A[0], A, rtol=1e-9, atol=1e-12)
        assert_allclose(rows.b[0], b, rtol=1e-9, atol=1e-12)
        assert_allclose(rows.w[0], w, rtol=1e-9, atol=1e-12)
        assert_allclose(rows.chain[0], [h, dh + 3.0 * h], rtol=1e-9, atol=1e-12)


def test_a_barrier_is_written_with_numpy(blimp: ControlAffineModel) -> None:
    def clearance(x, t, p):
        return np.linalg.norm(x[:3] - p[:3]) - p[3]

    written = Barrier(clearance, K, [*CENTER, RADIUS])
    obstacle = SphereObstacle(CENTER, RADIUS).barrier(K)
    x = np.random.default_rng(6).normal(size=8)
    rows = BarrierSet(blimp, [written, obstacle]).rows(x, 0.0)
    for array in (rows.A, rows.b, rows.w, row_gradients(rows).A, row_gradients(rows).b):
        assert_allclose(array[0], array[1], rtol=1e-12, atol=1e-12)


def test_values_agree_with_rows(blimp: ControlAffineModel) -> None:
    barriers = BarrierSet(
        blimp,
        [
            SphereObstacle(CENTER, RADIUS).barrier(K, name="standing"),
            SphereObstacle(CENTER, RADIUS, [0.1, 0.0, -0.2]).barrier(K, name="moving"),
            StateInputLimit(
                lambda x, t, p: (np.array([1.0, 0, 0]), x[0]), name="limit"
            ),
        ],
    )
    assert barriers.size == 3
    assert barriers.names == ("standing", "moving", "limit")
    generator = np.random.default_rng(3)
    x, t = generator.normal(size=(7, 8)), generator.uniform(0.0, 5.0, size=7)
    along = barriers.values_along(x, t)
    assert along.shape == (7, 3)
    for i in range(7):
        assert_allclose(barriers.values(x[i], t[i]), along[i], rtol=0, atol=0)
        assert_allclose(barriers.rows(x[i], t[i]).value, along[i], rtol=1e-14)
        offset = x[i, :3] - CENTER
        moved = offset - np.array([0.1, 0.0, -0.2]) * t[i]
        assert along[i, 0] == pytest.approx(np.linalg.norm(offset) - RADIUS)
        assert along[i, 1] == pytest.approx(np.linalg.norm(moved) - RADIUS)
        assert np.isnan(along[i, 2])


def test_barriers_of_different_relative_degree_stack(car: ControlAffineModel) -> None:
    speed = Barrier(lambda x, t, p: p[0] - x[2], [2.0], [1.5], name="speed")
    obstacle = SphereObstacle([2.0, 0.0], 0.4).barrier((4.0, 3.0))
    limit = StateInputLimit(lambda x, t, p: (np.array([0.0, 1.0]), p[0] * x[2]), [3.0])
    rows = BarrierSet(car, [limit, speed, obstacle]).rows(np.array([0, 0, 1.0, 0]), 0.0)
    assert [len(chain) for chain in rows.chain] == [0, 1, 2]
    assert np.isnan(rows.value[0])
    # dv/dt = a / m, so the row is a / m <= 2 (1.5 - v).
    assert_allclose(rows.A[1], [1 / 1.7, 0.0])
    assert rows.b[1] == pytest.approx(2.0 * 0.5)
    assert_allclose(rows.w[1], [-1.0])
    assert_allclose(rows.A[0], [0.0, 1.0])
    assert rows.b[0] == pytest.approx(3.0)
    assert rows.value[2] == pytest.approx(1.6)


def test_an_empty_set_has_empty_rows(blimp: ControlAffineModel) -> None:
    barriers = BarrierSet(blimp, [])
    rows = barriers.rows(np.zeros(8), 0.0)
    assert rows.A.shape == (0, 3)
    assert rows.b.shape == (0,)
    assert rows.w.shape == (0, 3)
    assert row_gradients(rows).A.shape == (0, 3, 9)
    assert row_gradients(rows).b.shape == (0, 9)
    assert row_gradients(rows).w.shape == (0, 3, 9)
    assert rows.chain == ()
    assert barriers.values(np.zeros(8), 0.0).shape == (0,)
    assert barriers.values_along(np.zeros((4, 8)), np.zeros(4)).shape == (4, 0)


def test_rows_cannot_be_changed(blimp: ControlAffineModel) -> None:
    rows = BarrierSet(blimp, [SphereObstacle(CENTER, RADIUS).barrier(K)]).rows(
        np.zeros(8), 0.0
    )
    for array in (rows.value, rows.A, rows.b, row_gradients(rows).b, rows.chain[0]):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_singular_points_give_nan_rows_beside_good_ones(
    blimp: ControlAffineModel,
) -> None:
    barriers = BarrierSet(
        blimp,
        [
            SphereObstacle(CENTER, RADIUS).barrier(K, name="centre"),
            SphereObstacle(CENTER + 1.0, RADIUS).barrier(K, name="elsewhere"),
            Barrier(lambda x, t, p: np.log(x[6]), [1.0], name="logarithm"),
            Barrier(lambda x, t, p: np.exp(x[6]), [1.0], name="overflow"),
            Barrier(lambda x, t, p: x[6] ** 1.3, [1.0], name="power"),
        ],
    )
    x = np.array([*CENTER, 0.0, 0.0, 0.0, 0.0, 0.0])
    for speed, good in ((-1.0, [1, 3]), (1000.0, [1, 2, 4])):
        x[6] = speed
        rows = barriers.rows(x, 0.0)
        assert list(np.flatnonzero(np.isfinite(rows.b))) == good
        finite = [np.isfinite(a).all() for a in row_gradients(rows).b]
        assert list(np.flatnonzero(finite)) == good
        values = barriers.values(x, 0.0)
        assert list(np.flatnonzero(np.isfinite(values))) == [0, *good]
    # h itself is no root of a negative number at the centre.
    assert barriers.values(x, 0.0)[0] == pytest.approx(-RADIUS)
    for bad in (np.nan, np.inf):
        rows = barriers.rows(np.full(8, bad), 0.0)
        assert not np.isfinite(rows.b).any()


def test_rows_without_authority_are_found(blimp: ControlAffineModel) -> None:
    # Abeam of the obstacle at its altitude neither surge nor heave moves h (R33).
    barriers = BarrierSet(
        blimp,
        [
            SphereObstacle([0.0, 2.0, 0.0], 0.3).barrier(K, name="abeam"),
            SphereObstacle([2.0, 0.0, 0.0], 0.3).barrier(K, name="ahead"),
        ],
    )
    rows = barriers.rows(np.zeros(8), 0.0)
    scale = np.array([0.1, 0.2, 0.01])
    m_x = BlimpParameters().effective_masses[0]
    assert_allclose(rows.authority(scale), [0.0, 0.1 / m_x], atol=1e-12)
    weak, strong = rows.authority(scale)
    assert weak <= 1e-6 < strong < 10.0


def test_one_formula_compiles_once() -> None:
    def functions(mass: float, center: list[float], gains: list[float]):
        model = ControlAffineModel.from_system(Car(CarParameters(mass=mass)))
        barriers = [SphereObstacle(center, 0.3).barrier(gains)] * 2
        return [
            (each.row, each.gradient, each.value)
            for each in BarrierSet(model, barriers).functions_at(0.0)
        ]

    first, second = functions(1.234, [1.0, 2.0], [4.0, 3.0])
    assert first == second == functions(1.234, [-1.0, 0.0], [5.0, 6.0])[0]
    assert set(first).isdisjoint(functions(1.235, [1.0, 2.0], [4.0, 3.0])[0][:2])


def test_a_function_whose_globals_change_compiles_again(
    car: ControlAffineModel,
) -> None:
    limits = {"speed": 1.0}
    barrier = Barrier(lambda x, t, p: limits["speed"] - x[2], [1.0])
    assert BarrierSet(car, [barrier]).values(np.zeros(4), 0.0) == [1.0]
    limits["speed"] = 2.0
    assert BarrierSet(car, [barrier]).values(np.zeros(4), 0.0) == [2.0]


@pytest.mark.parametrize(
    ("gains", "rates"),
    [
        ([2.0], [2.0]),
        (K, [(10 + np.sqrt(100 - 4 * 3.55)) / 2, (10 - np.sqrt(100 - 4 * 3.55)) / 2]),
        ([0.2, 0.01], [0.1, 0.1]),
        ([6.0, 11.0, 6.0], [3.0, 2.0, 1.0]),
        ([3.0, 3.0, 1.0], [1.0, 1.0, 1.0]),
        ([2e-4, 1e-8], [1e-4, 1e-4]),
    ],
)
def test_decay_rates_come_largest_first(gains, rates) -> None:
    barrier = Barrier(lambda x, t, p: x[0], gains)
    assert barrier.relative_degree == len(gains)
    assert_allclose(barrier.decay_rates, rates, rtol=1e-4)


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ([], "give at least one gain"),
        ([1.0, 1.0], "must be real and positive"),
        ([-1.0], "must be real and positive"),
        ([1.0, 0.0], "must be real and positive"),
        ([0.0], "must be real and positive"),
        ([np.nan, 1.0], "finite"),
        ([[1.0]], r".*a flat list of finite numbers"),
    ],
)
def test_bad_gains_are_refused(gains, message) -> None:
    with pytest.raises(ValueError, match=f"barrier 'wall'.*{message}"):
        Barrier(lambda x, t, p: x[0], gains, name="wall")


def test_bad_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match=r"parameters of barrier 'wall': .* finite"):
        Barrier(lambda x, t, p: x[0], [1.0], [np.inf], name="wall")


def test_bad_states_are_refused(car: ControlAffineModel) -> None:
    barriers = BarrierSet(car, [SphereObstacle([1.0, 0.0], 0.3).barrier(K)])
    for bad in (np.zeros(3), np.zeros((4, 1)), 0.0):
        with pytest.raises(ValueError, match=r"expected a state of shape \(4,\)"):
            barriers.rows(bad, 0.0)
        with pytest.raises(ValueError, match=r"expected a state of shape \(4,\)"):
            barriers.values(bad, 0.0)
    with pytest.raises(ValueError, match=r"expected states of shape \(T, 4\)"):
        barriers.values_along(np.zeros((3, 4)), np.zeros(2))


def test_a_set_takes_barriers_and_limits_only(car: ControlAffineModel) -> None:
    with pytest.raises(
        ValueError, match=r"barriers\[0\].*a Barrier or a StateInputLimit"
    ):
        BarrierSet(car, [SphereObstacle([1.0, 0.0], 0.3)])


def test_repeated_evaluation_is_bit_for_bit_the_same(blimp: ControlAffineModel) -> None:
    barriers = BarrierSet(blimp, [SphereObstacle(CENTER, RADIUS).barrier(K)] * 2)
    x = np.random.default_rng(5).normal(size=(2, 8))
    first = barriers.rows(x[0], 0.3)
    barriers.rows(x[1], 0.4)
    again = barriers.rows(x[0], 0.3)
    assert row_gradients(first).b.tobytes() == row_gradients(again).b.tobytes()
    assert first.A[0].tobytes() == first.A[1].tobytes()


def test_parameters_may_also_be_written_into_the_function(
    car: ControlAffineModel,
) -> None:
    def wall(x, t, p):
        return Expression(3.0) - x[0]

    rows = BarrierSet(car, [Barrier(wall, (3.0, 2.0))]).rows(np.zeros(4), 0.0)
    assert rows.value == [3.0]
    assert rows.b == pytest.approx([6.0])


def test_a_function_without_derivatives_is_refused_with_its_name() -> None:
    model = ControlAffineModel.from_system(Blimp())
    kinked = Barrier(lambda x, t, p: abs(x[0]) - 1.0, [4.0, 3.0], name="kinked")
    with pytest.raises(ModelError, match=r"barrier 'kinked': .*without abs"):
        BarrierSet(model, [kinked])
