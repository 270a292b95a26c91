"""What stands in for a simulation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vcbf_drake.simulation.fleet import Fleet


def of_each_vehicle(simulate: Callable[..., Any]) -> Callable[..., list[Any]]:
    """A `simulate_fleet` that asks a `simulate` for one vehicle after the other."""

    def simulate_fleet(fleet: Fleet, step_time: bool) -> list[Any]:
        return [simulate(each, step_time) for each in fleet.vehicles]

    return simulate_fleet
