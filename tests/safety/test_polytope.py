import numpy as np
import pytest
from scipy.optimize import linprog

from vcbf_drake.errors import UnboundedSetError
from vcbf_drake.safety.polytope import (
    chebyshev_ball,
    emptiness_certificate,
    recession_direction,
)
from vcbf_drake.safety.programs import LinearProgram, NearestPointProgram

BOX = np.vstack([np.eye(2), -np.eye(2)])


def random_rows(rng, m, slab=1.0, size=1.0, num_rows=8):
    """Rows of a bounded set around a random point, stretched, of any length."""
    A = np.vstack([np.eye(m), -np.eye(m), rng.standard_normal((num_rows, m))])
    b = rng.uniform(0.1, 1.0, len(A)) * np.linalg.norm(A, axis=1)
    rotation = np.linalg.qr(rng.standard_normal((m, m)))[0]
    A = A @ (rotation / np.append(slab, np.ones(m - 1))) @ rotation.T / size
    b = b + A @ rng.standard_normal(m) * size
    length = 10.0 ** rng.uniform(-6.0, 6.0, len(A))
    return A * length[:, None], b * length


def distances(A, b, u):
    return (b - A @ u) / np.linalg.norm(A, axis=1)


def proof_errors(A, b, proof):
    """What of Farkas' conditions does not hold, in rows of unit length."""
    length = np.linalg.norm(A, axis=1)
    y = proof.multipliers * length
    y = y / y.sum()
    return np.abs(y @ (A / length[:, None])).max(), y @ (b / length), y.min()


def test_ball_of_box():
    center, radius = chebyshev_ball(BOX, [3.0, 1.0, 1.0, 1.0])
    assert radius == pytest.approx(1.0, abs=1e-15)
    assert np.min(distances(BOX, np.array([3.0, 1.0, 1.0, 1.0]), center)) == radius


def test_ball_of_triangle_is_its_incircle():
    # Legs 3 and 4, hypotenuse 5: the inradius is 1, at (1, 1).
    center, radius = chebyshev_ball(
        [[-1.0, 0.0], [0.0, -2.0], [40.0, 30.0]], [0.0, 0.0, 120.0]
    )
    np.testing.assert_allclose(center, [1.0, 1.0], atol=1e-14)
    assert radius == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("m", [1, 2, 3, 5])
def test_ball_agrees_with_another_solver(m):
    rng = np.random.default_rng(m)
    for _ in range(20):
        A, b = random_rows(rng, m)
        center, radius = chebyshev_ball(A, b)
        length = np.linalg.norm(A, axis=1)
        unit, distance = A / length[:, None], b / length
        oracle = linprog(
            np.append(np.zeros(m), -1.0),
            A_ub=np.c_[unit, np.ones(len(b))],
            b_ub=distance,
            bounds=(None, None),
        )
        assert radius == pytest.approx(-oracle.fun, rel=1e-7)
        assert np.min(distances(A, b, center)) == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e6])
def test_ball_scales_with_the_set(scale):
    A, b = random_rows(np.random.default_rng(7), 3)
    center, radius = chebyshev_ball(A, b)
    scaled_center, scaled_radius = chebyshev_ball(A, b * scale)
    assert scaled_radius == pytest.approx(radius * scale, rel=1e-10)
    np.testing.assert_allclose(scaled_center, center * scale, rtol=1e-8)


def test_radius_of_empty_set_is_negative():
    # u <= 0 and u >= 1: the least worst violation is 1/2, halfway.
    center, radius = chebyshev_ball([[1.0], [-1.0]], [0.0, -1.0])
    assert radius == pytest.approx(-0.5, abs=1e-15)
    np.testing.assert_allclose(center, [0.5], atol=1e-15)


def test_rows_far_away_do_not_blur_the_ball():
    A = np.vstack([BOX, [[0.6, 0.8], [0.8, -0.6]]])
    center, radius = chebyshev_ball(A, [1.0, 1.0, 1.0, 1.0, 1e14, 1e9])
    assert radius == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(center, 0.0, atol=1e-12)


def test_ball_far_along_a_sharp_wedge():
    # |x| <= 1e-6 + 1e-5 y and y <= 10: the circle sits at the wide end, y = 10 - r.
    slope, half = 1e-5, 1e-6
    A = [[1.0, -slope], [-1.0, -slope], [0.0, 1.0]]
    center, radius = chebyshev_ball(A, [half, half, 10.0])
    exact = (half + slope * 10.0) / (np.hypot(1.0, slope) + slope)
    assert radius == pytest.approx(exact, rel=1e-9)
    np.testing.assert_allclose(center, [0.0, 10.0 - exact], atol=1e-9)


@pytest.mark.parametrize("angle", np.linspace(0.0, 6.0, 13))
def test_a_strip_that_begins_somewhere_has_a_largest_ball(angle):
    """It never ends, but its balls are no larger for that."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    center, radius = chebyshev_ball([across, -across, -along], [1.0, 3.0, 0.0])
    assert radius == pytest.approx(2.0)
    assert across @ center == pytest.approx(-1.0) and along @ center > 2.0 - 1e-9


def test_rows_of_zeros():
    A = np.vstack([BOX, np.zeros(2)])
    assert chebyshev_ball(A, [1.0, 1.0, 1.0, 1.0, 0.0])[1] == pytest.approx(1.0)
    assert chebyshev_ball(A, [1.0, 1.0, 1.0, 1.0, -1e-30])[1] == -np.inf
    assert emptiness_certificate(A, [1.0, 1.0, 1.0, 1.0, 0.0]) is None
    proof = emptiness_certificate(A, [1.0, 1.0, 1.0, 1.0, -1e-30])
    assert proof.conflict == (4,) and proof.inradius == -np.inf
    np.testing.assert_array_equal(proof.multipliers, [0.0, 0.0, 0.0, 0.0, 1.0])
    # So short that b_i / |a_i| overflows: no direction, but the sign of b_i speaks.
    A[4] = [1e-200, 0.0]
    assert chebyshev_ball(A, [1.0, 1.0, 1.0, 1.0, 1e200])[1] == pytest.approx(1.0)
    assert chebyshev_ball(A, [1.0, 1.0, 1.0, 1.0, -1e200])[1] == -np.inf


@pytest.mark.parametrize(
    ("A", "b"),
    [
        (np.zeros((0, 2)), np.zeros(0)),
        ([[1.0, 0.0]], [1.0]),
        ([[1.0, 0.0], [0.0, 1.0]], [-5.0, 3.0]),
        ([[1.0, 1e-6], [-1.0, 1e-6]], [0.0, 0.0]),  # A wedge, 2e-6 rad wide.
    ],
)
def test_balls_of_every_size_are_refused(A, b):
    with pytest.raises(UnboundedSetError) as raised:
        chebyshev_ball(A, b)
    assert np.all(np.asarray(A) @ raised.value.direction <= 0.0)
    assert emptiness_certificate(A, b) is None


def test_strip_has_a_ball_although_it_is_unbounded():
    radius = chebyshev_ball([[1.0, 0.0], [-2.0, 0.0]], [1.0, 2.0])[1]
    assert radius == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize(
    ("A", "b", "message"),
    [
        ([1.0, 2.0], [1.0], r"A: \[1.0, 2.0\]; it must be rows \(n, m\) of finite"),
        (np.zeros((2, 0)), np.zeros(2), r"A: \[\[\], \[\]\]; it must be .* m >= 1"),
        (BOX, [1.0, 2.0], r"b: \[1.0, 2.0\]; it must be finite, one a row of A"),
        (BOX * np.nan, np.ones(4), r"A: \[\[nan, .*; it must be .* finite numbers"),
        (BOX, [1.0, 1.0, np.inf, 1.0], r"b: .*inf, 1.0\]; it must be finite"),
    ],
)
def test_malformed_rows_are_refused(A, b, message):
    for function in (chebyshev_ball, emptiness_certificate):
        with pytest.raises(ValueError, match=message):
            function(A, b)


def test_conflict_is_named():
    # Rows 1 and 3 contradict each other by 1; the others are bystanders.
    A = [[1.0, 0.0], [0.0, 2.0], [-1.0, 0.0], [0.0, -3.0], [1.0, 1.0]]
    proof = emptiness_certificate(A, [1.0, 0.0, 1.0, -3.0, 9.0])
    assert proof.conflict == (1, 3)
    assert proof.inradius == pytest.approx(-0.5)
    np.testing.assert_allclose(proof.multipliers @ A, 0.0, atol=1e-15)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_emptiness_is_proved_down_to_narrow_gaps(m):
    """Every proof is checked by hand, and so is that its conflict is irreducible."""
    rng = np.random.default_rng(10 + m)
    for _ in range(60):
        slab, size = 10.0 ** rng.uniform([-6.0, -6.0], [0.0, 3.0])
        A, b = random_rows(rng, m, slab, size)
        gap = 10.0 ** rng.uniform(-8.0, 1.0)
        i = rng.integers(len(b))
        opposed = -3.0 * A[i]
        A = np.vstack([A, opposed])
        b = np.append(b, -3.0 * b[i] - gap * np.linalg.norm(opposed))
        proof = emptiness_certificate(A, b)
        imbalance, value, least = proof_errors(A, b, proof)
        assert imbalance < 1e-12 and value < -1e-9 and least >= 0.0
        assert proof.inradius == pytest.approx(value, rel=1e-4, abs=1e-12)
        # Between the two rows alone the violation is gap / 2; others make it worse.
        radius = chebyshev_ball(A, b)[1]
        assert radius <= -0.5 * gap * (1.0 - 1e-4)
        assert proof.inradius >= radius * (1.0 + 1e-6) - 1e-12
        assert len(proof.conflict) <= m + 1
        for row in proof.conflict:
            kept = [each for each in proof.conflict if each != row]
            assert emptiness_certificate(A[kept], b[kept]) is None


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_nonempty_sets_are_not_called_empty(m):
    rng = np.random.default_rng(20 + m)
    for _ in range(60):
        slab, size = 10.0 ** rng.uniform([-6.0, -6.0], [0.0, 3.0])
        A, b = random_rows(rng, m, slab, size)
        assert emptiness_certificate(A, b) is None
        assert chebyshev_ball(A, b)[1] > 0.0


@pytest.mark.parametrize(
    ("gap", "is_empty"), [(0.0, False), (1e-9, False), (4e-9, True)]
)
def test_flat_sets_are_not_empty(gap, is_empty):
    A, b = np.vstack([BOX, [-1.0, 0.0]]), np.array([1.0, 1.0, 1.0, 1.0, -1.0 - gap])
    assert (emptiness_certificate(A, b) is not None) == is_empty


def test_answers_do_not_depend_on_history():
    A, b = random_rows(np.random.default_rng(3), 3)
    first = chebyshev_ball(A, b)
    chebyshev_ball(*random_rows(np.random.default_rng(4), 3))
    again = chebyshev_ball(A, b)
    assert first[0].tobytes() == again[0].tobytes() and first[1] == again[1]


def test_recession_direction():
    rng = np.random.default_rng(0)
    assert recession_direction(BOX) is None
    assert recession_direction([[1.0, 1e-9], [-1.0, 1e-9], [0.0, -1.0]]) is None
    for m in (1, 2, 3, 4):
        A = random_rows(rng, m)[0]
        assert recession_direction(A) is None
        ray = rng.standard_normal(m)
        half = A * -np.sign(A @ ray)[:, None]
        for rows in (half, half[: max(1, m - 1)]):
            d = recession_direction(rows)
            assert np.linalg.norm(d) == pytest.approx(1.0)
            assert np.max(rows @ d / np.linalg.norm(rows, axis=1)) <= 1e-11


def test_recession_along_a_face():
    # The positive quadrant's strip: only e_2 never ends, and two rows contain it.
    d = recession_direction([[1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]])
    np.testing.assert_allclose(d, [0.0, 1.0], atol=1e-15)


@pytest.mark.parametrize("m", [2, 3, 4])
def test_recession_along_a_prism_is_exact(m):
    """Bounded across and at one end: one direction alone, met by every side."""
    rng = np.random.default_rng(60 + m)
    for _ in range(20):
        across = rng.normal(size=(3, m - 1))
        sides = np.c_[
            np.vstack([np.eye(m - 1), -np.eye(m - 1), across]), np.zeros(2 * m + 1)
        ]
        rotation = np.linalg.qr(rng.normal(size=(m, m)))[0]
        A = np.vstack([sides, -np.eye(m)[-1:]]) @ rotation.T
        A *= 10.0 ** rng.uniform(-3.0, 3.0, (len(A), 1))
        d = recession_direction(A)
        np.testing.assert_allclose(d, rotation[:, -1], atol=1e-11)


@pytest.mark.parametrize("exponent", range(-14, -7))
def test_rows_that_are_nearly_opposite_are_proven_empty(exponent: int) -> None:
    rng = np.random.default_rng(exponent + 20)
    for _ in range(20):
        a, turn = rng.normal(size=(2, 3))
        a /= np.linalg.norm(a)
        A = np.vstack([np.eye(3), -np.eye(3), a, -a + 10.0**exponent * turn])
        b = np.array([1.0] * 6 + [-0.3, rng.uniform(-0.3, 0.29)])
        proof = emptiness_certificate(A, b)
        assert proof is not None
        y = proof.multipliers
        assert y.min() >= 0.0
        # For every u in the box |y'A u| is at most the sum of |y'A|.
        assert y @ b + np.abs(y @ A).sum() < 0.0
        assert {6, 7} <= set(proof.conflict) and len(proof.conflict) <= 4


EMPTY = np.vstack([BOX, [-1.0, 0.0]]), np.array([1.0, 1.0, 1.0, 1.0, -2.0])


@pytest.mark.parametrize("answer", [None, np.full(3, 5.0)])
def test_a_solver_astray_changes_no_answer(monkeypatch, answer):
    """It gives up, or names a point outside."""
    monkeypatch.setattr(LinearProgram, "solve", lambda *_: answer)
    nearest = None if answer is None else answer[:2]
    monkeypatch.setattr(NearestPointProgram, "solve", lambda *_: nearest)
    assert chebyshev_ball(*EMPTY)[1] == pytest.approx(-0.5, abs=1e-15)
    assert emptiness_certificate(*EMPTY).conflict == (0, 4)
