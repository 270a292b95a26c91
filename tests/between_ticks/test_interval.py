"""Intervals, against mpmath's of 60 digits and against points inside."""

import math

from mpmath import iv, mp
import numpy as np
import pytest

from vcbf_drake.between_ticks.interval import FUNCTIONS, Interval, hull

ULPS = 40.0  # How much wider than the exact range an enclosure may be.


@pytest.fixture(autouse=True)
def digits():
    mp.dps = iv.dps = 60


def exact(interval):
    return iv.mpf([interval.low, interval.high])


def assert_encloses(ours, theirs):
    """Ours holds mpmath's, and is hardly wider."""
    low, high = mp.mpf(theirs.a), mp.mpf(theirs.b)
    assert ours.low <= low
    assert high <= ours.high
    size = ULPS * math.ulp(max(abs(ours.low), abs(ours.high), 1e-300))
    assert low - ours.low <= size
    assert ours.high - high <= size


def random_intervals(seed, count=100):
    """Intervals of both signs, around 0, narrow, wide, and points."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        middle = generator.normal() * 10.0 ** generator.uniform(-3, 2)
        width = abs(middle) * 10.0 ** generator.uniform(-12, 1)
        width *= generator.uniform() > 0.1
        yield Interval(middle - width, middle + width)


def pairs(seed):
    return zip(random_intervals(seed), random_intervals(seed + 1), strict=True)


def test_sums_differences_and_products():
    for a, b in pairs(0):
        assert_encloses(a + b, exact(a) + exact(b))
        assert_encloses(a - b, exact(a) - exact(b))
        assert_encloses(a * b, exact(a) * exact(b))
        assert_encloses(-a, -exact(a))


def test_numbers_on_either_side():
    for a, b in pairs(2):
        c = b.low
        assert_encloses(a + c, exact(a) + c)
        assert_encloses(c + a, exact(a) + c)
        assert_encloses(a - c, exact(a) - c)
        assert_encloses(c - a, c - exact(a))
        assert_encloses(a * c, exact(a) * c)
        assert_encloses(c * a, exact(a) * c)


def test_quotients():
    for a, b in pairs(4):
        if b.low <= 0.0 <= b.high:
            with pytest.raises(ZeroDivisionError):
                a / b
            continue
        assert_encloses(a / b, exact(a) / exact(b))
        assert_encloses(2.0 / b, 2 / exact(b))


@pytest.mark.parametrize("exponent", [2, 3, 4, 5, -1, -2, -3])
def test_whole_powers(exponent):
    for a in random_intervals(6):
        if exponent < 0 and a.low <= 0.0 <= a.high:
            with pytest.raises(ZeroDivisionError):
                a**exponent
            continue
        assert_encloses(a**exponent, exact(a) ** exponent)


def test_an_even_power_is_not_negative():
    assert (Interval(-1e-200, 2.0) ** 2).low == 0.0
    FUNCTIONS["sqrt"](Interval(0.0, 0.0) ** 2 + 0.01)


@pytest.mark.parametrize("name", ["exp", "sin", "cos"])
def test_entire_functions(name):
    for a in random_intervals(8):
        if name == "exp" and a.high > 700.0:
            continue
        ours, theirs = FUNCTIONS[name](a), getattr(iv, name)(exact(a))
        if name == "exp":
            assert_encloses(ours, theirs)
        else:  # A value near 0 has the error of its argument's size.
            assert ours.low <= theirs.a
            assert theirs.b <= ours.high
            assert abs(ours.low - mp.mpf(theirs.a)) < 1e-9
            assert abs(ours.high - mp.mpf(theirs.b)) < 1e-9


@pytest.mark.parametrize("name", ["sqrt", "log"])
def test_functions_of_positive_numbers(name):
    for a in random_intervals(10):
        if a.low > 0.0:
            assert_encloses(FUNCTIONS[name](a), getattr(iv, name)(exact(a)))
        else:
            with pytest.raises(ValueError, match="domain"):
                FUNCTIONS[name](Interval(-1.0, 1.0))


@pytest.mark.parametrize("exponent", [0.5, -0.5, 1.5, -1.5, -2.5, 2.0, 0.3])
def test_real_powers(exponent):
    for a in random_intervals(12):
        if a.low > 0.0:
            assert_encloses(FUNCTIONS["pow"](a, exponent), exact(a) ** mp.mpf(exponent))


POINTWISE = {
    "tan": (mp.tan, -1.5, 1.5),
    "asin": (mp.asin, -1.0, 1.0),
    "acos": (mp.acos, -1.0, 1.0),
    "atan": (mp.atan, -50.0, 50.0),
    "sinh": (mp.sinh, -5.0, 5.0),
    "cosh": (mp.cosh, -5.0, 5.0),
    "tanh": (mp.tanh, -20.0, 20.0),
    "abs": (abs, -5.0, 5.0),
    "sin": (mp.sin, -50.0, 50.0),
    "cos": (mp.cos, -50.0, 50.0),
}


@pytest.mark.parametrize("name", POINTWISE)
def test_ranges_hold_points_and_no_more(name):
    function, least, most = POINTWISE[name]
    generator = np.random.default_rng(14)
    for _ in range(100):
        low, high = np.sort(generator.uniform(least, most, 2))
        if generator.uniform() < 0.5:
            high = low + 0.1 * (high - low)
        found = FUNCTIONS[name](Interval(low, high))
        points = np.linspace(low, high, 201)
        values = [function(mp.mpf(x)) for x in points]
        assert all(found.low <= value <= found.high for value in values)
        # The extremes between the points are missed by a share of the range.
        slack = 0.05 * float(max(values) - min(values)) + 1e-9
        assert found.low >= min(values) - slack
        assert found.high <= max(values) + slack


def test_angles_of_points():
    generator = np.random.default_rng(16)
    for _ in range(200):
        x, y = (Interval(*np.sort(generator.normal(size=2))) for _ in "xy")
        if y.low <= 0.0 <= y.high and x.low <= 0.0:
            with pytest.raises(ValueError, match="atan2"):
                FUNCTIONS["atan2"](y, x)
            continue
        found = FUNCTIONS["atan2"](y, x)
        for _ in range(50):
            b, a = generator.uniform(y.low, y.high), generator.uniform(x.low, x.high)
            assert found.low <= mp.atan2(b, a) <= found.high


def test_least_and_greatest():
    a, b = Interval(-1.0, 3.0), Interval(0.0, 2.0)
    assert repr(FUNCTIONS["max"](a, b)) == "[0.0, 3.0]"
    assert repr(FUNCTIONS["min"](a, b)) == "[-1.0, 2.0]"
    assert repr(hull(a, 5.0)) == "[-1.0, 5.0]"
    assert Interval(0.0, 1.0) in b
    assert a not in b
    assert 2.0 in b


def test_what_has_no_enclosure_raises():
    with pytest.raises(ZeroDivisionError):
        FUNCTIONS["tan"](Interval(1.5, 1.6))
    with pytest.raises(OverflowError):
        Interval(1e300, 1e301) * Interval(1e10, 1e11)
    with pytest.raises(OverflowError):
        Interval(0.0, 1.0) * math.nan
    with pytest.raises(OverflowError):
        FUNCTIONS["exp"](Interval(0.0, 1000.0))


def test_large_angles_are_not_told_apart():
    assert repr(FUNCTIONS["sin"](Interval(1e9, 1e9))) == "[-1.0, 1.0]"
