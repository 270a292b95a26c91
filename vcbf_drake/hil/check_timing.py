"""Whether a scenario's time limits leave room for a message every control period."""

from __future__ import annotations

from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.scenario import Scenario


def check_timing(scenario: Scenario) -> None:
    """Checks that no watchdog bites between one message and the next.

    Raises:
        ScenarioError: A time limit is shorter than the control period.
    """
    for name in ("command_timeout", "max_state_age"):
        limit = getattr(scenario.hardware, name)
        if limit <= scenario.period:
            raise ScenarioError(
                f"hardware.{name}: {limit:g} s; it must be above the control period,"
                f" {scenario.period:g} s"
            )
