"""One trial of a study and its record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain
import math
import shlex
from typing import Any

from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.loading import load_fleet
from vcbf_drake.simulation.run import simulate_fleet
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.yaml_nodes import merge_overrides
from vcbf_drake.studies.variation import Draw, Variation

Record = dict[str, Any]

# The numbers of a summary that are kept, and which of several vehicles' is worst.
_NUMBERS: dict[str, Callable[..., Any]] = {
    "running_time": min,
    "reached_at": max,
    "infeasible_at": min,
    "collided_at": min,
    "min_barrier": min,
    "min_volume": min,
    "max_abs_slack": max,
    "ticks": max,
    "relaxed_ticks": max,
    "infeasible_ticks": max,
    "decayed_ticks": max,
    "failed_ticks": max,
    "final_status": max,
}
# The best first.
_OUTCOMES = ("reached", "timeout", "infeasible", "failed", "collision")


@dataclass(frozen=True)
class Trial:
    """One run of a study; it pickles, so that any process can run it.

    Attributes:
        scenario: A shipped scenario's name, or the path of a YAML file.
        method: The safety filter.
        index: Which draw of the variation; a pair of trials shares it.
        seed: The study's seed.
        variation: The variation that is drawn.
        overrides: YAML text with values that replace the scenario's; empty for none.
        scenario_name: Which scenario of a file that holds several; else empty.
    """

    scenario: str
    method: str
    index: int
    seed: int = 0
    variation: Draw = field(default_factory=Variation)
    overrides: str = ""
    scenario_name: str = ""

    @property
    def identity(self) -> Record:
        """The identity of the trial among all others; part of its record."""
        return {
            "scenario": " ".join([self.scenario, self.scenario_name]).strip(),
            "overrides": self.overrides,
            "variation": self.variation.name,
            "seed": self.seed,
            "index": self.index,
            "method": self.method,
        }

    def all_overrides(self) -> str:
        """Returns the overrides with the draw, as YAML text.

        Raises:
            ScenarioError: The scenario does not load.
        """
        given = self.overrides or "{}"
        base: Any = load_fleet(self.scenario, given, self.scenario_name or None)
        if len(base.vehicles) == 1:
            (base,) = base.vehicles
        return merge_overrides(given, self.variation.draw(base, self.seed, self.index))

    def load(self) -> Scenario:
        """Returns the scenario of this trial's only vehicle.

        Raises:
            ScenarioError: It does not load, or has several.
        """
        return self.load_fleet().only(self.scenario)

    def load_fleet(self) -> Fleet:
        """Returns the vehicles of this trial.

        Raises:
            ScenarioError: They do not load.
        """
        overrides, name = self.all_overrides(), self.scenario_name or None
        try:
            fleet = load_fleet(self.scenario, overrides, name)
        except ScenarioError as error:  # Without what was drawn, it loads.
            problem = str(error).removeprefix("override: ")
            raise ScenarioError(f"variation: {problem}") from None
        fleet.set_method(self.method)
        return fleet

    def command(self) -> str:
        """Returns the command line that runs this trial again, with its pictures."""
        words = ["vcbf-drake", "run", self.scenario, "--method", self.method]
        words += ["--override", self.all_overrides()]
        if self.scenario_name:
            words += ["--scenario-name", self.scenario_name]
        return shlex.join(words)


def run_trial(trial: Trial) -> Record:
    """Runs a trial; a crash is part of the record.

    Returns:
        The trial's identity; the outcome and the numbers of the run's summary, the
        running time being the lesser of the duration and the first infeasible tick
        (R47); why it is not guaranteed; the error, or None. Of several vehicles what
        is worst of each.
    """
    try:
        fleet = trial.load_fleet()
        summaries = [each.summary for each in simulate_fleet(fleet, step_time=False)]
    except Exception as error:
        return error_record(trial, f"{type(error).__name__}: {error}")
    numbers = {
        name: _worst_of(worse, [each[name] for each in summaries])
        for name, worse in _NUMBERS.items()
    }
    # Only where a backup manoeuvre is kept there is something to guarantee.
    kept = [each.get("guaranteed_feasible") for each in summaries]
    numbers["guaranteed_feasible"] = None if None in kept else all(kept)
    numbers["running_time"] = min(fleet.duration, numbers["running_time"] or 0.0)
    if None in [each["reached_at"] for each in summaries]:
        numbers["reached_at"] = None
    reasons = chain.from_iterable(each["reasons_against"] for each in summaries)
    return {
        **trial.identity,
        "outcome": max((each["outcome"] for each in summaries), key=_OUTCOMES.index),
        **numbers,
        "reasons_against": list(dict.fromkeys(reasons)),
        "error": None,
    }


def _worst_of(worse: Callable[..., Any], values: Sequence[float | None]) -> Any:
    """The worst value that JSON has; None without one."""
    kept = (each for each in values if each is not None and math.isfinite(each))
    return worse(kept, default=None)


def error_record(trial: Trial, error: str) -> Record:
    """Returns the record of a trial that did not end, with the reason."""
    return {
        **trial.identity,
        "outcome": "error",
        **dict.fromkeys((*_NUMBERS, "guaranteed_feasible", "reasons_against")),
        "error": error,
    }
