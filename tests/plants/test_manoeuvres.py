"""The two properties of a plan, cover and nest (E89), of the car's and the blimp's.

Motions are exact where the disturbance is constant over a period, or integrated by
another hand; disturbances are at their bound.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vcbf_drake.model import Manoeuvre
from vcbf_drake.plants import Blimp, BlimpParameters, Car, CarParameters
from vcbf_drake.plants.car_stop import CarStop

TOLERANCE = 1e-9


def car(rng, turns_to=None):
    T, mass = float(rng.choice([0.01, 0.02, 0.1])), 2.0
    limits = np.array([rng.uniform(0.4, 1.2), rng.uniform(0.3, 1.2)])
    delta = rng.uniform(0.0, 0.8) * limits[0] / mass
    found = Car(CarParameters(mass)).make_manoeuvres(-limits, limits, delta, T)
    manoeuvre = found[0 if turns_to is None else 1 + turns_to]
    x = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-1, 1), rng.uniform(-3, 3)])
    if rng.random() < 0.3:
        x[2] *= 0.01  # Next to rest, where it is corrected.

    def rate(x, u, d):
        v, psi = x[2], x[3]
        return [v * np.cos(psi), v * np.sin(psi), u[0] / mass + d, u[1]]

    return manoeuvre, x, limits, T, rate, lambda: delta * rng.choice([-1.0, 1.0])


def turning_car(rng):
    """A stop after a turn, from a state and by an input that it has plans for."""
    turns_to = int(rng.integers(16))
    manoeuvre, x, *others = car(rng, turns_to)
    x[3] = 2.0 * np.pi * turns_to / 16 + rng.uniform(-1.2, 1.2)
    return manoeuvre, x, *others


def blimp(rng):
    T, p = float(rng.choice([0.02, 0.1])), BlimpParameters()
    m_x, _, m_z = p.effective_masses
    thrust = rng.uniform(0.5, 1.5) * m_x
    limits = np.array([thrust, thrust, 0.0146])
    delta = rng.uniform(0.0, 0.9) * thrust / m_z
    found = Blimp(p).make_manoeuvres(-limits, limits, delta, T)
    manoeuvre = found[int(rng.integers(2))]
    x = np.array([*rng.uniform(-3, 3, 3), rng.uniform(-3, 3), *rng.uniform(-1, 1, 4)])

    def rate(x, u, d):
        c, s, push = np.cos(x[3]), np.sin(x[3]), u[0] / m_x
        drag = p.drag[0] / m_x
        return [
            *x[4:8],
            c * push - drag * x[4] + d[0],
            s * push - drag * x[5] + d[1],
            (u[1] - p.drag[2] * x[6]) / m_z + d[2],
            (u[2] - p.yaw_drag * x[7]) / p.yaw_inertia,
        ]

    def worst():
        d = rng.normal(size=3)
        return delta * d / np.linalg.norm(d)

    return manoeuvre, x, limits, T, rate, worst


def moved(x, u, rate, T, disturbance):
    """States on the way through a period, the last at its end."""
    found = solve_ivp(
        lambda _, x: rate(x, u, disturbance),
        (0.0, T),
        x,
        t_eval=np.linspace(0.0, T, 6),
        rtol=1e-11,
        atol=1e-13,
    )
    return found.y.T


def is_within(inner, outer):
    """Whether a box is in one box, or in any one of many, (..., n + 1, 2)."""
    inner, outer = np.array(inner), np.array(outer)
    from_low = outer[..., 0] - TOLERANCE <= inner[:, 0]
    to_high = inner[:, 1] <= outer[..., 1] + TOLERANCE
    return bool(np.any(np.all(from_low & to_high, axis=-1)))


def is_in(point, boxes):
    return is_within(np.column_stack([point, point]), boxes)


def cells(plan):
    return np.array([plan.box(i, i + 1) for i in range(plan.num_cells)])


@pytest.mark.parametrize("kind", [car, turning_car, blimp])
@pytest.mark.parametrize("seed", range(16))
def test_a_plan_covers_what_comes_and_nests_what_is_planned_next(kind, seed):
    rng = np.random.default_rng([120, seed])
    manoeuvre, x, limits, T, rate, worst = kind(rng)
    is_own = seed % 2 == 0
    u = manoeuvre.input(x)
    if not is_own:
        u = limits * rng.uniform(-1.0, 1.0, len(limits))
    plan, t = manoeuvre.plan(x, 0.0, u), 0.0
    before = cells(plan)
    for k in range(8):
        states = moved(x, u, rate, T, worst())
        for state, time in zip(states, np.linspace(t, t + T, 6), strict=True):
            assert is_in([*state, time], before), (k, state)
        x, t = states[-1], t + T
        u = manoeuvre.input(x)
        assert np.all(np.abs(u) <= limits)
        following = manoeuvre.plan(x, t, u)
        after = cells(following)
        # The last period of a way that is followed on is beyond the one before.
        last = len(after) - (following.beyond is not None)
        for i in {0, last - 1, *rng.integers(0, last, 40).tolist()}:
            assert is_within(after[i], before), (k, i)
        if plan.beyond is not None:
            for i in range(0, 100, 7):
                earlier, later = plan.beyond(i + 1), following.beyond(i)
                assert earlier is None or is_within(later, earlier)
        plan, before = following, after


@pytest.mark.parametrize("kind", [car, turning_car, blimp])
def test_a_wider_span_has_a_wider_box(kind):
    rng = np.random.default_rng(7)
    for _ in range(20):
        manoeuvre, x, limits, *_ = kind(rng)
        plan = manoeuvre.plan(x, 0.0, limits * rng.uniform(-1, 1, len(limits)))
        n = min(plan.num_cells, 60)
        first, last = sorted(rng.integers(0, n, 2))
        outer = plan.box(int(first), int(last) + 1)
        for i in range(int(first), int(last) + 1):
            assert is_within(plan.box(i, i + 1), outer)


def test_a_car_at_rest_stays_within_its_cells_whatever_pushes_it():
    limits, delta, T = np.array([1.0, 1.0]), 0.3, 0.02
    stop = CarStop(2.0, -limits, limits, delta, T)
    for push in (delta, -delta):
        s, v = 0.123, 0.0
        low = stop.cell * np.floor(s / stop.cell)
        for _ in range(5000):
            a = stop.input(np.array([s, 0.0, v, 0.0]))[0] / 2.0 + push
            s, v = s + (v + 0.5 * a * T) * T, v + a * T
            assert low <= s <= low + stop.cell


def test_a_car_that_may_stop_on_the_end_of_a_cell_stays_within_its_plan():
    """All numbers are exact: the weakest brakes stop it at 2.5, the end of a cell."""
    limits, push, T = np.array([1.5, 1.0]), 0.5, 0.5
    stop, *_ = Car(CarParameters(1.0)).make_manoeuvres(-limits, limits, push, T)
    assert stop.cell == 2.5
    x = np.array([2.375, 0.0, 0.5, 0.0])
    u = stop.input(x)
    rate = u[0] + push
    after = [x[0] + x[2] * T + 0.5 * rate * T**2, 0.0, x[2] + rate * T, 0.0]
    before, following = stop.plan(x, 0.0, u), np.array(after)
    for cell in cells(stop.plan(following, T, stop.input(following))):
        assert is_within(cell, cells(before))


def test_manoeuvres_are_none_where_the_wind_is_stronger():
    box = np.array([1.0, 1.0])
    assert Car().make_manoeuvres(-box, box, 0.6, 0.02) == []
    limits = np.array([0.2, 0.2, 0.01])
    assert Blimp().make_manoeuvres(-limits, limits, 1.2, 0.02) == []
    uneven = BlimpParameters(drag=[0.01, 0.02, 0.05])
    assert Blimp(uneven).make_manoeuvres(-limits, limits, 0.1, 0.02) == []
    up, down = Blimp().make_manoeuvres(-limits, limits, 0.1, 0.02)
    assert isinstance(up, Manoeuvre)
    assert up.input(np.zeros(8))[1] == 0.2 and down.input(np.zeros(8))[1] == -0.2
