"""What the shipped scenarios show of the paper's two experiments with a car."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from examples.paper.car_courses import APPROACH_GAINS
from tests.helpers.runs import shipped_run
from vcbf_drake.plants.shapes import bounding_box
from vcbf_drake.simulation import load_scenario, simulate

AVOIDANCE, SENSITIVITY = "car-avoidance", "car-sensitivity"


def run(name: str, overrides: dict[str, Any]) -> dict[str, Any]:
    if set(overrides) == {"method"}:
        return shipped_run(name, overrides["method"]).summary
    return simulate(load_scenario(name, overrides), step_time=False).summary


def moved_start(index: int) -> list[float]:
    """A start within 0.1 m and 0.1 rad of the shipped one, at rest."""
    x, y, _, heading = np.random.default_rng([2025, index]).uniform(-0.1, 0.1, 4)
    return [float(x), float(y), 0.0, float(heading)]


def clearance(summary: dict[str, Any]) -> float:
    """The distance to the disc's edge [m], from h = rho^2 - (R + margin)^2 (E80)."""
    (disc,) = load_scenario(AVOIDANCE).obstacles
    reach = disc.radius + disc.margin
    return math.sqrt(summary["min_barrier"] + reach**2) - disc.radius


@pytest.mark.parametrize(
    "start", [{}, *({"initial_state": moved_start(index)} for index in (0, 5))]
)
def test_nominal_collides_robust_goes_wide_and_the_proposed_passes_close(
    start: dict[str, Any],
) -> None:
    nominal, robust, proposed = (
        run(AVOIDANCE, {"method": method} | start)
        for method in ("cbf-qp", "robust-cbf-qp", "dob-vcbf-qp")
    )
    (disc,) = load_scenario(AVOIDANCE).obstacles
    assert nominal["outcome"] == "collision"
    # Before it has passed the disc, not on coming round.
    assert nominal["reached_at"] is None
    assert nominal["final_distance"] > 5.0 - disc.center[0]
    assert robust["outcome"] == proposed["outcome"] == "reached"
    assert proposed["max_abs_slack"] == 0.0
    assert disc.margin < clearance(proposed) < disc.margin + 0.03
    assert clearance(robust) > disc.margin + 0.1


@pytest.mark.parametrize("method", ["dob-vcbf-qp", "robust-cbf-qp"])
def test_the_body_that_is_drawn_keeps_off_the_disc(method: str) -> None:
    """The rectangle around the picture, turned and placed by hand at every tick."""
    result = shipped_run(AVOIDANCE, method)
    (disc,) = result.scenario.obstacles
    low, high = bounding_box(result.scenario.vehicle.geometry("#000000"))
    x, y, _, heading = result.log["state"].T
    away = np.array([disc.center[0] - x, disc.center[1] - y])
    c, s = np.cos(heading), np.sin(heading)
    ahead, left = c * away[0] + s * away[1], c * away[1] - s * away[0]
    beyond = [
        np.maximum(np.maximum(low[i] - at, at - high[i]), 0.0)
        for i, at in enumerate((ahead, left))
    ]
    clear = np.hypot(*beyond) - disc.radius
    assert clear.min() > 0.04


def test_a_slow_car_needs_the_volume_barrier() -> None:
    controller = load_scenario(SENSITIVITY).vehicle.controller
    assert controller.approach_gain == APPROACH_GAINS[0] == 0.2
    stuck = run(SENSITIVITY, {"method": "dob-cbf-qp"})
    assert stuck["outcome"] == "infeasible"
    assert 2.0 < stuck["infeasible_at"] < 4.0
    assert stuck["final_distance"] > 3.0
    arrives = run(SENSITIVITY, {"method": "dob-vcbf-qp"})
    assert arrives["outcome"] == "reached"
    assert arrives["min_barrier"] > 0.0
    assert arrives["min_volume"] > 0.0


@pytest.mark.parametrize("gain", APPROACH_GAINS[1:])
@pytest.mark.parametrize("method", ["dob-cbf-qp", "dob-vcbf-qp"])
def test_a_faster_car_arrives_either_way(method: str, gain: float) -> None:
    controller = {"controller": {"approach_gain": gain}}
    faster = {"method": method, "vehicle": controller, "ends_at_target": True}
    assert run(SENSITIVITY, faster)["outcome"] == "reached"


@pytest.mark.parametrize("index", range(3))
def test_the_sensitivity_does_not_hang_on_the_exact_start(index: int) -> None:
    def outcome(method: str, gain: float) -> str:
        overrides = {
            "method": method,
            "vehicle": {"controller": {"approach_gain": gain}},
            "initial_state": moved_start(index),
            "ends_at_target": True,
        }
        return str(run(SENSITIVITY, overrides)["outcome"])

    assert outcome("dob-cbf-qp", 0.2) == "infeasible"
    assert outcome("dob-vcbf-qp", 0.2) == "reached"
    assert outcome("dob-cbf-qp", 0.4) == "reached"
