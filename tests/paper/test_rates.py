"""The sweep over control rates and its page."""

from functools import cache

import pytest

from examples.paper.moving_wall import press_against_wall
from examples.paper.rates import MOVING_WALL, sweep
from vcbf_drake.viz.terminal import rounded_down

pressed = cache(press_against_wall)


def test_what_sampling_costs_shrinks_like_the_period():
    slow, slow_certified, fast, fast_certified = (
        pressed(rate, between_ticks)
        for rate in (20.0, 40.0)
        for between_ticks in ("none", "certified")
    )
    assert slow["min_barrier"] < fast["min_barrier"] < 0.0
    assert slow["min_barrier"] / fast["min_barrier"] == pytest.approx(2.0, rel=0.2)
    for each in (slow_certified, fast_certified):
        assert each["certified_min_barrier"] >= 0.0
        assert each["infeasible_ticks"] == 0
    # The price: the car keeps more distance.
    assert slow_certified["median_barrier"] > slow["median_barrier"]


def test_the_page_has_a_row_a_run():
    parts = sweep((20.0,))
    assert next(parts).startswith("# Between ticks, from 20 Hz to 1 kHz")
    assert next(parts) == f"## {MOVING_WALL}\n"
    rows = [line for line in next(parts).splitlines() if line.startswith("| 20 |")]
    assert [row.split(" | ")[1] for row in rows] == ["none", "certified"]
    certified = pressed(20.0, "certified")["certified_min_barrier"]
    assert f" {rounded_down(certified)} " in rows[1]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.032289, "0.0322"), (-0.012441, "-0.0125"), (2.0, "2"), (0.0, "0")],
)
def test_a_bound_stays_one_when_it_is_rounded(value, text):
    assert rounded_down(value) == text
