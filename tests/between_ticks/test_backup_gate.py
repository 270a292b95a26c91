"""The gate of certified plans: what it promises, against adversaries of all kinds.

The plants are integrated here, by steps of a thousandth of a period, and the distances
are written out: nothing is shared with the tubes that are tested.
"""

import numpy as np
import pytest

from vcbf_drake.barriers import BarrierSet, SphereObstacle, StateInputLimit
from vcbf_drake.between_ticks import BackupGate
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel, Plan
from vcbf_drake.plants import Blimp, BlimpParameters, Car, CarParameters
from vcbf_drake.plants.car_stop import CarStop
from vcbf_drake.safety import (
    DisturbanceKnowledge,
    FilterDecision,
    FilterStatus,
    InputSet,
    Tick,
)

STEPS = 40


def car_rate(x, u, d, mass):
    return np.array(
        [x[2] * np.cos(x[3]), x[2] * np.sin(x[3]), u[0] / mass + d[0], u[1]]
    )


def blimp_rate(x, u, d, p):
    m_x, _, m_z = p.effective_masses
    thrust = u[0] / m_x
    return np.array([
        x[4], x[5], x[6], x[7],
        np.cos(x[3]) * thrust - p.drag[0] / m_x * x[4] + d[0],
        np.sin(x[3]) * thrust - p.drag[0] / m_x * x[5] + d[1],
        (u[1] - p.drag[2] * x[6]) / m_z + d[2],
        (u[2] - p.yaw_drag * x[7]) / p.yaw_inertia,
    ])  # fmt: skip


class World:
    """A plant among balls, with a gate before it and an adversary behind it."""

    def __init__(self, plant, rate, obstacles, limits, delta, period):
        self.model = ControlAffineModel.from_system(plant)
        self.rate, self.delta, self.period = rate, delta, period
        self.centers = np.array([center for center, _ in obstacles])
        self.radii = np.array([radius for _, radius in obstacles])
        self.size = self.centers.shape[1]
        self.limits = np.array(limits)
        self.inputs = InputSet.box(-self.limits, self.limits)
        barriers = [SphereObstacle(*each).barrier([4.0, 3.0]) for each in obstacles]
        self.barriers = BarrierSet(self.model, barriers)
        self.gate = BackupGate(self.model, self.barriers, self.inputs, period, delta)

    def decide(self, x, t, u, estimate=None, bound=0.0):
        q = self.model.num_disturbances
        estimate = np.zeros(q) if estimate is None else estimate
        known = DisturbanceKnowledge(estimate, np.zeros(q), bound, 0.0, 0.0)
        tick = Tick(self.barriers.rows(x, t), x, t, known)
        return self.gate.decide(tick, FilterDecision(u, FilterStatus.FILTERED))

    def least(self, x):
        place = x[: self.size] - self.centers
        return float(np.min(np.linalg.norm(place, axis=1) - self.radii))

    def advanced(self, x, u, adversary):
        """The state after a period, and the least distance on the way."""
        step, least = self.period / STEPS, np.inf
        for _ in range(STEPS):
            d = adversary(x)
            k1 = self.rate(x, u, d)
            k2 = self.rate(x + 0.5 * step * k1, u, d)
            k3 = self.rate(x + 0.5 * step * k2, u, d)
            x = x + step / 6.0 * (k1 + 4.0 * k3 + self.rate(x + step * k3, u, d))
            least = min(least, self.least(x))
        return x, least


def random_car(rng):
    period, mass = rng.choice([0.01, 0.02, 0.1]), 2.0
    force = rng.uniform(0.4, 1.2)
    delta = rng.uniform(0.0, 0.8) * force / mass
    obstacles = [
        (rng.uniform(-3, 3, 2).tolist(), rng.uniform(0.3, 0.6)) for _ in range(4)
    ]
    car = World(
        Car(CarParameters(mass)),
        lambda x, u, d: car_rate(x, u, d, mass),
        obstacles,
        [force, rng.uniform(0.3, 1.2)],
        delta,
        period,
    )
    x = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-1, 1), rng.uniform(-3, 3)])
    return car, x


def random_blimp(rng):
    p = BlimpParameters()
    thrust = rng.uniform(0.5, 1.5) * p.effective_masses[0]
    obstacles = [
        (rng.uniform(-3, 3, 3).tolist(), rng.uniform(0.5, 1.0)) for _ in range(5)
    ]
    blimp = World(
        Blimp(p),
        lambda x, u, d: blimp_rate(x, u, d, p),
        obstacles,
        [thrust, thrust, 0.0146],
        rng.uniform(0.0, 0.3) * thrust / p.effective_masses[2],
        rng.choice([0.02, 0.1]),
    )
    x = np.array([*rng.uniform(-3, 3, 3), rng.uniform(-3, 3), *rng.uniform(-1, 1, 4)])
    return blimp, x


def toward_the_nearest(world):
    """The worst constant wind at every instant: at the bound, towards a ball."""

    def adversary(x):
        place = world.centers - x[: world.size]
        nearest = np.argmin(np.linalg.norm(place, axis=1) - world.radii)
        if world.size == 2:  # The car's channel acts along its heading.
            along = place[nearest] @ np.array([np.cos(x[3]), np.sin(x[3])])
            return np.array([world.delta * np.sign(along)])
        return world.delta * place[nearest] / np.linalg.norm(place[nearest])

    return adversary


def bang_bang(world, rng):
    """At the bound, reversed now and then."""
    d = rng.normal(size=world.model.num_disturbances)
    d *= world.delta / np.linalg.norm(d)

    def adversary(x):
        nonlocal d
        if rng.random() < 0.02:
            d = -d
        return d

    return adversary


def hostile_inputs(world, rng):
    """Inputs of a controller that wants to collide, or knows nothing."""
    held = world.limits * rng.choice([-1.0, 1.0], len(world.limits))

    def chosen(x):
        nonlocal held
        if rng.random() < 0.03:
            held = world.limits * rng.uniform(-1.0, 1.0, len(world.limits))
        return held

    return chosen


def random_car_that_must_turn(rng):
    """A car that no straight stop keeps clear of what is ahead."""
    while True:
        car, x = random_car(rng)
        straight, *turns = car.gate.manoeuvres
        car.gate.manoeuvres = (straight,)
        must_turn = not car.decide(x, 0.0, np.zeros(2)).is_certified
        car.gate.manoeuvres = (straight, *turns)
        if must_turn and abs(x[2]) > 0.3:
            return car, x


@pytest.mark.parametrize("kind", [random_car, random_car_that_must_turn, random_blimp])
@pytest.mark.parametrize("seed", range(12))
def test_from_a_certified_start_it_never_runs_out_of_inputs(kind, seed):
    rng = np.random.default_rng([17, seed])
    while True:
        world, x = kind(rng)
        if world.decide(x, 0.0, np.zeros(len(world.limits))).is_certified:
            break
    chosen = hostile_inputs(world, rng)
    adversaries = [bang_bang(world, rng), toward_the_nearest(world)]
    adversary, acted = adversaries[seed % 2], 0
    for k in range(150):
        decision = world.decide(x, k * world.period, chosen(x))
        assert decision.is_certified, (k, x)
        assert np.all(np.abs(decision.input) <= world.limits + 1e-12)
        acted += decision.backup > 0.0
        x, least = world.advanced(x, decision.input, adversary)
        assert least >= 0.0, (k, x)


@pytest.mark.parametrize("kind", [random_car, random_blimp])
def test_the_manoeuvre_alone_keeps_what_it_was_certified_for(kind):
    rng = np.random.default_rng(5)
    done = 0
    while done < 6:
        world, x = kind(rng)
        manoeuvre = world.gate.manoeuvres[0]
        decision = world.decide(x, 0.0, manoeuvre.input(x))
        if not decision.is_certified or decision.backup > 0.0:
            continue
        done += 1
        adversary = [bang_bang(world, rng), toward_the_nearest(world)][done % 2]
        for k in range(200):
            u = manoeuvre.input(x)
            decision = world.decide(x, k * world.period, u)
            assert decision.is_certified and decision.backup == 0.0, (k, x)
            x, least = world.advanced(x, u, adversary)
            assert least >= 0.0
        if world.size == 2:
            assert abs(x[2]) <= 0.2 * max(1.0, world.period / 0.02)


def car_rate_of_2_kg(x, u, d):
    return car_rate(x, u, d, 2.0)


def car_before_a_disc(distance, speed, delta=0.1, force=1.0, rate=1.0):
    return World(
        Car(CarParameters(2.0)),
        car_rate_of_2_kg,
        [((distance + 0.5, 0.0), 0.5)],
        [force, rate],
        delta,
        0.02,
    ), np.array([0.0, 0.0, speed, 0.0])


@pytest.mark.parametrize(("spare", "certified"), [(0.01, True), (-0.01, False)])
def test_a_car_is_certified_where_its_weakest_brakes_stop_it_in_time(spare, certified):
    # v^2 / (2 B) with B = 1 N / 2 kg - 0.1 m/s^2.
    world, x = car_before_a_disc(0.8**2 / (2.0 * 0.4) + spare, 0.8, rate=0.0)
    decision = world.decide(x, 0.0, np.array([-1.0, 0.0]))
    assert decision.is_certified is certified


@pytest.mark.parametrize(("rate", "certified"), [(1.0, True), (0.1, False)])
def test_a_car_that_cannot_stop_in_time_is_certified_where_it_can_steer_past(
    rate, certified
):
    """At 0.8 m/s it stops after 0.8 m, in the disc; half of it is beside its line."""
    world = World(Car(), car_rate_of_2_kg, [((1.1, 0.35), 0.5)], [1.0, rate], 0.1, 0.02)
    x = np.array([0.0, 0.0, 0.8, 0.0])
    assert world.decide(x, 0.0, np.zeros(2)).is_certified is certified
    limit = StateInputLimit(lambda x, t, p: ([0.0, 1.0], 0.05))
    disc = SphereObstacle((1.1, 0.35), 0.5).barrier([4.0, 3.0])
    world.barriers = BarrierSet(world.model, [disc, limit])
    world.gate = BackupGate(world.model, world.barriers, world.inputs, 0.02, 0.1)
    # A law that turns might break a limit that depends on the state.
    assert not world.decide(x, 0.0, np.zeros(2)).is_certified


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_state_that_is_no_number_has_no_certified_plan(index, value):
    world, x = car_before_a_disc(5.0, 0.5)
    x[index] = value
    assert not world.decide(x, 0.0, np.array([1.0, 0.7])).is_certified


@pytest.mark.filterwarnings("error")
def test_a_speed_beyond_what_floats_square_is_not_certified_and_warns_of_nothing():
    world, x = car_before_a_disc(5.0, 1e200)
    assert not world.decide(x, 0.0, np.array([1.0, 0.7])).is_certified


def test_an_input_gives_way_only_as_far_as_it_must():
    world, x = car_before_a_disc(5.0, 0.5)
    far = world.decide(x, 0.0, np.array([1.0, 0.7]))
    assert far.is_certified and far.backup == 0.0
    assert far.input.tolist() == [1.0, 0.7]
    world, x = car_before_a_disc(0.5**2 / 0.8 + 0.0035, 0.5)
    world.gate.manoeuvres = world.gate.manoeuvres[:1]  # It must stop straight ahead.
    near = world.decide(x, 0.0, np.array([1.0, 0.7]))
    assert near.is_certified and 0.0 < near.backup <= 1.0
    assert near.input[1] == pytest.approx(0.7)  # The brakes alone are enough.
    assert near.input[0] < 1.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_it_steers_round_a_disc_rather_than_brakes_before_it(side):
    """The disc is a little to one side of the line on which the brakes would stop."""
    world = World(
        Car(), car_rate_of_2_kg, [((3.0, 0.35 * side), 0.5)], [1.0, 1.0], 0.1, 0.02
    )
    x, target = np.array([0.0, 0.0, 0.9, 0.0]), np.array([1.0, 0.0])
    turned = 0.0
    for k in range(400):
        decision = world.decide(x, 0.02 * k, target)
        assert decision.is_certified
        # Away from the disc, with less force at times and never with the brakes.
        assert -side * decision.input[1] >= 0.0
        assert decision.input[0] > 0.0
        assert (decision.backup > 0.0) is bool(np.any(decision.input != target))
        turned = max(turned, abs(decision.input[1]))
        x, least = world.advanced(x, decision.input, lambda x: np.array([0.1]))
        assert least >= 0.0
    assert 0.0 < turned <= 1.0 and x[0] > 4.0


def test_an_input_goes_aside_no_farther_than_the_rows_that_limit_it():
    world = World(Car(), car_rate_of_2_kg, [((1.9, 0.35), 0.5)], [1.0, 1.0], 0.1, 0.02)
    disc = SphereObstacle((1.9, 0.35), 0.5).barrier([4.0, 3.0])
    # |omega| <= 0.2 rad/s, as the steering may have it.
    limits = [
        StateInputLimit(lambda x, t, p, s=s: ([0.0, s], 0.2)) for s in (-1.0, 1.0)
    ]
    barriers = BarrierSet(world.model, [disc, *limits])
    gate = BackupGate(world.model, barriers, world.inputs, 0.02, 0.1)
    known, acted = DisturbanceKnowledge.constant(1, 0.0), 0
    x = np.array([0.0, 0.0, 0.6, 0.0])
    for k in range(200):
        tick = Tick(barriers.rows(x, 0.02 * k), x, 0.02 * k, known)
        wanted = FilterDecision(np.array([1.0, 0.0]), FilterStatus.FILTERED)
        decision = gate.decide(tick, wanted)
        assert decision.is_certified
        assert abs(decision.input[1]) <= 0.2 + 1e-9
        acted += decision.input[1] < -0.05
        x, least = world.advanced(x, decision.input, lambda x: np.array([0.1]))
        assert least >= 0.0
    assert acted > 0


def test_no_certificate_where_the_observer_refutes_the_bound():
    world, x = car_before_a_disc(5.0, 0.5)
    u = np.zeros(2)
    assert world.decide(x, 0.0, u, np.array([0.12]), 0.03).is_certified
    assert not world.decide(x, 0.0, u, np.array([0.14]), 0.03).is_certified


def test_without_a_certified_plan_the_manoeuvre_acts_and_says_so():
    world, x = car_before_a_disc(0.2, 0.8)
    tick = Tick(
        world.barriers.rows(x, 0.0), x, 0.0, DisturbanceKnowledge.constant(1, 0.0)
    )
    lost = FilterDecision(np.array([1.0, 0.0]), FilterStatus.INFEASIBLE)
    found = world.gate.decide(tick, lost)
    assert found.is_certified is False and found.backup == 1.0
    assert found.input.tolist() == [-1.0, 0.0]


class Coasting(CarStop):
    """A manoeuvre that is none: it promises to brake and does not."""

    def input(self, state):
        return np.zeros(2)


def test_a_manoeuvre_that_is_not_safe_is_told_before_it_collides():
    world, x = car_before_a_disc(1.5, 0.5)
    bounds = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    world.gate.manoeuvres = (Coasting(2.0, *bounds, 0.1, 0.02),)
    told = None
    for k in range(500):
        decision = world.decide(x, 0.02 * k, np.array([1.0, 0.0]))
        if not decision.is_certified:
            told = told or (k, world.least(x))
        x, least = world.advanced(x, decision.input, lambda x: np.zeros(1))
        if least < 0.0:
            break
    assert least < 0.0
    assert told is not None and told[0] < k and told[1] > 0.1


@pytest.mark.parametrize("wrong", [np.nan, -50.0])
@pytest.mark.parametrize("distance", [0.2, 5.0])
def test_a_manoeuvre_s_input_outside_the_set_never_leaves_nor_certifies(
    wrong, distance
):
    class Wrong(CarStop):
        def input(self, state):
            return np.array([wrong, 0.0])

    world, x = car_before_a_disc(distance, 0.8)
    bounds = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    world.gate.manoeuvres = (Wrong(2.0, *bounds, 0.1, 0.02),)
    tick = Tick(
        world.barriers.rows(x, 0.0), x, 0.0, DisturbanceKnowledge.constant(1, 0.0)
    )
    for status in (FilterStatus.FILTERED, FilterStatus.INFEASIBLE):
        decision = world.gate.decide(tick, FilterDecision(np.zeros(2), status))
        assert decision.is_certified is False
        assert np.all(np.abs(decision.input) <= world.limits)


def test_a_manoeuvre_whose_law_breaks_a_limit_of_the_input_certifies_nothing():
    """The rows that limit the input ask for a force of 0.5 N at least: no brakes."""
    world, x = car_before_a_disc(5.0, 0.1)
    disc = SphereObstacle((5.5, 0.0), 0.5).barrier([4.0, 3.0])
    push = StateInputLimit(lambda x, t, p: ([-1.0, 0.0], -0.5))
    barriers = BarrierSet(world.model, [disc, push])
    gate = BackupGate(world.model, barriers, world.inputs, 0.02, 0.1)
    tick = Tick(barriers.rows(x, 0.0), x, 0.0, DisturbanceKnowledge.constant(1, 0.0))
    pushed = FilterDecision(np.array([0.6, 0.0]), FilterStatus.FILTERED)
    assert gate.decide(tick, pushed).is_certified is False


@pytest.mark.parametrize("side", [(np.nan, np.nan), (1.0, -1.0)])
def test_a_box_that_is_none_certifies_nothing(side):
    class Boxes(CarStop):
        def plan(self, state, time, u):
            return Plan(1, lambda first, last: [*4 * [side], (time, 1e9)])

    world, x = car_before_a_disc(5.0, 0.5)
    bounds = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    world.gate.manoeuvres = (Boxes(2.0, *bounds, 0.1, 0.02),)
    assert world.decide(x, 0.0, np.zeros(2)).is_certified is False


def test_a_box_or_an_input_of_another_size_is_told_so():
    class Short(CarStop):
        def plan(self, state, time, u):
            return Plan(1, lambda first, last: [(0.0, 1.0)])

    class Two(CarStop):
        def input(self, state):
            return np.zeros(3)

    world, x = car_before_a_disc(5.0, 0.5)
    bounds = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    world.gate.manoeuvres = (Short(2.0, *bounds, 0.1, 0.02),)
    with pytest.raises(ModelError, match="of each state and, last, of the time"):
        world.decide(x, 0.0, np.zeros(2))
    world.gate.manoeuvres = (Two(2.0, *bounds, 0.1, 0.02),)
    with pytest.raises(ModelError, match=r"Two.input: expected shape \(2,\), got"):
        world.decide(x, 0.0, np.zeros(2))


def test_a_blimp_that_skims_a_ball_keeps_its_plan():
    # In the worst wind it gets above all that is there by less than a chord's slack, by
    # which the next tick's cells reach lower than it does.
    p = BlimpParameters()
    thrust = p.effective_masses[0]
    blimp = World(
        Blimp(p),
        lambda x, u, d: blimp_rate(x, u, d, p),
        [((0.0, 0.0, 0.0), 1.0)],
        [thrust, thrust, 0.0146],
        0.15,
        0.1,
    )
    x = np.array([0.12656, 0.10139, 1.0047, -2.92109, -0.60237, -0.48356, -0.0499, 0.0])
    decision = blimp.decide(x, 0.0, np.array([-0.0028, 0.12431, 0.0]))
    assert decision.is_certified
    x, least = blimp.advanced(x, decision.input, lambda x: np.array([0, 0, -0.15]))
    assert least >= 0.0
    assert blimp.decide(x, 0.1, np.zeros(3)).is_certified


@pytest.mark.parametrize("start", [0.0, 0.37, 64.0])
@pytest.mark.parametrize(("clearance", "certified"), [(0.3, True), (-0.1, False)])
def test_a_ball_that_passes_aslant_leaves_a_car_its_place(start, clearance, certified):
    """It goes along a line that a car at rest is beside, by so much."""
    world, x = car_before_a_disc(50.0, 0.0)
    along, across = np.array([0.6, 0.8]), np.array([0.8, -0.6])
    ball = SphereObstacle(
        -along * (2.0 + 0.5 * start), 0.5, velocity=0.5 * along
    ).barrier([4.0, 3.0])
    barriers = BarrierSet(world.model, [ball])
    gate = BackupGate(world.model, barriers, world.inputs, 0.02, 0.1)
    known = DisturbanceKnowledge.constant(1, 0.0)
    for k in range(100):  # The ball passes, and at no tick the plan is lost.
        t = start + 0.1 * k
        x = np.array([*((0.5 + clearance) * across), 0.0, 0.0])
        tick = Tick(barriers.rows(x, t), x, t, known)
        decision = gate.decide(tick, FilterDecision(np.zeros(2), FilterStatus.FILTERED))
        assert decision.is_certified is certified
        if not certified:
            break


def test_brakes_weaker_than_the_disturbance_make_no_gate():
    with pytest.raises(ModelError, match=r"no backup manoeuvre of .* is safe"):
        car_before_a_disc(5.0, 0.5, delta=0.6)


def test_a_plant_without_a_manoeuvre_is_told_so():
    model = ControlAffineModel.from_system(Car())
    model.make_manoeuvres = None
    obstacle = SphereObstacle((5.0, 0.0), 0.5).barrier([4.0, 3.0])
    box = InputSet.box([-1.0, -1.0], [1.0, 1.0])
    with pytest.raises(ModelError, match="no backup manoeuvre"):
        BackupGate(model, BarrierSet(model, [obstacle]), box, 0.02, 0.0)


def test_a_soft_barrier_stops_no_plan():
    """A ball that a car may touch, behind one that it may not."""
    soft, hard = ((1.2, 0.0), 0.4), ((3.0, 0.0), 0.5)
    world = World(Car(), car_rate, [soft, hard], [1.0, 0.0], 0.1, 0.02)
    is_hard = np.array([False, True])
    world.gate = BackupGate(
        world.model, world.barriers, world.inputs, world.period, world.delta, is_hard
    )
    # The brake leaves 0.5 / kg - 0.1: 0.8 m to rest, into the soft ball.
    x, u = np.array([0.0, 0.0, 0.8, 0.0]), np.array([0.0, 0.0])
    found = world.decide(x, 0.0, u)
    assert found.is_certified and found.backup == 0.0
    # From 1.5 m/s it would take 2.8 m, into the hard one.
    assert not world.decide(np.array([0.0, 0.0, 1.5, 0.0]), 0.0, u).is_certified
    both = World(Car(), car_rate, [soft, hard], [1.0, 0.0], 0.1, 0.02)
    assert not both.decide(x, 0.0, u).is_certified
