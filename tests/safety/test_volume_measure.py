"""V_v, widened too, and its derivatives, by routes that share nothing with them."""

import math

import numpy as np
from pydrake.geometry.optimization import HPolyhedron
from pydrake.systems.analysis import Simulator
import pytest

from tests.helpers.volume_rate import volume_rate
from vcbf_drake import Blimp, ControlAffineModel, InputSet, SphereObstacle
from vcbf_drake.barriers import BarrierRows, BarrierSet
from vcbf_drake.safety import DisturbanceKnowledge, VolumeBarrier
from vcbf_drake.safety.qp import feasible_set
from vcbf_drake.safety.volume import VolumeMeasure
from vcbf_drake.simulation import load_scenario, make_loop, simulate

XI = 0.02
INPUTS = InputSet.box([-0.05, -0.2, -0.02], [0.25, 0.2, 0.02])
WIDENINGS = [1.0, 3.0]
# Towards the sphere, so that its row cuts the inputs from the start.
FAST = [0.0, 0.0, 0.1, 0.0, 0.15, 0.0, 0.1, 0.0]
EVERY_WIDENING = pytest.mark.parametrize("widening", WIDENINGS)


def log_det(A, b):
    """Drake's own largest ellipsoid."""
    ellipsoid = HPolyhedron(A, b).MaximumVolumeInscribedEllipsoid()
    return -math.log(np.linalg.det(ellipsoid.A()))


def expected(A, b, widening=1.0):
    """V_v of |v_j| <= widening with the rows, from its definition."""
    m = A.shape[1]
    A = np.vstack([np.eye(m), -np.eye(m), A])
    b = np.concatenate([np.full(2 * m, widening), b])
    return math.exp(log_det(A, b)) / widening**m - XI


def random_rows(rng, m):
    return rng.normal(size=(4, m)), rng.uniform(0.1, 3.0, 4)


def measured(A, b, widening=1.0, dA=0.0, db=0.0):
    """V_v of the unit box under rows that change with a state's first entry."""
    n, m = A.shape
    gradient = np.zeros((n, m + 2, 2))
    gradient[:, :m, 0], gradient[:, m, 0] = dA, db
    rows = BarrierRows(
        value=np.ones(n),
        chain=(),
        A=A,
        b=b,
        w=np.zeros((n, 1)),
        num_states=1,
        gradients=lambda rows: gradient[list(rows)],
    )
    box = InputSet.box(-np.ones(m), np.ones(m))
    feasible = feasible_set(box, rows, DisturbanceKnowledge.constant(1, 0.0))
    return VolumeMeasure(box, widening)(feasible).above(XI)


@EVERY_WIDENING
@pytest.mark.parametrize("m", [2, 3])
def test_value_and_derivative_by_the_rows(widening, m):
    rng, step = np.random.default_rng(m), 1e-5
    # The interior-point ellipsoid is known to 1e-8 or so, its differences to 1e-3.
    for _ in range(8):
        A, b = random_rows(rng, m)
        dA, db = rng.normal(size=A.shape), rng.normal(size=len(b))
        found = measured(A, b, widening, dA, db)
        assert found.value == pytest.approx(expected(A, b, widening), abs=1e-6)
        ahead, behind = (
            measured(A + h * dA, b + h * db, widening).value for h in (step, -step)
        )
        exact = found.state[0]
        assert exact == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-5)


def test_free_box_and_empty_set():
    free = measured(np.zeros((0, 3)), np.zeros(0)).value
    assert free == pytest.approx(expected(np.zeros((0, 3)), np.zeros(0)))
    moving = np.ones((1, 3)), np.ones(1)
    empty = measured(np.array([[1.0, 0.0, 0.0]]), np.array([-1.5]), 1.0, *moving)
    assert np.isfinite(empty.value) and empty.value < 0.0
    assert not empty.state.any() and empty.time == 0.0


def test_two_inputs_and_one():
    for m in (1, 2):
        A = np.zeros((1, m))
        A[0, 0] = 2.0
        assert measured(A, np.zeros(1)).value < measured(A, np.ones(1)).value


# Derivatives by state, time, estimate and bound ------------------------------------


@pytest.fixture(scope="module")
def barriers():
    model = ControlAffineModel.from_system(Blimp())
    obstacles = [
        SphereObstacle([1.2, 0.3, 0.1], 0.5),
        SphereObstacle([0.9, -0.6, 0.7], 0.3, velocity=[-0.1, 0.05, 0.0]),
        SphereObstacle([0.2, 0.4, -0.9], 0.4),
    ]
    return BarrierSet(model, [o.barrier([4.0, 3.0]) for o in obstacles])


def situations(count):
    rng = np.random.default_rng(5)
    for _ in range(count):
        state = rng.normal(0.0, [0.15] * 3 + [0.4] + [0.3] * 4)
        known = DisturbanceKnowledge(
            estimate=rng.normal(0.0, 0.2, 3),
            rate=rng.normal(0.0, 0.3, 3),
            bound=rng.uniform(0.05, 0.2),
            bound_rate=-rng.uniform(0.0, 0.4),
            gain=4.0,
        )
        yield state, rng.uniform(0.0, 1.0), known


def moved(situation, direction):
    """The situation, moved along (state, time, estimate, bound)."""
    state, time, known = situation
    n, q = len(state), len(known.estimate)
    return (
        state + direction[:n],
        time + direction[n],
        known._replace(
            estimate=known.estimate + direction[n + 1 : n + 1 + q],
            bound=known.bound + direction[-1],
        ),
    )


@EVERY_WIDENING
def test_every_partial_derivative_agrees_with_differences(barriers, widening):
    """In all directions at once: state, time, estimate and bound."""
    measure = VolumeMeasure(INPUTS, widening)

    def volume(situation):
        state, time, known = situation
        return measure(feasible_set(INPUTS, barriers.rows(state, time), known))

    checked = 0
    for situation in situations(12):
        exact = volume(situation)
        analytic = np.concatenate(
            [exact.state, [exact.time], exact.estimate, [exact.bound]]
        )
        if not analytic.any():
            continue
        for axis, partial in enumerate(analytic):
            coarse, fine = (
                (
                    volume(moved(situation, h * np.eye(13)[axis])).value
                    - volume(moved(situation, -h * np.eye(13)[axis])).value
                )
                / (2.0 * h)
                for h in (2e-5, 1e-5)
            )
            scale = max(np.abs(analytic).max(), 0.1)
            if abs(coarse - fine) > 1e-4 * scale:
                continue  # A row comes into contact in between: no derivative there.
            assert partial == pytest.approx(fine, abs=2e-4 * scale)
            checked += 1
    assert checked > 40


# Other sets than boxes -------------------------------------------------------------


@EVERY_WIDENING
@pytest.mark.parametrize("m", [2, 3])
def test_a_wider_polytope_contains_the_polytope(widening, m):
    """Motors of a common power: the centre of their ranges is none of the inputs."""
    rng = np.random.default_rng(m)
    A = np.vstack([-np.eye(m), np.ones((1, m))])
    b = np.append(np.full(m, 0.05), 0.05)
    power = InputSet(A, b)
    assert not power.contains(power.center) or m == 2
    corners = np.vstack([np.zeros(m), np.eye(m) * 0.05 * (m + 1)]) - 0.05
    middle = corners.mean(axis=0)  # Of a simplex, by symmetry.
    wide = widening * (b - A @ middle) + A @ middle
    zero, known = np.zeros((1, 1)), DisturbanceKnowledge.constant(1, 0.0)
    for _ in range(20):
        a = rng.normal(size=(1, m))
        side = a @ middle + rng.uniform(-0.05, 0.6) * np.linalg.norm(a)

        def volume(a, side, kappa=widening):
            rows = BarrierRows(
                value=np.ones(1),
                chain=(),
                A=a,
                b=side,
                w=zero,
                num_states=1,
                gradients=lambda rows: np.eye(m + 2)[None, :, :2] * [1.0, 0.0],
            )
            return VolumeMeasure(power, kappa)(feasible_set(power, rows, known))

        found, inner = volume(a, side), volume(a, side, 1.0)
        unit = np.prod(power.scale) * widening**m
        largest = math.exp(log_det(np.vstack([A, a]), np.append(wide, side))) / unit
        assert found.value == pytest.approx(largest, rel=1e-5)
        assert found.value * widening**m > inner.value - 1e-7
        # The state's first entry is that of a, here.
        e, h = np.eye(m)[:1], 1e-5
        fine = [volume(a + s * e, side).value for s in (h, -h)]
        slope = (fine[0] - fine[1]) / (2.0 * h)
        assert found.state[0] == pytest.approx(slope, rel=1e-3, abs=1e-5)


# Along the closed loop -------------------------------------------------------------


def closed_loop(widening, fidelity):
    """The measured rate of a measure along a transient, and two predictions of it.

    Ticks at which the observer's sign function switches are left out, for the estimate
    has a kink there, and so are ticks at which another set of rows takes over.
    """
    scenario = load_scenario(
        "blimp-single-obstacle",
        {
            "fidelity": fidelity,
            "period": 1e-3,
            "duration": 0.3,
            "initial_state": FAST,
            "volume": {"widening": widening},
        },
    )
    diagram = make_loop(scenario)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant, source = map(diagram.GetSubsystemByName, ("plant", "disturbance"))
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(
        scenario.initial_state
    )
    safety_filter = diagram.GetSubsystemByName("filter")
    model = safety_filter.model
    filter_context = safety_filter.GetMyContextFromRoot(context)
    values, total, printed, rates = [], [], [], []
    simulator.Initialize()
    for tick in range(round(scenario.duration / scenario.period)):
        simulator.AdvanceTo(tick * scenario.period)
        now = safety_filter.volume(filter_context)
        known = safety_filter.knowledge(filter_context)
        state = plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(context))
        drift, g = model.drift_and_input_matrix(state)
        u = safety_filter.decision(filter_context).input
        d = source.value(context.get_time())
        rate = drift + g @ u + model.disturbance_matrix @ d
        values.append(now.value)
        total.append(volume_rate(now, rate, known, d))
        printed.append(now.state @ rate + now.time + now.bound * known.bound_rate)
        rates.append(known.rate)
    measured = np.diff(values) / scenario.period
    smooth = np.abs(np.diff(rates, axis=0)).max(axis=1) < 0.5 * scenario.observer.beta
    assert smooth.mean() > 0.9
    return measured[smooth], *(np.array(p)[:-1][smooth] for p in (total, printed))


def relative_error(predicted, measured):
    return np.linalg.norm(predicted - measured) / np.linalg.norm(measured)


@EVERY_WIDENING
def test_total_derivative_is_the_one_that_is_measured(widening):
    measured, total, _ = closed_loop(widening, "corrected")
    assert np.abs(measured).max() > 0.1  # There is something to predict.
    assert relative_error(total, measured) < 0.03


def test_printed_derivative_is_not_the_one_that_is_measured():
    measured, total, printed = closed_loop(3.0, "paper")
    assert relative_error(total, measured) < 0.03
    assert relative_error(printed, measured) > 0.1


# In the filter ---------------------------------------------------------------------


def run(volume):
    return simulate(
        load_scenario(
            "blimp-single-obstacle",
            {"duration": 0.5, "initial_state": FAST, "volume": volume},
        )
    )


@pytest.mark.parametrize(
    "volume",
    [
        {},
        {"widening": 4.0, "gain": 0.2},
    ],
)
def test_logged_ellipsoid_is_that_of_the_set_itself(volume):
    result = run(volume)
    log, limits = result.log, result.scenario.input_set.input_set()
    cut = 0
    for tick in range(0, len(log["time"]), 5):
        A, b = log["polytope_A"][tick], log["polytope_b"][tick]
        share = np.linalg.det(log["ellipsoid_shape"][tick]) / limits.scale.prod()
        drake = log_det(A * limits.scale, b - A @ limits.center)
        assert math.log(share) == pytest.approx(drake, abs=1e-5)
        cut += share < 0.999
    assert cut > 0


def test_logged_volume_is_the_measure_that_is_enforced():
    result = run({"widening": 4.0, "gain": 0.2})
    log, limits = result.log, result.scenario.input_set.input_set()
    for tick in range(0, len(log["time"]), 5):
        A, b = log["polytope_A"][tick][6:], log["polytope_b"][tick][6:]
        value = expected(A * limits.scale, b - A @ limits.center, 4.0)
        assert log["volume"][tick] == pytest.approx(value, abs=1e-6)
    assert result.summary["min_volume"] == log["volume"].min()


def test_widening_wakes_the_row_earlier():
    """On the same course, while the paper's form still is on its plateau."""
    first = {}
    for widening in (1.0, 2.0, 4.0):
        volume = {"widening": widening, "gain": 0.2}
        settings = {"duration": 1.0, "volume": volume}
        log = simulate(load_scenario("blimp-multiple-obstacles", settings)).log
        first[widening] = log["time"][np.argmax(log["volume"] < log["volume"][0])]
    assert 0.0 < first[4.0] < first[2.0] < first[1.0]


def test_volume_barrier_says_what_is_allowed():
    with pytest.raises(
        ValueError, match=r"widening: 0\.5; it must be finite and at least 1"
    ):
        VolumeBarrier(widening=0.5)
