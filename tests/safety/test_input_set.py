import numpy as np
import pytest
import quadprog

from vcbf_drake.errors import EmptySetError, UnboundedSetError
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.programs import NearestPointProgram

TRIANGLE = np.array([[1.0, 1.0], [-1.0, 1.0], [0.0, -1.0]]), np.ones(3)


def random_set(rng, m):
    scale = 10.0 ** rng.uniform(-3.0, 3.0, m)
    A = np.vstack([np.eye(m), -np.eye(m), rng.standard_normal((4, m))])
    b = rng.uniform(0.1, 1.0, len(A)) * np.linalg.norm(A, axis=1)
    A = A / scale
    return InputSet(A, b + A @ (scale * rng.standard_normal(m)))


def test_box():
    box = InputSet.box([-1.0, 2.0], [3.0, 2.5])
    assert box.is_box and box.num_inputs == 2
    np.testing.assert_array_equal(box.A, [[1, 0], [0, 1], [-1, 0], [0, -1]])
    np.testing.assert_array_equal(box.b, [3.0, 2.5, 1.0, -2.0])
    np.testing.assert_array_equal(box.center, [1.0, 2.25])
    np.testing.assert_array_equal(box.scale, [2.0, 0.25])
    np.testing.assert_array_equal(box.A_normalised, box.A)
    np.testing.assert_array_equal(box.b_normalised, np.ones(4))
    np.testing.assert_array_equal(box.project([9.0, 2.1]), [3.0, 2.1])
    np.testing.assert_array_equal(box.project([np.nan, 2.1]), [1.0, 2.25])
    assert box.contains([3.0, 2.5]) and not box.contains([3.0, 2.6])


def test_box_keeps_its_own_copy_of_the_bounds():
    lower, upper = np.zeros(1), np.ones(1)
    box = InputSet.box(lower, upper)
    upper[0] = 5.0
    assert box.project([4.0]) == 1.0


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        ([0.0, 2.0], [1.0, 1.0], "input 1 has lower bound 2 and upper bound 1"),
        ([np.nan], [1.0], "input 0 has lower bound nan"),
        ([-np.inf], [-np.inf], "input 0 has lower bound -inf and upper bound -inf"),
        ([0.0], [1.0, 2.0], r"lower has shape \(1,\) and upper \(2,\)"),
        ([], [], r"must be \(m,\) with m >= 1"),
    ],
)
def test_malformed_boxes_are_refused(lower, upper, message):
    with pytest.raises(ValueError, match=message):
        InputSet.box(lower, upper)


def test_triangle():
    # Vertices (0, 1), (2, -1), (-2, -1).
    triangle = InputSet(*TRIANGLE)
    assert not triangle.is_box
    np.testing.assert_allclose(triangle.center, [0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(triangle.scale, [2.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(triangle.A_normalised, axis=1), 1.0)


def test_rows_of_zeros_are_dropped():
    A, b = TRIANGLE
    assert len(InputSet(np.vstack([A, np.zeros(2)]), np.append(b, 0.0)).b) == 3
    with pytest.raises(EmptySetError):
        InputSet(np.vstack([A, np.zeros(2)]), np.append(b, -1.0))


def test_a_box_given_by_rows_is_the_same_set():
    box = InputSet.box([-1.0, 2.0], [3.0, 2.5])
    rows = InputSet(box.A, box.b)
    np.testing.assert_allclose(rows.center, box.center, rtol=1e-9)
    np.testing.assert_allclose(rows.scale, box.scale, rtol=1e-9)
    np.testing.assert_allclose(rows.A_normalised, box.A_normalised, atol=1e-9)
    np.testing.assert_allclose(rows.b_normalised, box.b_normalised, rtol=1e-9)
    for u in ([9.0, 2.1], [0.0, 0.0], [-8.0, 7.0]):
        np.testing.assert_allclose(rows.project(u), box.project(u), rtol=1e-8)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_normalised_rows_describe_the_same_set(m):
    rng = np.random.default_rng(m)
    for _ in range(20):
        s = random_set(rng, m)
        v = rng.uniform(-1.5, 1.5, (50, m))
        u = s.center + s.scale * v
        physical = (u @ s.A.T <= s.b).all(axis=1)
        normalised = (v @ s.A_normalised.T <= s.b_normalised).all(axis=1)
        np.testing.assert_array_equal(physical, normalised)
        # The bounding box holds the set, and no smaller one does.
        assert (np.abs(v[physical]) <= 1.0 + 1e-7).all()
        for side in (1.0, -1.0):
            for axis in np.eye(m):
                face = s.center + side * s.scale * axis * 0.999
                shifted = (
                    np.vstack([s.A, -side * axis]),
                    np.append(s.b, -side * axis @ face),
                )
                InputSet(*shifted)


def test_faulty_sets_are_refused():
    A, b = TRIANGLE
    with pytest.raises(EmptySetError) as empty:
        InputSet(np.vstack([A, [0.0, -1.0]]), np.append(b, -2.0))
    np.testing.assert_array_equal(empty.value.A, [*A, [0.0, -1.0]])
    np.testing.assert_array_equal(empty.value.b, [*b, -2.0])
    with pytest.raises(EmptySetError):  # Flat, along no input.
        InputSet(np.vstack([np.eye(2), -np.eye(2), [[1, 1], [-1, -1]]]), [1] * 5 + [-1])
    with pytest.raises(UnboundedSetError) as raised:
        InputSet(A[:2], b[:2])
    assert np.all(A[:2] @ raised.value.direction <= 0.0)
    np.testing.assert_array_equal(raised.value.A, A[:2])
    np.testing.assert_array_equal(raised.value.b, b[:2])
    strip = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([1.0, 2.0])
    with pytest.raises(UnboundedSetError) as raised:  # Its inradius is finite.
        InputSet(*strip)
    np.testing.assert_array_equal(raised.value.A, strip[0])
    np.testing.assert_array_equal(raised.value.b, strip[1])
    with pytest.raises(ValueError, match="must be finite"):
        InputSet(A, b * np.nan)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_projection_is_the_nearest_point_in_normalised_inputs(m):
    rng = np.random.default_rng(30 + m)
    for _ in range(20):
        s = random_set(rng, m)
        for distance in (0.3, 3.0, 1e3):
            v = distance * rng.standard_normal(m)
            u = s.center + s.scale * v
            projected = s.project(u)
            assert s.contains(projected, 1e-9)
            oracle = quadprog.solve_qp(
                np.eye(m), v, -s.A_normalised.T, -s.b_normalised
            )[0]
            error = (projected - s.center) / s.scale - oracle
            assert np.abs(error).max() < 1e-6
            if s.contains(u, 0.0):
                np.testing.assert_array_equal(projected, u)


@pytest.mark.parametrize(
    "u", [[np.nan, 0.0], [np.inf, 1.0], [1e300, -1e300], [1e18, 3.0], [-1e9, -1e9]]
)
def test_any_projection_is_finite_and_inside(u):
    for s in (InputSet(*TRIANGLE), InputSet.box([-1.0, 2.0], [3.0, 2.5])):
        projected = s.project(u)
        assert np.isfinite(projected).all() and s.contains(projected, 1e-9)
        assert not s.contains(u)


@pytest.mark.parametrize("answer", [None, np.full(2, 5.0), np.full(2, np.nan)])
def test_projection_survives_a_solver_that_fails(monkeypatch, answer):
    s, far = InputSet(*TRIANGLE), [5.0, 5.0]
    expected = s.project(far)
    monkeypatch.setattr(NearestPointProgram, "solve", lambda *_: answer)
    np.testing.assert_allclose(s.project(far), expected, atol=1e-12)
