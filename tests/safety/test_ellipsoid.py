from concurrent.futures import ThreadPoolExecutor
import math

from mpmath import mp
import numpy as np
from pydrake.geometry.optimization import HPolyhedron
import pytest

from vcbf_drake.errors import EmptySetError, SolverError, UnboundedSetError, VcbfError
from vcbf_drake.safety import ellipsoid
from vcbf_drake.safety.ellipsoid import inscribed_ellipsoid
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.programs import EllipsoidProgram
from vcbf_drake.safety.volume import VolumeMeasure

UNIT_BALL = {1: 2.0, 2: math.pi, 3: 4.0 * math.pi / 3.0, 4: math.pi**2 / 2.0}


def box_rows(m):
    return np.vstack([np.eye(m), -np.eye(m)])


def random_polytope(rng, m, num_rows=8):
    """A bounded set of about unit size around the origin, rows of any length."""
    A = np.vstack([box_rows(m), rng.standard_normal((num_rows, m))])
    return A, rng.uniform(0.05, 1.0, len(A)) * np.linalg.norm(A, axis=1)


def hard_polytope(rng):
    """An affine image of a harmless polytope: the polytope, its image and log |det|.

    Slabs down to 1e-6, sizes from 1e-6 to 1e3, rows given twice, rows scaled by 1e-6 to
    1e6, off the origin: each with even odds.
    """
    m = int(rng.integers(2, 5))
    A, b = random_polytope(rng, m, int(rng.integers(0, 12)))
    if rng.random() < 0.5:
        again = rng.integers(len(b), size=3)
        A, b = np.vstack([A, A[again]]), np.append(b, b[again])
    slab, size = 10.0 ** rng.uniform([-6.0, -6.0], [0.0, 3.0])
    slab, size = (x if rng.random() < 0.5 else 1.0 for x in (slab, size))
    rotation = np.linalg.qr(rng.standard_normal((m, m)))[0]
    stretch = np.ones(m)
    stretch[: rng.integers(1, m)] = slab
    image = A @ (rotation / (size * stretch)) @ rotation.T
    if rng.random() < 0.5:
        length = 10.0 ** rng.uniform(-6.0, 6.0, len(b))
        image, b_image = image * length[:, None], b * length
    else:
        b_image = b
    if rng.random() < 0.5:
        b_image = b_image + image @ rng.standard_normal(m) * size
    return (A, b), (image, b_image), m * math.log(size) + np.log(stretch).sum()


def exact_bounds(A, b, e):
    """Bounds of the optimal log det B in 40 digits: an ellipsoid inside, weak duality.

    From below: log det of the ellipsoid, scaled to touch. From above, for multipliers
    with A'y = 0 and M = sum y_i B a_i a_i' / |B a_i|: every ellipsoid (B*, c*) inside
    has y'b >= sum y_i |B* a_i| >= tr(B* M) >= m (det B* det M)^(1/m), M symmetrised.
    """
    with mp.workdps(40):
        touching = np.flatnonzero(e.multipliers)
        n, m = A.shape
        B, c = mp.matrix(e.shape.tolist()), mp.matrix(e.center.tolist())
        scale = mp.inf
        reach = {}
        for i in range(n):
            a = mp.matrix(A[i].tolist())
            Ba = B * a
            length = mp.norm(Ba)
            if length > 0:
                scale = min(scale, (mp.mpf(float(b[i])) - mp.fdot(a, c)) / length)
            reach[i] = a, Ba, length
        lower = mp.log(mp.det(B)) + m * mp.log(scale)
        # Project on A'y = 0, moving each multiplier in proportion to itself, in the
        # coordinates in which the ellipsoid is a ball.
        y = {i: mp.mpf(float(e.multipliers[i])) * reach[i][2] for i in touching}
        gram, error = mp.zeros(m), mp.zeros(m, 1)
        for i in touching:
            unit = reach[i][1] / reach[i][2]
            gram += y[i] * unit * unit.T
            error += y[i] * unit
        shift = mp.lu_solve(gram, error)
        M, total = mp.zeros(m), mp.mpf(0)
        for i in touching:
            a, Ba, length = reach[i]
            unit = Ba / length
            weight = y[i] * (1 - mp.fdot(unit, shift)) / length
            assert weight > 0
            M += weight * Ba * a.T / length
            total += weight * mp.mpf(float(b[i]))
        det = mp.det((M + M.T) / 2)
        upper = m * mp.log(total / m) - mp.log(det)
        return float(lower - e.log_det), float(upper - e.log_det)


def conditions(A, b, e):
    """Violations of (E48) and (E56), in the coordinates of the ellipsoid itself."""
    reach = A @ e.shape
    length = np.linalg.norm(reach, axis=1)
    n, w = reach / length[:, None], e.multipliers * length
    slack = (b - A @ e.center) / length - 1.0
    return (
        -slack.min(),
        np.abs((n.T * w) @ n - np.eye(A.shape[1])).max(),
        np.abs(w @ n).max(),
        np.abs(w * slack).max(),
        -w.min(),
    )


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_box(m):
    widths = 10.0 ** np.linspace(-4.0, 2.0, m)
    e = inscribed_ellipsoid(box_rows(m), np.append(2.0 * widths, 0.0 * widths))
    np.testing.assert_allclose(e.center, widths, rtol=1e-9)
    np.testing.assert_allclose(e.shape, np.diag(widths), rtol=1e-9, atol=1e-16)
    assert e.log_det == pytest.approx(np.log(widths).sum(), abs=1e-9)
    np.testing.assert_allclose(e.multipliers, np.tile(0.5 / widths, 2), rtol=1e-8)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_simplex(m):
    """The largest ellipsoid of an affine image of a regular simplex, in closed form."""
    rng = np.random.default_rng(m)
    # A regular simplex of inradius 1: m + 1 unit normals with sum zero.
    normals = np.linalg.svd(np.ones((1, m + 1)))[2][1:].T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    T, o = rng.standard_normal((m, m)), rng.standard_normal(m)
    A = normals @ np.linalg.inv(T)
    e = inscribed_ellipsoid(A, 1.0 + A @ o)
    np.testing.assert_allclose(e.center, o, atol=1e-9)
    np.testing.assert_allclose(e.shape @ e.shape, T @ T.T, atol=1e-9)
    assert e.log_det == pytest.approx(np.log(abs(np.linalg.det(T))), abs=1e-9)
    # lambda_i |B a_i| = m / (m + 1) for every face.
    np.testing.assert_allclose(e.multipliers, m / (m + 1), rtol=1e-8)


@pytest.mark.parametrize("m", [2, 3, 4])
def test_agrees_with_drake(m):
    rng = np.random.default_rng(10 + m)
    for _ in range(20):
        A, b = random_polytope(rng, m)
        e = inscribed_ellipsoid(A, b)
        oracle = HPolyhedron(A, b).MaximumVolumeInscribedEllipsoid()
        volume = UNIT_BALL[m] * math.exp(e.log_det)
        assert volume == pytest.approx(oracle.CalcVolume(), rel=1e-5)
        np.testing.assert_allclose(e.center, oracle.center(), atol=1e-4)


@pytest.mark.parametrize("m", [2, 3, 4])
def test_optimality_conditions(m):
    rng = np.random.default_rng(20 + m)
    for _ in range(40):
        A, b = random_polytope(rng, m)
        e = inscribed_ellipsoid(A, b)
        np.testing.assert_array_equal(e.shape, e.shape.T)
        assert max(conditions(A, b, e)) < 1e-8
        # Contact points lie on the rows that touch, at B times a unit vector.
        touching = e.multipliers > 0.0
        contacts = e.contact_points(A)
        on_row = np.sum(A * contacts, axis=1) - b
        assert np.abs(on_row[touching]).max() < 1e-9
        v = np.linalg.solve(e.shape, (contacts - e.center).T)
        np.testing.assert_allclose(np.linalg.norm(v, axis=0), 1.0, rtol=1e-9)


def test_never_wrong_on_hard_polytopes():
    """600 polytopes: the volume exact to 1e-7, by two oracles, or an honest error."""
    rng = np.random.default_rng(2024)
    refused = 0
    for _ in range(600):
        (A, b), (image, b_image), log_det = hard_polytope(rng)
        try:
            e = inscribed_ellipsoid(image, b_image)
        except SolverError:
            refused += 1
            continue
        lower, upper = exact_bounds(image, b_image, e)
        assert -1e-7 < lower <= upper < 1e-7
        assert -e.certified_gap <= lower and upper <= e.certified_gap <= 1e-7
        original = inscribed_ellipsoid(A, b).log_det
        assert e.log_det == pytest.approx(original + log_det, abs=1e-7)
        assert (e.multipliers >= 0.0).all()
    assert refused == 0


def test_volume_is_exact_in_forty_digits():
    rng = np.random.default_rng(6)
    for _ in range(60):
        _, (A, b), _ = hard_polytope(rng)
        e = inscribed_ellipsoid(A, b)
        lower, upper = exact_bounds(A, b, e)
        assert -e.certified_gap <= lower <= upper <= e.certified_gap <= 1e-7


@pytest.mark.parametrize("scale", [1.0, 1e-2, 1e-5])
def test_gradient_against_central_differences(scale):
    """Where a facet starts or stops to touch in between, the differences disagree."""
    rng = np.random.default_rng(5)
    compared = 0
    for _ in range(60):
        m = int(rng.integers(2, 5))
        A, b = random_polytope(rng, m)
        b = b * scale
        e = inscribed_ellipsoid(A, b)
        dA, db = rng.standard_normal(A.shape), rng.standard_normal(len(b)) * scale
        # (E57): the envelope theorem, at the contact points.
        slope = e.multipliers @ (db - np.sum(dA * e.contact_points(A), axis=1))

        def difference(h, A=A, b=b, dA=dA, db=db):
            ends = [
                inscribed_ellipsoid(A + s * h * dA, b + s * h * db) for s in (1, -1)
            ]
            return (ends[0].log_det - ends[1].log_det) / (2.0 * h)

        coarse, fine = difference(2e-4), difference(1e-4)
        extrapolated = fine + (fine - coarse) / 3.0
        size, spread = np.abs(e.multipliers * b).sum(), abs(fine - coarse)
        if spread < 1e-5 * size:
            compared += 1
            assert slope == pytest.approx(extrapolated, abs=spread + 1e-7 * size)
    assert compared > 40


def test_gradient_of_interval():
    A = np.array([[2.0], [-0.5], [0.1]])
    e = inscribed_ellipsoid(A, [2.0, 1.0, 9.0])  # [-2, 1]
    # Of its length 3, half of which is det B: d(length)/db and d(length)/dA.
    slopes = 3.0 * e.multipliers
    np.testing.assert_allclose(slopes, [0.5, 2.0, 0.0])
    by_row = -slopes * e.contact_points(A)[:, 0]
    np.testing.assert_allclose(by_row, [-0.5, 4.0, 0.0])


def test_rows_given_twice_share_their_multiplier():
    A = np.vstack([box_rows(2), [1.0, 0.0]])
    e = inscribed_ellipsoid(A, np.ones(5))
    np.testing.assert_allclose(e.multipliers, [0.25, 0.5, 0.5, 0.5, 0.25], atol=1e-6)
    assert e.log_det == pytest.approx(0.0, abs=1e-9)


def test_rows_of_zeros():
    A = np.vstack([box_rows(2), np.zeros(2)])
    e = inscribed_ellipsoid(A, [1.0, 1.0, 1.0, 1.0, 0.0])
    assert e.multipliers[4] == 0.0 and e.log_det == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(e.contact_points(A)[4], e.center)
    with pytest.raises(EmptySetError) as raised:
        inscribed_ellipsoid(A, [1.0, 1.0, 1.0, 1.0, -1.0])
    assert raised.value.inradius == -np.inf


def test_rows_far_away_change_nothing():
    A, b = random_polytope(np.random.default_rng(0), 3)
    e = inscribed_ellipsoid(A, b)
    far = inscribed_ellipsoid(np.vstack([A, np.eye(3)]), np.append(b, [1e4, 1e9, 1e15]))
    assert far.log_det == pytest.approx(e.log_det, abs=1e-10)
    np.testing.assert_array_equal(far.multipliers[-3:], 0.0)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_empty_sets_raise(m):
    rng = np.random.default_rng(40 + m)
    for gap in 10.0 ** np.linspace(-8.0, 0.0, 30):
        A, b = random_polytope(rng, m)
        i = rng.integers(len(b))
        b = np.append(b, -b[i] - gap * np.linalg.norm(A[i]))
        A = np.vstack([A, -A[i]])
        with pytest.raises(EmptySetError) as raised:
            inscribed_ellipsoid(A, b)
        assert raised.value.inradius <= -0.5 * gap * (1.0 - 1e-6)
        np.testing.assert_array_equal(raised.value.A, A)


def test_flat_sets_have_no_ellipsoid():
    A = np.vstack([box_rows(2), [-1.0, 0.0]])
    with pytest.raises(EmptySetError, match="Chebyshev radius"):
        inscribed_ellipsoid(A, [1.0, 1.0, 1.0, 1.0, -1.0])


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_unbounded_sets_raise(m):
    rng = np.random.default_rng(50 + m)
    for _ in range(30):
        A = random_polytope(rng, m)[0]
        ray = rng.standard_normal(m)
        A *= -np.sign(A @ ray)[:, None]
        if rng.random() < 0.5 and m > 1:  # A prism: bounded across, without an end.
            A = np.vstack([A, -A]) - np.outer(np.vstack([A, -A]) @ ray, ray) / (
                ray @ ray
            )
        with pytest.raises(UnboundedSetError) as raised:
            inscribed_ellipsoid(A, rng.uniform(0.1, 1.0, len(A)))
        d = raised.value.direction
        assert np.linalg.norm(d) == pytest.approx(1.0)
        assert np.max(A @ d) < 1e-9


@pytest.mark.parametrize(
    ("A", "b"),
    [
        (np.eye(2), np.ones(3)),
        (np.ones(2), np.ones(2)),
        (np.eye(2) * np.nan, np.ones(2)),
        (np.eye(2), [np.inf, 1.0]),
    ],
)
def test_malformed_rows_are_refused(A, b):
    with pytest.raises(ValueError, match="must be"):
        inscribed_ellipsoid(A, b)


def test_what_cannot_be_certified_is_not_returned():
    """So flat that the rounding of its rows exceeds what is accepted."""
    A, b = np.vstack([box_rows(2), [0.6, 0.8]]), np.array([1.0, 1e-10] * 2 + [0.3])
    with pytest.raises(SolverError, match="certified") as raised:
        inscribed_ellipsoid(A, b)
    np.testing.assert_array_equal(raised.value.b, b)


@pytest.mark.parametrize("m", [2, 3, 4])
def test_the_certificate_bounds_what_is_missing(m):
    """Of ellipsoids and multipliers that are off by a little, in their coordinates."""
    rng = np.random.default_rng(90 + m)
    bounded = 0
    for size in np.repeat(10.0 ** np.arange(-8.0, -1.0), 20):
        A, b = random_polytope(rng, m)
        best = inscribed_ellipsoid(A, b)
        frame = best.shape @ (np.eye(m) + size * rng.normal(size=(m, m)))
        center = best.center + size * best.shape @ rng.normal(size=m)
        normals = A @ frame
        length = np.linalg.norm(normals, axis=1)
        excess = (b - A @ center) / length - 1.0
        weights = best.multipliers * length
        weights *= 1.0 + size * rng.normal(size=len(b))
        bound = ellipsoid._gap(
            normals / length[:, None], excess, np.maximum(weights, 0.0)
        )
        inside = math.log(abs(np.linalg.det(frame))) + m * math.log1p(excess.min())
        missing = best.log_det - inside
        assert bound >= missing - 1e-9 * (1.0 + missing)
        if size <= 1e-4:  # And it is not much more than that.
            assert bound <= 1e3 * m * size
            bounded += 1
    assert bounded == 100


@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_certificate_of_a_cube_is_never_below_its_error(m):
    """The unit ball is the largest: nothing is missing, whatever the multipliers."""
    n = box_rows(m)
    for error in np.linspace(-0.25, 0.04, 30):
        bound = ellipsoid._gap(n, np.zeros(2 * m), np.full(2 * m, 0.5 + 0.5 * error))
        assert 0.0 <= bound < 0.5 * m * error * error + 1e-15 or bound == math.inf
    exact = ellipsoid._gap(n, np.zeros(2 * m), np.full(2 * m, 0.5))
    assert exact == 0.0


@pytest.mark.parametrize("m", [2, 3, 4, 5])
def test_the_cone_program_proposes_the_multipliers_too(m):
    rng = np.random.default_rng(80 + m)
    for _ in range(10):
        A, b = random_polytope(rng, m)
        center, L, multipliers = EllipsoidProgram(len(b), m, 1e-10).solve(A, b)
        e = inscribed_ellipsoid(A, b)
        np.testing.assert_allclose(center, e.center, atol=1e-5)
        np.testing.assert_allclose(L @ L.T, e.shape @ e.shape, atol=1e-5)
        scale = e.multipliers.max()
        np.testing.assert_allclose(multipliers, e.multipliers, atol=1e-3 * scale)


def as_bytes(e):
    return b"".join(
        np.asarray(x).tobytes()
        for x in (e.center, e.shape, e.log_det, e.multipliers, e.certified_gap)
    )


def test_answers_do_not_depend_on_history_or_threads():
    rng = np.random.default_rng(0)
    sets = [random_polytope(rng, 3) for _ in range(12)]
    solver = VolumeMeasure(InputSet.box(-np.ones(3), np.ones(3)))
    A, b = zip(*sets, strict=True)
    for solve in (inscribed_ellipsoid, solver.largest):
        first = [as_bytes(e) for e in map(solve, A, b)]
        backwards = [as_bytes(e) for e in map(solve, A[::-1], b[::-1])]
        assert backwards == first[::-1]
        with ThreadPoolExecutor(4) as pool:
            assert [as_bytes(e) for e in pool.map(solve, A * 4, b * 4)] == first * 4


# The solver for input sets cut by a few rows.


def cut_rows(rng, m, num_rows):
    """Rows through the box, of any length, with some inputs in none of them."""
    A = rng.standard_normal((num_rows, m)) * 10.0 ** rng.uniform(-3, 3, (num_rows, 1))
    A[:, rng.random(m) < 0.3] = 0.0
    inside = rng.uniform(-0.9, 0.9, m)
    margin = rng.uniform(0.02, 2.0, num_rows) * np.linalg.norm(A, axis=1)
    return A, A @ inside + margin


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_cut_box_agrees_with_all_rows_at_once(m):
    rng = np.random.default_rng(60 + m)
    solver = VolumeMeasure(InputSet.box(-2.0 * np.ones(m), np.ones(m)))
    for _ in range(60):
        A, b = cut_rows(rng, m, int(rng.integers(0, 6)))
        e = solver.largest(A, b)
        rows, bounds = np.vstack([box_rows(m), A]), np.append(np.ones(2 * m), b)
        oracle = inscribed_ellipsoid(rows, bounds)
        assert e.log_det == pytest.approx(oracle.log_det, abs=1e-8)
        np.testing.assert_allclose(e.shape, oracle.shape, atol=1e-7)
        np.testing.assert_allclose(e.center, oracle.center, atol=1e-7)
        # Of a row of zeros (E56) says nothing.
        live = np.linalg.norm(rows, axis=1) > 0.0
        assert (e.multipliers[~live] == 0.0).all()
        part = e._replace(multipliers=e.multipliers[live])
        assert max(conditions(rows[live], bounds[live], part)) < 1e-8
        lower, upper = exact_bounds(rows, bounds, e)
        assert -e.certified_gap - 1e-15 <= lower
        assert upper <= e.certified_gap + 1e-15 <= 1e-7


@pytest.mark.parametrize("m", [2, 3])
def test_cut_polytope_agrees_with_all_rows_at_once(m):
    rng = np.random.default_rng(70 + m)
    for _ in range(10):
        s = InputSet(*random_polytope(rng, m))
        solver = VolumeMeasure(s)
        for _ in range(8):
            A = rng.standard_normal((3, m))
            inside = (s.interior - s.center) / s.scale
            b = A @ inside + rng.uniform(0.05, 2.0, 3)
            e = solver.largest(A, b)
            rows = np.vstack([s.A_normalised, A])
            bounds = np.append(s.b_normalised, b)
            oracle = inscribed_ellipsoid(rows, bounds)
            assert e.log_det == pytest.approx(oracle.log_det, abs=1e-8)
            np.testing.assert_allclose(e.shape, oracle.shape, atol=1e-7)
            assert max(conditions(rows, bounds, e)) < 1e-8


def test_plateau_needs_no_solve():
    box = VolumeMeasure(InputSet.box([-5.0, 0.0], [5.0, 1.0]))
    triangle_rows = np.array([[1.0, 1.0], [-1.0, 1.0], [0.0, -1.0]]), np.ones(3)
    triangle = VolumeMeasure(InputSet(*triangle_rows))
    # The first row touches the unit ball, the second cuts a corner of the box only.
    e = box.largest(np.array([[3.0, 4.0], [1.0, 1.0]]), np.array([5.0, 1.5]))
    np.testing.assert_array_equal(e.shape, np.eye(2))
    np.testing.assert_array_equal(e.multipliers, [0.5, 0.5, 0.5, 0.5, 0.0, 0.0])
    assert e.log_det == 0.0 and e.frame is box.free.frame
    free = triangle.largest(np.zeros((0, 2)), np.zeros(0))
    e = triangle.largest(np.array([[0.0, 1.0]]), np.array([0.9]))
    assert e.frame is free.frame is triangle.free.frame
    np.testing.assert_array_equal(e.multipliers, [*free.multipliers, 0.0])


def test_gradient_leaves_the_plateau_continuously():
    """The volume is smooth where a row starts to cut the ball."""
    solver = VolumeMeasure(InputSet.box(-np.ones(3), np.ones(3)))
    a = np.array([[0.6, 0.8, 0.0]])
    values = [solver.largest(a, np.array([1.0 - s])) for s in (0.0, 1e-6, 1e-4, 1e-2)]
    slopes = [e.multipliers[-1] for e in values]
    assert slopes[0] == 0.0
    np.testing.assert_allclose(
        slopes[1:3], np.array([1e-6, 1e-4]) * slopes[2] / 1e-4, 1e-3
    )
    assert (np.diff([e.log_det for e in values]) < 0.0).all()


def test_decoupled_input_is_an_axis():
    solver = VolumeMeasure(InputSet.box(-np.ones(3), np.ones(3)))
    e = solver.largest(np.array([[0.6, 0.0, 0.8]]), np.array([0.1]))
    np.testing.assert_array_equal(e.shape[1], [0.0, 1.0, 0.0])
    assert e.center[1] == 0.0 and e.multipliers[1] == e.multipliers[4] == 0.5


def test_a_row_beside_a_limit_of_the_box_spoils_nothing():
    """Rows of a quadrotor: of its thrust, just inside an input's own limit."""
    A = np.array(
        [
            [-237.65851, 34.789470, 530.54817, 0.0],
            [-448.07148, 1.8893882, 1305.4535, -4.3e-16],
            [-697.34375, 20.174653, 2046.2906, -4.3e-16],
            [-191.01538, 0.0, 0.0, 0.0],
            [191.01538, 0.0, 0.0, 0.0],
        ]
    )
    b = np.array([2.2206368, 349.31988, 1104.7898, 127.81446, 191.01054])
    box = np.vstack([np.eye(4), -np.eye(4)])
    drakes = HPolyhedron(
        np.vstack([box, A]), np.concatenate([np.ones(8), b])
    ).MaximumVolumeInscribedEllipsoid()
    found = VolumeMeasure(InputSet.box([-1.0] * 4, [1.0] * 4)).largest(A, b)
    assert found.certified_gap <= 1e-7
    assert found.log_det == pytest.approx(-np.linalg.slogdet(drakes.A())[1], abs=1e-5)


def test_cut_box_gradient_against_central_differences():
    rng = np.random.default_rng(8)
    solver = VolumeMeasure(InputSet.box(-np.ones(3), np.ones(3)))
    compared = 0
    for size in np.repeat([1.0, 1e-2, 1e-4], 30):
        A = rng.standard_normal((3, 3))
        A[:, 2] = 0.0
        b = A @ rng.uniform(-0.5, 0.5, 3) + size * rng.uniform(0.1, 1.0, 3)
        direction, db = rng.standard_normal((3, 2)), rng.standard_normal(3)
        dA = np.c_[direction, np.zeros(3)]  # The decoupled input stays decoupled.
        h = 1e-4 * size
        e = solver.largest(A, b)
        points = e.contact_points(A)
        slope = e.multipliers[6:] @ (db - np.sum(dA * points, axis=1))
        coarse, fine = (
            (
                solver.largest(A + k * h * dA, b + k * h * db).log_det
                - solver.largest(A - k * h * dA, b - k * h * db).log_det
            )
            / (2.0 * k * h)
            for k in (2.0, 1.0)
        )
        spread = abs(fine - coarse)
        if spread < 1e-4 / size:
            compared += 1
            extrapolated = fine + (fine - coarse) / 3.0
            assert slope == pytest.approx(extrapolated, abs=spread + 1e-6 / size)
    assert compared > 60


def test_cut_input_sets_that_vanish():
    solver = VolumeMeasure(InputSet.box(-np.ones(3), np.ones(3)))
    A = np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    for b in ([0.3, -0.5], [-4.0, 9.0], [0.3, -0.3], [0.3, -0.3 + 1e-9]):
        with pytest.raises(EmptySetError) as raised:
            solver.largest(A, np.array(b))
        assert raised.value.inradius < 1e-9
    with pytest.raises(EmptySetError):
        solver.largest(np.zeros((1, 3)), np.array([-1.0]))
    # Just before it vanishes it is still certified.
    e = solver.largest(A, np.array([0.3, -0.3 + 1e-6]))
    thickness = 0.5e-6 / math.sqrt(2.0)
    assert np.linalg.eigvalsh(e.shape)[0] == pytest.approx(thickness, rel=1e-7)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_cut_rows_that_are_not_finite_are_refused(bad):
    solver = VolumeMeasure(InputSet.box(-np.ones(2), np.ones(2)))
    A, b = np.array([[1.0, 0.5], [0.3, 1.0]]), np.array([0.1, 0.2])
    for place in ((0, 0), (1, 1)):
        rows = A.copy()
        rows[place] = bad
        with pytest.raises(ValueError, match=r"must be .*finite"):
            solver.largest(rows, b)
    if bad != np.inf:  # A row with b_i = inf cuts nothing.
        with pytest.raises(ValueError, match=r"must be .*finite"):
            solver.largest(A, np.array([0.1, bad]))


def test_failures_of_the_solver_are_honest(monkeypatch):
    monkeypatch.setattr(ellipsoid, "_gap", lambda *_: math.inf)
    solver = VolumeMeasure(InputSet.box(-np.ones(2), np.ones(2)))
    with pytest.raises(VcbfError, match="certified"):
        solver.largest(np.array([[1.0, 0.5], [-0.5, 1.0]]), np.array([0.1, 0.2]))
