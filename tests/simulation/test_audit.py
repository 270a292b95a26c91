import numpy as np
import pytest

from tests.helpers.runs import shipped_run
from vcbf_drake import load_scenario, simulate
from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.barriers.barrier_set import BarrierSet
from vcbf_drake.between_ticks import HeldRows
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car
from vcbf_drake.safety import FilterSettings, FilterStatus, InputSet, SafetyFilter
from vcbf_drake.simulation.audit import PROMISES, audit_findings, audit_margins

CAR = "car-avoidance"
K1, K2, CENTER, RADIUS, MASS = 4.0, 3.0, np.array([3.0, 0.2]), 0.5, 2.0
LIMIT = np.array([3.0, 4.5])


@pytest.fixture(scope="module")
def car():
    return shipped_run(CAR, "dob-vcbf-qp")


@pytest.fixture(scope="module")
def blind_car():
    return shipped_run(CAR, "cbf-qp")


def margins_by_hand(x, u, d, estimate, bound):
    """The car's sphere, h = |p - c| - R, differentiated on paper."""
    p, v, heading = x[:2] - CENTER, x[2], x[3]
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-np.sin(heading), np.cos(heading)])
    distance = np.linalg.norm(p)
    n, h = p / distance, distance - RADIUS
    rate = v * n @ ahead
    curving = (v**2 - rate**2) / distance
    second = curving + n @ ahead * (u[0] / MASS + d) + v * n @ left * u[1]
    lambda_1 = 3.0  # The larger root of s^2 + 4 s + 3.
    w = n @ ahead
    return {
        "estimate": bound - abs(d - estimate),
        "disturbance term": w * d - (w * estimate - abs(w) * bound),
        "row": second + K1 * rate + K2 * h,
        "barrier": h,
        "chain": rate + lambda_1 * h,
    }


def audited(method, x, u, d, estimate=0.0, bound=0.0, hold=0.0, **logged):
    plant = Car()
    model = ControlAffineModel.from_system(plant)
    obstacle = SphereObstacle(CENTER, RADIUS).barrier(
        [K1, K2], position=Car.position_indices
    )
    inputs = InputSet.box(-LIMIT, LIMIT)
    settings = FilterSettings(
        period=hold or 0.02,
        method=method,
        between_ticks="certified" if hold else "none",
    )
    safety_filter = SafetyFilter(
        model, [obstacle], inputs, settings, make_row_holder=HeldRows
    )
    barriers = BarrierSet(model, [obstacle])
    log = {
        "time": 0.0, "state": x, "disturbance": [d], "input": u,
        "disturbance_estimate": [estimate], "error_bound": bound, "volume": 0.1,
        "slack": 0.0, "least_chi": np.nan, "status": FilterStatus.FILTERED, **logged,
    }  # fmt: skip
    margins = audit_margins(
        {name: np.array([value], float) for name, value in log.items()},
        safety_filter,
        barriers,
        DisturbanceBounds(0.8, 1.0, 1.0),
    )
    return dict(zip(PROMISES, margins[0], strict=True))


@pytest.mark.parametrize("seed", range(5))
def test_margins_are_those_of_the_equations(seed):
    rng = np.random.default_rng(seed)
    x = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-2, 2), rng.uniform(-3, 3)])
    u, (d, estimate), bound = LIMIT * rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2), 0.3
    found = audited("dob-vcbf-qp", x, u, d, estimate, bound)
    for name, margin in margins_by_hand(x, u, d, estimate, bound).items():
        assert found[name] == pytest.approx(margin, abs=1e-12), name


def test_a_method_is_held_to_what_it_takes_as_known():
    x, u = np.array([0.0, 0.0, 1.0, 0.3]), np.zeros(2)
    assert audited("cbf-qp", x, u, 0.5)["estimate"] == pytest.approx(-0.5)
    assert audited("robust-cbf-qp", x, u, 0.5)["estimate"] == pytest.approx(0.3)
    assert np.isnan(audited("dob-cbf-qp", x, u, 0.5)["volume"])
    assert np.isnan(audited("dob-cbf-qp", x, u, 0.5)["slack"])


@pytest.mark.parametrize(
    ("name", "value", "promise"),
    [
        ("status", FilterStatus.INFEASIBLE, "feasible"),
        ("status", FilterStatus.FAILED, "solver"),
        ("input", [3.0 + 1e-6, 0.0], "input"),
        ("input", [np.nan, 0.0], "input"),
        ("input", [-np.inf, 0.0], "input"),
        ("slack", -0.2, "slack"),
        ("volume", -0.01, "volume"),
        ("volume", np.nan, "volume"),
    ],
)
def test_a_broken_promise_has_a_negative_margin(name, value, promise):
    x, u = np.array([0.0, 0.0, 0.2, 0.3]), np.zeros(2)
    kept = audited("dob-vcbf-qp", x, u, 0.0)
    broken = audited("dob-vcbf-qp", x, u, 0.0, **{name: value})
    assert kept[promise] >= 0.0 > broken[promise]


def test_what_was_asked_until_the_next_tick_is_audited_if_it_was_asked():
    x, u, promise = np.array([0.0, 0.0, 0.2, 0.3]), np.zeros(2), "row between ticks"
    assert np.isnan(audited("cbf-qp", x, u, 0.0)[promise])
    for least, margin in [(0.3, 0.3), (-0.1, -0.1), (-np.inf, -np.inf)]:
        found = audited("cbf-qp", x, u, 0.0, hold=0.02, least_chi=least)
        assert found[promise] == margin
    # The tick had no decision that could have been judged.
    assert audited("cbf-qp", x, u, 0.0, hold=0.02)[promise] == -np.inf


def test_a_run_inside_the_assumptions_is_guaranteed(car):
    assert car.summary["guaranteed"] and car.summary["reasons_against"] == []
    assert all(each["held"] is not False for each in car.summary["audit"].values())
    assert car.log["audit"].shape == (len(car.log["time"]), len(PROMISES))


def test_a_run_outside_them_says_what_failed_and_when(blind_car):
    summary = blind_car.summary
    assert not summary["guaranteed"]
    assert "hypothesis: no disturbance" in summary["reasons_against"]
    assert "audit: disturbance term" in summary["reasons_against"]
    assert "collision" in summary["reasons_against"]
    finding = summary["audit"]["estimate"]
    error = np.linalg.norm(blind_car.log["disturbance"], axis=1)
    assert finding["worst"] == pytest.approx(-error.max())
    assert finding["worst_at"] == blind_car.log["time"][error.argmax()]
    assert finding["first_violation"] == 0.0
    assert finding["violations"] == len(error)


@pytest.mark.parametrize("method", ["dob-cbf-qp", "dob-vcbf-qp"])
def test_the_published_equations_are_never_guaranteed(method):
    overrides = {"method": method, "fidelity": "paper", "duration": 0.5}
    summary = simulate(load_scenario(CAR, overrides), step_time=False).summary
    assert "hypothesis: floor of the error bound" in summary["reasons_against"]


def test_the_volume_is_compared_with_what_its_row_allows():
    ticks, gain, period = 4, 3.0, 0.02
    log = {
        "time": period * np.arange(ticks),
        "volume": 0.5 * np.exp(-gain * period * np.arange(ticks)),
        "audit": np.zeros((ticks, len(PROMISES))),
        "authority": np.ones((ticks, 1)),
        "barriers": np.ones((ticks, 1)),
    }
    log["volume"][3] -= 0.001
    path = {"time": log["time"], "least_height": np.ones(ticks)}
    finding = audit_findings(log, path, gain)["volume decrease"]
    assert finding["held"] is None
    assert finding["worst"] == pytest.approx(-0.001 / period)
    assert finding["worst_at"] == pytest.approx(2 * period)
    assert finding["violations"] == 1


def test_a_constant_wind_is_inside_its_bound():
    """The means' quadrature error took 443 of 1001 ticks over the bound, by 8e-8."""
    wind = "{disturbance: [!Constant {value: [0.06, 0.03, 0.05]}]}"
    summary = simulate(load_scenario("blimp-multiple-obstacles", wind)).summary
    for name in ("estimate", "measurement", "quadrature"):
        assert (
            summary["audit"][name]["held"] and not summary["audit"][name]["violations"]
        )
    assert summary["guaranteed"] and summary["certified_min_barrier"] > 0.0


def test_lost_samples_are_refused_and_nothing_is_certified():
    """A sample that comes twice, and the jump after it, are no disturbance."""
    faulty = (
        "{faults: {measurement_loss: 0.1}, duration: 4, infeasible: least_violation}"
    )
    result = simulate(load_scenario("car-avoidance", faulty))
    found = result.summary["audit"]["measurement"]
    refused = result.log["refused_intervals"]
    assert found["held"] is False
    assert found["violations"] == np.sum(np.diff(refused) > 0.0) > 5
    assert result.summary["certified_min_barrier"] is None
    assert "audit: measurement" in result.summary["reasons_against"]
    error = np.linalg.norm(
        result.log["disturbance"] - result.log["disturbance_estimate"], axis=1
    )
    assert np.mean(error > result.log["error_bound"] + 1e-9) < 0.05
