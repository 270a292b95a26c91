"""How many trials of one method ended how, and how long they ran."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# From best to worst; every count of outcomes is told in this order.
OUTCOMES = ("reached", "timeout", "infeasible", "collision", "error")


@dataclass(frozen=True)
class Tally:
    """What became of the trials of one method under one condition.

    Attributes:
        method: The safety filter.
        outcomes: How many trials ended how.
        mean: Their mean running time [s]; None when it was not taken.
        interval: Its 95 % confidence interval [s]; None for fewer than two trials.
        least_volume: The least volume barrier of all trials; None when not taken.
        greatest_slack: The greatest slack of all trials; None when not taken.
        with_slack: In how many trials there was any; None when not taken.
    """

    method: str
    outcomes: Mapping[str, int]
    mean: float | None = None
    interval: tuple[float, float] | None = None
    least_volume: float | None = None
    greatest_slack: float | None = None
    with_slack: int | None = None

    @classmethod
    def from_numbers(cls, method: str, numbers: Mapping[str, Any]) -> Tally:
        """What a study's summary says of a method."""
        interval = numbers.get("interval")
        return cls(
            method=method,
            outcomes=numbers["outcomes"],
            mean=numbers.get("mean_running_time"),
            interval=None if interval is None else (interval[0], interval[1]),
            least_volume=numbers.get("least_volume"),
            greatest_slack=numbers.get("greatest_slack"),
            with_slack=numbers.get("with_slack", {}).get("count"),
        )

    @property
    def trials(self) -> int:
        """How many trials there are."""
        return sum(self.outcomes.values())

    def count(self, outcome: str) -> int:
        """How many trials ended with an outcome."""
        return self.outcomes.get(outcome, 0)

    def share(self, outcome: str) -> float:
        """The share of trials that ended with an outcome; 0 when there is none."""
        return self.count(outcome) / max(self.trials, 1)
