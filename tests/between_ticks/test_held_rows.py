"""Rows between ticks: certified bounds against dense integration, filters with them.

The oracle has its own closed forms of plants and rows, and its own integrator.
"""

from fractions import Fraction
import math
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression, if_then_else
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem
import pytest

from examples.paper.moving_wall import press_against_wall
from vcbf_drake import (
    AddSafetyFilter,
    Barrier,
    Blimp,
    Car,
    ControlAffineModel,
    InputSet,
    ModelError,
    SafetyFilter,
    SphereObstacle,
    load_scenario,
    simulate,
)
from vcbf_drake.barriers import (
    BarrierSet,
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    HalfSpace,
    PerceivedSpheres,
    StateLimit,
    ackermann_limit,
)
from vcbf_drake.between_ticks import HeldRows, held_rows, least_height
from vcbf_drake.between_ticks.enclosures import reach_tube
from vcbf_drake.between_ticks.interval import Interval
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.plants import BlimpParameters, CarParameters
from vcbf_drake.safety import (
    DisturbanceKnowledge,
    FilterSettings,
    Tick,
)
from vcbf_drake.safety.decision import FilterDecision, FilterStatus

ROOT = Path(__file__).parents[2]
GAINS = (4.0, 3.0)
STEPS = 200


def car_rate(x, u, d):
    """(E79), mass 2 kg."""
    return np.array(
        [x[2] * math.cos(x[3]), x[2] * math.sin(x[3]), u[0] / 2.0 + d[0], u[1]]
    )


def car_chi(x, t, u, d, center, velocity, radius):
    """H'' + k1 h' + k2 h of h = |r|^2 - R^2, by hand."""
    r = x[:2] - center - velocity * t
    heading = np.array([math.cos(x[3]), math.sin(x[3])])
    across = np.array([-math.sin(x[3]), math.cos(x[3])])
    relative = x[2] * heading - velocity
    acceleration = (u[0] / 2.0 + d[0]) * heading + x[2] * u[1] * across
    h, h1 = r @ r - radius**2, 2.0 * r @ relative
    h2 = 2.0 * relative @ relative + 2.0 * r @ acceleration
    return h2 + GAINS[0] * h1 + GAINS[1] * h, h


BLIMP = BlimpParameters(
    mass=0.2,
    added_mass=[0.0, 0.0, 0.05],
    drag=[0.04, 0.04, 0.05],
    yaw_inertia=0.01,
    yaw_drag=0.01,
)


def blimp_rate(x, u, d):
    """(E76)."""
    heading = np.array([math.cos(x[3]), math.sin(x[3]), 0.0])
    v = x[4:7]
    force = heading * u[0] / 0.2 + np.array([0.0, 0.0, u[1] / 0.25])
    acceleration = force - np.array([0.2, 0.2, 0.2]) * v + d
    return np.array([*v, x[7], *acceleration, (u[2] - 0.01 * x[7]) / 0.01])


def blimp_chi(x, t, u, d, center, velocity, radius):
    """H'' + k1 h' + k2 h of h = |r| - R, by hand."""
    r = x[:3] - center - velocity * t
    relative = x[4:7] - velocity
    acceleration = blimp_rate(x, u, d)[4:7]
    distance = np.linalg.norm(r)
    n = r / distance
    h, h1 = distance - radius, n @ relative
    h2 = (relative @ relative - h1**2) / distance + n @ acceleration
    return h2 + GAINS[0] * h1 + GAINS[1] * h, h


class Turning:
    """A disturbance that turns, as fast as it likes: |d - middle| <= radius."""

    def __init__(self, generator, middle, radius):
        self.middle, self.radius = middle, radius
        self.axes = np.linalg.qr(generator.normal(size=(len(middle),) * 2))[0]
        self.frequency = 10.0 ** generator.uniform(-1, 3)
        self.phase = generator.uniform(0.0, 2.0 * np.pi)

    def __call__(self, t):
        angle = self.frequency * t + self.phase
        turn = np.zeros(len(self.middle))
        turn[:2] = [math.cos(angle), math.sin(angle)][: len(turn)]
        return self.middle + self.radius * self.axes @ turn


def chi_and_h_over_hold(rate, chi, x, t, u, d, period):
    """Chi and h along a run, at every midpoint step (a Runge-Kutta of order 2)."""
    found, step = [chi(x, t, u, d(t))], period / STEPS
    for k in range(STEPS):
        s = t + k * step
        middle = x + 0.5 * step * rate(x, u, d(s))
        x = x + step * rate(middle, u, d(s + 0.5 * step))
        found.append(chi(x, s + step, u, d(s + step)))
    return np.array(found).T


def random_case(generator, kind):
    """A model with one moving obstacle, a state near it, what is known, an oracle."""
    k = 2 if kind == "car" else 3
    center, velocity = generator.normal(size=k), generator.uniform(-1, 1, k)
    radius = generator.uniform(0.2, 1.0)
    away = generator.normal(size=k)
    position = center + away / np.linalg.norm(away) * radius * generator.uniform(1, 2)
    angle = generator.uniform(-4.0, 4.0)
    t = generator.uniform(0.0, 5.0)
    if kind == "car":
        plant, rate, chi, q = Car(CarParameters(mass=2.0)), car_rate, car_chi, 1
        x = np.array([*position, generator.uniform(-2, 2), angle])
        u = generator.uniform(-1, 1, 2) * [6.0, 3.0]
    else:
        plant, rate, chi, q = Blimp(BLIMP), blimp_rate, blimp_chi, 3
        x = np.array([*position, angle, *generator.uniform(-1, 1, 3), 0.5])
        u = generator.uniform(-1, 1, 3) * [0.3, 0.3, 0.02]
    x[:k] += velocity * t
    model = ControlAffineModel.from_system(plant)
    obstacle = SphereObstacle(
        center, radius, velocity, form="squared" if kind == "car" else "distance"
    )
    positions = tuple(range(k))
    barriers = BarrierSet(model, [obstacle.barrier(GAINS, positions)])
    known = DisturbanceKnowledge(
        0.3 * generator.uniform(-1, 1, q), np.zeros(q), generator.uniform(0, 0.3), 0, 0
    )
    d = Turning(generator, known.estimate, known.bound)

    def oracle(x, t, u, d):
        return chi(x, t, u, d, center, velocity, radius)

    return model, barriers, x, t, u, known, d, rate, oracle


@pytest.mark.parametrize("kind", ["car", "blimp"])
def test_a_row_is_never_below_its_bound_while_the_input_is_held(kind):
    generator = np.random.default_rng(0)
    gaps, losses = [], []
    for _ in range(30):
        model, barriers, x, t, u, known, d, rate, oracle = random_case(generator, kind)
        period = 10.0 ** generator.uniform(-3, -1.2)
        held = HeldRows(model, barriers, period, disturbance_bound=1.0)
        tick = Tick(barriers.rows(x, t), x, t, known)
        (least,) = held.least(tick, u)
        chi, h = chi_and_h_over_hold(rate, oracle, x, t, u, d, period)
        assert least <= chi.min() + 1e-6 * (1.0 + abs(chi).max())
        (chain,) = tick.rows.chain
        rates = np.sort(-np.roots([1.0, *GAINS]).real)[::-1]
        assert least_height(chain, rates, least, period) <= h.min() + 1e-9
        gaps.append(chi.min() - least)
        losses.append(chi[0] - chi.min())
    # Bounds that said nothing would pass too: these follow what the rows really lose.
    assert np.median(gaps) < 1.5
    assert np.mean(losses) > 0.01


@pytest.mark.parametrize("kind", ["car", "blimp"])
def test_the_bound_is_sharp_for_short_holds(kind):
    """It tends to chi at the tick like the period."""
    generator = np.random.default_rng(1)
    for _ in range(10):
        model, barriers, x, t, u, known, *_ = random_case(generator, kind)
        tick = Tick(barriers.rows(x, t), x, t, known._replace(bound=0.0))
        lost = []
        for period in (1e-3, 1e-4, 1e-5):
            (least,) = HeldRows(model, barriers, period, 10.0).least(tick, u)
            lost.append(float(tick.chi(u)[0] - least))
        assert abs(lost[1]) < 0.2 * abs(lost[0]) + 1e-9
        assert abs(lost[2]) < 0.2 * abs(lost[1]) + 1e-9


@pytest.mark.parametrize("kind", ["car", "blimp"])
def test_no_run_leaves_its_tube(kind):
    generator = np.random.default_rng(2)
    for _ in range(30):
        model, _, x, t, u, known, d, rate, _ = random_case(generator, kind)
        ball = [Interval(e - known.bound, e + known.bound) for e in known.estimate]
        period = 10.0 ** generator.uniform(-3, -1)
        tube = reach_tube(model, x.tolist(), u.tolist(), ball, period)
        for k in range(STEPS):
            for state, place in zip(x, tube.states, strict=True):
                assert place.low - 1e-7 <= state <= place.high + 1e-7
            step = period / STEPS
            s = t + k * step
            middle = x + 0.5 * step * rate(x, u, d(s))
            x = x + step * rate(middle, u, d(s + 0.5 * step))


def test_a_tube_that_has_no_end():
    """dx/dt = x^2 leaves every box in a second."""
    with pytest.raises(ArithmeticError):
        reach_tube(_model(lambda x: x * x), [1.0], [0.0], [], 2.0)
    assert (
        HeldRows(
            _model(lambda x: x * x),
            BarrierSet(_model(lambda x: x * x), [Barrier(lambda x, t, p: x[0], [1.0])]),
            2.0,
            0.0,
        ).tube([1.0], [0.0], [])
        is None
    )


def test_a_disturbance_is_within_both_of_its_bounds():
    model = ControlAffineModel.from_system(Car())
    held = HeldRows(model, BarrierSet(model, []), 0.01, disturbance_bound=1.0)

    def ends(estimate, bound):
        known = DisturbanceKnowledge(np.array([estimate]), np.zeros(1), bound, 0, 0)
        (d,) = held.disturbances(known)
        return d.low, d.high

    cases = [
        ((0.5, 0.2), (0.3, 0.7)),
        ((0.9, 0.5), (0.4, 1.0)),
        ((-0.9, 0.5), (-1.0, -0.4)),
        ((2.0, 0.5), (1.0, 1.0)),  # Not true; the nearest truth.
    ]
    for given, expected in cases:
        assert ends(*given) == pytest.approx(expected, abs=1e-15)


def test_a_singular_row_has_no_bound():
    model = ControlAffineModel.from_system(Car())
    barriers = BarrierSet(model, [SphereObstacle([0.0, 0.0], 0.5).barrier([2.0, 1.0])])
    held = HeldRows(model, barriers, 0.1, 0.0)
    x = np.array([-0.05, 0.0, 1.0, 0.0])
    known = DisturbanceKnowledge.constant(1, 0.0)
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, known)
    assert held.least(tick, np.zeros(2)) == -np.inf


def test_what_is_not_known_stays_so():
    rates = np.array([2.0, 1.0])
    assert math.isnan(least_height(np.array([1.0, math.nan]), rates, 0.0, 0.1))
    assert math.isnan(least_height(np.array([math.nan, 1.0]), rates, 0.0, 0.1))
    assert least_height(np.array([1.0, 1.0]), rates, -math.inf, 0.1) == -math.inf


def test_a_run_without_obstacles_has_nothing_to_certify():
    scenario = load_scenario("car-avoidance", {"obstacles": [], "duration": 0.2})
    assert simulate(scenario, step_time=False).summary["certified_min_barrier"] is None


def test_without_a_tube_no_row_has_a_bound():
    """A plant whose motion cannot be enclosed over the period."""
    model = ControlAffineModel.from_system(Blimp())
    sphere = SphereObstacle([9.0, 9.0, 9.0], 0.5)
    barriers = BarrierSet(model, [sphere.barrier([2.0, 1.0])])
    held, too_long = (HeldRows(model, barriers, T, 0.0) for T in (0.1, 100.0))
    x, u, known = np.zeros(8), np.zeros(3), DisturbanceKnowledge.constant(3, 0.0)
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, known)
    assert held.can_enclose(x, u) and held.least(tick, u) > 0.0
    assert not too_long.can_enclose(x, u)
    assert too_long.least(tick, u) == -np.inf


def test_limits_and_empty_slots_are_rows_too():
    model = ControlAffineModel.from_system(Car())
    spheres = PerceivedSpheres(2, 2, form="squared")
    barriers = BarrierSet(
        model, [*spheres.barriers([4.0, 3.0]), *ackermann_limit(1.0, 0.1)]
    )
    held = HeldRows(model, barriers, 0.02, 0.0)
    x = np.array([0.0, 0.0, 1.0, 0.0])
    seen = spheres.pack([[3.0, 0.0]], [[0.0, 0.0]], [0.5])
    known = DisturbanceKnowledge.constant(1, 0.0)
    tick = Tick(barriers.rows(x, 1.0, seen), x, 1.0, known, seen)
    u = np.array([0.0, 0.9])
    least = held.least(tick, u)
    np.testing.assert_allclose(least[1], 1.0)  # 0 u <= 1
    curvature_left = math.sqrt(1.01) - 0.9  # The speed does not change.
    assert least[2] == pytest.approx(curvature_left, abs=1e-9)
    assert np.all(least <= tick.chi(u) + 1e-9)


@TemplateSystem.define("Custom_")
def Custom_(T):
    class Impl(LeafSystem_[T]):
        def _construct(self, rate, *, converter=None):
            LeafSystem_[T].__init__(self, converter)
            self.rate = rate
            self.DeclareVectorInputPort("u", BasicVector_[T](1))
            state = self.DeclareContinuousState(1)
            self.DeclareStateOutputPort("state", state)

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other.rate, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            (x,) = context.get_continuous_state_vector().CopyToVector()
            (u,) = self.get_input_port().Eval(context)
            derivatives.get_mutable_vector().SetFromVector([self.rate(x) + u])

    return Impl


def _model(rate):
    return ControlAffineModel.from_system(Custom_[float](rate))


def test_what_has_no_enclosure_is_said_in_one_line():
    def kinked(x):
        if isinstance(x, Expression):
            return if_then_else(x > 0.0, x, 2.0 * x)
        return x if x > 0.0 else 2.0 * x

    model = _model(kinked)
    barriers = [Barrier(lambda x, t, p: x[0], [1.0], name="floor")]
    inputs = InputSet.box([-1.0], [1.0])
    settings = FilterSettings(method="cbf-qp")
    SafetyFilter(model, barriers, inputs, settings)
    settings = FilterSettings(period=0.01, method="cbf-qp", between_ticks="certified")
    with pytest.raises(ModelError, match=r"no enclosure on intervals.*cases") as error:
        SafetyFilter(model, barriers, inputs, settings, make_row_holder=HeldRows)
    assert "\n" not in str(error.value)


GAINS_OF_ANY = (10.0, 3.55)
SHAPES = [
    BoxObstacle([1.5, 0.1, 0.0], [0.3, 0.4, 0.5]),
    CapsuleObstacle([1.5, 0.1, 0.0], [1.5, 1.0, 1.0], 0.3, [0.1, 0.0, 0.0]),
    EllipsoidObstacle([1.5, 0.1, 0.0], [0.3, 0.4, 0.5]),
    HalfSpace([-1.0, 0.0, 0.0], -2.0),
    SphereObstacle([1.5, 0.1, 0.0], 0.4),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
@pytest.mark.parametrize("robust", [False, True])
def test_every_kind_of_barrier_has_an_enclosure(shape, robust):
    """The bounds hold for rows along a run, whoever wrote the rows."""
    model = ControlAffineModel.from_system(Blimp(BLIMP))
    barrier = shape.barrier(GAINS_OF_ANY)
    barriers = BarrierSet(model, [barrier.robust_to(0.5) if robust else barrier])
    generator = np.random.default_rng(3)
    for _ in range(5):
        x = np.array([0.0, 0.0, 0.0, *generator.normal(size=5)])
        u = generator.uniform(-1, 1, 3) * [0.3, 0.3, 0.02]
        d = generator.uniform(-0.3, 0.3, 3)
        known = DisturbanceKnowledge(d, np.zeros(3), 0.0, 0.0, 0.0)
        period = 0.02
        tick = Tick(barriers.rows(x, 0.0), x, 0.0, known)
        (least,) = HeldRows(model, barriers, period, 1.0).least(tick, u)
        seen, step = [], period / 50
        for k in range(51):
            rows = barriers.rows(x, k * step)
            seen.append((rows.b + rows.w @ d - rows.A @ u).item())
            middle = x + 0.5 * step * blimp_rate(x, u, d)
            x = x + step * blimp_rate(middle, u, d)
        assert min(seen) - 0.2 * abs(seen[0]) - 0.5 < least <= min(seen) + 1e-6


def test_a_model_from_a_urdf_file_has_an_enclosure():
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(ROOT / "examples/models/planar_arm.urdf"))
    plant.Finalize()
    model = ControlAffineModel.from_system(plant, "actuation", symbolic=True)
    barriers = BarrierSet(model, StateLimit(3, -1.5, 1.5).barriers([15.0]))
    x, u, period = np.array([0.4, -0.2, 0.3, 1.4]), np.array([1.0, 0.1]), 0.005
    known = DisturbanceKnowledge.constant(0, 0.0)
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, known)
    least = HeldRows(model, barriers, period, 0.0).least(tick, u)
    context = plant.CreateDefaultContext()
    plant.get_actuation_input_port().FixValue(context, u)
    seen, step = [], period / 50
    for _ in range(51):
        plant.SetPositionsAndVelocities(context, x)
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        # h = 1.5 -+ elbow speed, h' + 15 h
        seen.append([15.0 * (x[3] + 1.5) + rate[3], 15.0 * (1.5 - x[3]) - rate[3]])
        x = x + step * rate
    lowest = np.min(seen, axis=0)
    assert np.all(least <= lowest + 1e-3)
    assert np.all(least >= lowest - 2.0)


# The filter --------------------------------------------------------------------------


def test_a_wall_catches_the_car_between_ticks_unless_that_is_asked_for():
    without = press_against_wall(50.0, "none")
    asked = press_against_wall(50.0, "certified")
    assert without["min_barrier"] < -1e-3
    assert asked["min_barrier"] > 0.0
    assert asked["certified_min_barrier"] >= 0.0
    for run in (without, asked):
        # Certified, and hardly below what was seen.
        gap = run["min_barrier"] - run["certified_min_barrier"]
        assert -1e-9 <= gap < 1e-4


def test_inputs_that_last_are_left_alone():
    """Far from everything the option changes nothing at all."""
    inputs = [
        simulate(
            load_scenario(
                "car-avoidance", {"duration": 1.0, "between_ticks": between_ticks}
            ),
            step_time=False,
        ).log["input"]
        for between_ticks in ("none", "certified")
    ]
    np.testing.assert_array_equal(*inputs)


@pytest.mark.parametrize("method", ["robust-cbf-qp", "dob-cbf-qp", "dob-vcbf-qp"])
def test_a_run_is_nowhere_below_what_is_certified(method):
    for between_ticks in ("none", "certified"):
        scenario = load_scenario(
            "car-avoidance",
            {
                "method": method,
                "period": 0.05,
                "duration": 8.0,
                "between_ticks": between_ticks,
                "integrator": {"max_step": 1e-3},
            },
        )
        summary = simulate(scenario, step_time=False).summary
        gap = summary["min_barrier"] - summary["certified_min_barrier"]
        assert -1e-9 <= gap < 2e-3
        if between_ticks == "certified":
            assert summary["certified_min_barrier"] >= 0.0


@pytest.mark.parametrize(
    "overrides",
    [
        "{method: cbf-qp}",  # Ignores the disturbance.
        "{fidelity: paper}",
        "{noise: {std: [0.01, 0.01, 0.01, 0.01]}}",
        "{observer: {step: explicit}}",
        "{faults: {measurement_delay: 0.02}}",
    ],
)
def test_nothing_is_certified_without_the_hypotheses(overrides):
    scenario = load_scenario("car-avoidance", overrides)
    scenario.duration = 0.5
    summary = simulate(scenario, step_time=False).summary
    assert summary["certified_min_barrier"] is None


def test_the_margin_gives_way_before_the_rows_do():
    """Where no input has the margin, the input without one is applied."""
    model = ControlAffineModel.from_system(Car(CarParameters(mass=1.0)))
    wall = Barrier(lambda x, t, p: x[0], [2.0, 1.0], name="wall")
    barriers = BarrierSet(model, [wall])
    held = HeldRows(model, barriers, 0.5, 0.0)
    x = np.array([0.1, 0.0, 0.3, 0.0])
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, DisturbanceKnowledge.constant(1, 0.0))
    plain = FilterDecision(np.array([-0.5, 0.0]), FilterStatus.FILTERED)
    # chi = a + 2 v + x = 0.2 loses 0.7 a second.
    assert tick.chi(plain.input) == pytest.approx(0.2)
    asked = []

    def choose(margin):
        asked.append(margin)
        return FilterDecision(np.zeros(2), FilterStatus.INFEASIBLE)

    decision = held.lasting_decision(tick, plain, choose)
    assert decision.input is plain.input and decision.status is plain.status
    assert decision.row_margin < -0.15
    assert len(asked) == 1
    assert asked[0] >= 0.35


def test_a_tick_without_a_decision_has_no_row_margin():
    model = ControlAffineModel.from_system(Car())
    wall = Barrier(lambda x, t, p: x[0], [2.0, 1.0], name="wall")
    barriers = BarrierSet(model, [wall])
    held = HeldRows(model, barriers, 0.5, 0.0)
    x = np.array([0.1, 0.0, 0.3, 0.0])
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, DisturbanceKnowledge.constant(1, 0.0))
    lost = FilterDecision(np.zeros(2), FilterStatus.INFEASIBLE)
    assert held.lasting_decision(tick, lost, lambda margin: None) is lost
    assert np.isnan(lost.row_margin)


def drive_away_from_a_wall(slowest, between_ticks="certified"):
    """The outputs for a car that would brake with 0.5 m/s^2, or as little as it can."""
    safety_filter = SafetyFilter(
        ControlAffineModel.from_system(Car(CarParameters(mass=1.0))),
        [Barrier(lambda x, t, p: x[0], [2.0, 1.0], name="wall")],
        InputSet.box([-0.6, -1.0], [slowest, 1.0]),
        FilterSettings(period=0.5, method="cbf-qp", between_ticks=between_ticks),
        make_row_holder=HeldRows,
    )
    context = safety_filter.CreateDefaultContext()
    for name, value in {
        "state": [0.1, 0.0, 0.3, 0.0],
        "reference": [-0.5, 0.0],
    }.items():
        safety_filter.GetInputPort(name).FixValue(context, value)

    def output(name):
        return safety_filter.GetOutputPort(name).Eval(context)

    return output("command")[0], output("status")[0], output("row_margin")[0]


def chi_after(a, t):
    """phi^1' + lambda_2 phi^1 = h'' + 2 h' + h of x = 0.1 + 0.3 t + a t^2 / 2."""
    return a + 2.0 * (0.3 + a * t) + 0.1 + 0.3 * t + 0.5 * a * t**2


def test_the_filter_says_what_its_rows_are_worth_until_the_next_tick():
    assert chi_after(-0.5, 0.0) > 0.0 > chi_after(-0.5, 0.5)
    a, _, least = drive_away_from_a_wall(slowest=0.6)
    assert a > -0.5 and -1e-9 <= least <= chi_after(a, 0.5)
    # No input has the margin.
    a, status, least = drive_away_from_a_wall(slowest=-0.45)
    assert a == -0.5 and status == FilterStatus.REFERENCE
    assert chi_after(a, 0.5) - 0.1 < least <= chi_after(a, 0.5)
    # Nobody asked.
    assert np.isnan(drive_away_from_a_wall(slowest=0.6, between_ticks="none")[2])


@pytest.mark.parametrize("period", [0.1, 0.3])
def test_a_run_says_when_a_margin_gave_way(period):
    scenario = load_scenario(
        "blimp-single-obstacle",
        {"period": period, "duration": 3.0, "between_ticks": "certified"},
    )
    result = simulate(scenario, step_time=False)
    finding, least = (
        result.summary["audit"]["row between ticks"],
        result.log["least_chi"],
    )
    lacking = least < -1e-9
    assert lacking.any() == (period == 0.3)
    assert finding["held"] == (not lacking.any())
    assert finding["violations"] == lacking.sum()
    assert finding["worst"] == least.min()
    reasons = ["audit: row between ticks"] if lacking.any() else []
    assert result.summary["reasons_against"] == reasons
    # What was lost between ticks mattered to no h.
    assert result.summary["certified_min_barrier"] > 0.0


def test_wrong_choices_are_named():
    from pydrake.systems.framework import DiagramBuilder

    def add(**options):
        builder = DiagramBuilder()
        car = builder.AddSystem(Car())
        AddSafetyFilter(
            builder,
            plant=car,
            reference=None,
            barriers=[],
            input_set=InputSet.box([-1.0, -1.0], [1.0, 1.0]),
            bounds=DisturbanceBounds(0.1, 0.1, 0.1),
            settings=FilterSettings(**options),
        )

    with pytest.raises(ValueError, match="'always'; it must be one of none,"):
        add(between_ticks="always")
    with pytest.raises(ValueError, match=r"between_ticks: 'certified'; .*error_floor"):
        add(between_ticks="certified", fidelity="paper")
    add(between_ticks="certified", fidelity="paper", method="robust-cbf-qp")


def random_box(rng, shape, size):
    return rng.normal(size=shape), size * rng.uniform(size=shape)


def corners(rng, box, count):
    """Random corners of a box, where what is linear in each entry is least."""
    middle, radius = box
    signs = rng.choice([-1.0, 1.0], size=(count, *middle.shape))
    return middle + signs * radius


@pytest.mark.parametrize("size", [0.0, 0.1, 2.0])
def test_sums_of_products_are_bounded_from_below_and_closely(size):
    """Each product of two intervals is least at one of its four corners."""
    rng = np.random.default_rng(31)
    for _ in range(20):
        entries, weights = random_box(rng, (3, 5), size), random_box(rng, 5, size)
        (middle, radius), (z, z_radius) = entries, weights
        ends = [
            (middle + s * radius) * (z + t * z_radius)
            for s in (-1.0, 1.0)
            for t in (-1.0, 1.0)
        ]
        least = np.min(ends, axis=0).sum(axis=1)
        bound = held_rows._least_products(entries, weights)
        assert (bound <= least).all()
        assert (bound >= least - 2.0 * radius @ z_radius - 1e-9).all()


def known(numbers):
    """Intervals without width."""
    return numbers, np.zeros_like(numbers)


def exactly(*factors):
    """The sum of products of floats, without rounding."""
    return sum(
        math.prod(map(Fraction, term))
        for term in zip(*(each.tolist() for each in factors), strict=True)
    )


def test_rounding_is_on_the_safe_side():
    """Of sums of large numbers that cancel."""
    rng, n = np.random.default_rng(33), 4
    upwards = 0
    for _ in range(200):
        z, row, F = (1e5 * rng.normal(size=n) for _ in range(3))
        z, row = np.append(z, -z), np.append(row, row + 1e-7 * rng.normal(size=n))
        value = exactly(z, row)
        upwards += Fraction(float(row @ z)) > value
        (bound,) = held_rows._least_products(known(row[None]), known(z))
        assert Fraction(float(bound)) <= value
        G = row[None, :, None] * rng.normal(size=n)
        (bound,) = held_rows._least_rates(known(z), known(G), known(F))
        value = exactly(np.repeat(z, n), G.ravel(), np.tile(F, 2 * n))
        assert Fraction(float(bound)) <= value
    assert upwards > 50


def test_a_hold_covers_a_period_of_rounded_ticks():
    model = ControlAffineModel.from_system(Car())
    held = HeldRows(model, BarrierSet(model, []), 0.1, 0.0)
    ticks = 0.1 * np.arange(1000)
    assert 0.1 < np.diff(ticks).max() <= held.period == pytest.approx(0.1, rel=1e-9)


@pytest.mark.parametrize(
    ("x", "v", "retreat", "a", "least"),
    [
        (0.4, -0.5, 0.0, 0.6, 0.0),  # It gains; by (E86) alone it would seem to lose.
        (0.2, -0.3, 0.2, 0.0, -0.01),  # It loses the rate of -0.1 for 0.1 s.
    ],
)
def test_a_row_at_its_bound_is_worth_what_its_rate_leaves(x, v, retreat, a, least):
    """Of chi = a + 2 (v + c) + x + c t = 0, with the rate 2 a + v + c."""
    model = ControlAffineModel.from_system(Car(CarParameters(mass=1.0)))
    wall = Barrier(lambda x, t, p: x[0] + retreat * t, [2.0, 1.0], name="wall")
    barriers = BarrierSet(model, [wall])
    x = np.array([x, 0.0, v, 0.0])
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, DisturbanceKnowledge.constant(1, 0.0))
    assert tick.chi(np.array([a, 0.0])) == pytest.approx(0.0, abs=1e-12)
    found = HeldRows(model, barriers, 0.1, 0.0).least(tick, np.array([a, 0.0]))
    assert found == pytest.approx(least, abs=1e-9)


@pytest.mark.parametrize("size", [0.0, 0.1, 2.0])
def test_rates_are_bounded_from_below(size):
    """Of z'G F over many corners of z, G and F; exact where nothing is uncertain."""
    rng = np.random.default_rng(32)
    for _ in range(20):
        z, G, F = (random_box(rng, shape, size) for shape in (2, (1, 2, 2), 2))
        bound = held_rows._least_rates(z, G, F)
        values = np.einsum(
            "sk,sikj,sj->si", *(corners(rng, box, 3000) for box in (z, G, F))
        )
        assert (bound <= values.min(axis=0)).all()
        if size == 0.0:
            np.testing.assert_allclose(bound, values[0], atol=1e-9)
