"""Obstacles of every kind in a scenario file: loaded, refused, kept clear of."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.obstacle_kinds import EVERY_KIND
from vcbf_drake import ScenarioError, load_scenario, simulate
from vcbf_drake.simulation import barriers, dump_scenario
from vcbf_drake.simulation.loading import parse_scenario


def test_every_kind_loads_dumps_and_has_its_barriers() -> None:
    scenario = load_scenario("car-avoidance", EVERY_KIND)
    assert parse_scenario(dump_scenario(scenario), "dump.yaml") == scenario
    assert len(scenario.spheres) == 2
    names = [each.name for each in barriers(scenario)]
    assert names == [
        *("obstacle 1", "obstacle 2", "ellipsoid 3", "capsule 4", "box 5"),
        *("half-space 6", "geofence 7 (x low)", "geofence 7 (x high)"),
        *("geofence 7 (y high)", "speed (low)", "speed (high)"),
    ]


def test_a_run_keeps_clear_of_every_kind() -> None:
    overrides = EVERY_KIND[:-1] + ", duration: 9.0}"
    result = simulate(load_scenario("car-avoidance", overrides), step_time=False)
    assert result.summary["outcome"] in ("reached", "timeout")
    x, y, speed, _ = result.log["state"].T
    # Each by its own geometry, apart from the barriers.
    assert (np.hypot(x - 3.4, y - 0.15) > 0.4).all()
    assert (((x - 1.6) / 0.5) ** 2 + ((y + 1.2) / 0.3) ** 2 > 1.0).all()
    assert ((np.abs(x - 2.5) > 0.2) | (np.abs(y + 2.0) > 0.4)).all()
    assert (y > -3.0).all()
    assert ((x > -0.9) & (x < 19.9) & (y < 3.9)).all()
    assert ((speed >= -0.5 - 1e-6) & (speed <= 0.6 + 1e-6)).all()
    assert speed.max() > 0.55  # Without the limit it would be faster: it matters.


@pytest.mark.parametrize(
    ("obstacle", "key", "allowed"),
    [
        ("!Elipsoid {}", "", "unknown tag !Elipsoid; did you mean !Ellipsoid?"),
        ("!Box {center: [3, 3]}", ".half_widths", "missing"),
        ("!Box {center: [3, 3], half_widths: [1, -1]}", ".half_widths[1]", "not below"),
        ("!Ellipsoid {center: [3, 3, 3], semi_axes: [1, 1, 1]}", "", "2 dimensions"),
        ("!HalfSpace {normal: [0, 0]}", "", "normal"),
        ("!StateLimit {state: sped, upper: 1}", ".state", "one of x, y, speed"),
        ("!StateLimit {state: speed}", "", "give lower, upper or both"),
        ("!Capsule {start: [3, 3], end: [4, x], radius: 1}", ".end[1]", "a number"),
    ],
)
def test_refuses(obstacle: str, key: str, allowed: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("car-avoidance", f"{{obstacles: [{obstacle}]}}")
    message = str(caught.value)
    assert message.startswith(f"override: obstacles[0]{key}: ")
    assert allowed in message


def test_start_and_target_are_outside_every_kind() -> None:
    box = "{obstacles: [!Box {center: [5, 0], half_widths: [0.4, 0.2]}]}"
    with pytest.raises(ScenarioError, match=r"target: .* outside obstacles\[0\]"):
        load_scenario("car-avoidance", box)
    fence = "{obstacles: [!Geofence {lower: [0.5, -2], upper: [9, 9]}]}"
    with pytest.raises(ScenarioError, match=r"initial_state: .*distance is -0.5 m"):
        load_scenario("car-avoidance", fence)
    moving = (
        "{obstacles: [!Box {center: [5, 0], half_widths: [1, 1], velocity: [1, 0]}]}"
    )
    assert load_scenario("car-avoidance", moving).obstacles
