"""One trial of a study: what to run, and the record of what happened."""

from __future__ import annotations

from dataclasses import dataclass, field
import math
import shlex
from typing import Any

from vcbf_drake.simulation.loading import load_scenario, merge_overrides
from vcbf_drake.simulation.run import simulate
from vcbf_drake.simulation.scenario import Scenario, validate
from vcbf_drake.studies.variation import Draw, Variation

Record = dict[str, Any]

_NUMBERS = (
    "running_time",
    "reached_at",
    "infeasible_at",
    "collided_at",
    "min_barrier",
    "min_volume",
    "max_abs_slack",
    "ticks",
    "relaxed_ticks",
    "infeasible_ticks",
    "decayed_ticks",
    "failed_ticks",
    "final_status",
)


@dataclass(frozen=True)
class Trial:
    """One run of a study; it pickles, so that any process can run it.

    Attributes:
        scenario: A shipped scenario's name, or the path of a YAML file.
        method: The safety filter.
        index: Which draw of the variation; a pair of trials shares it.
        seed: The study's seed.
        variation: What is drawn.
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
        """What tells this trial from every other; part of its record."""
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
        base = load_scenario(self.scenario, given, self.scenario_name or None)
        return merge_overrides(given, self.variation.draw(base, self.seed, self.index))

    def load(self) -> Scenario:
        """Returns the scenario of this trial.

        Raises:
            ScenarioError: It does not load.
        """
        overrides, name = self.all_overrides(), self.scenario_name or None
        scenario = load_scenario(self.scenario, overrides, name)
        scenario.method = self.method
        validate(scenario)
        return scenario

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
        (R47); why it is not guaranteed; the error, or None.
    """
    try:
        scenario = trial.load()
        summary = simulate(scenario, step_time=False).summary
    except Exception as error:
        return error_record(trial, f"{type(error).__name__}: {error}")
    numbers = {name: _finite(summary[name]) for name in _NUMBERS}
    # Only where a backup manoeuvre is kept there is something to guarantee.
    numbers["guaranteed_feasible"] = summary.get("guaranteed_feasible")
    numbers["running_time"] = min(scenario.duration, summary["running_time"])
    return {
        **trial.identity,
        "outcome": summary["outcome"],
        **numbers,
        "reasons_against": summary["reasons_against"],
        "error": None,
    }


def error_record(trial: Trial, error: str) -> Record:
    """Returns the record of a trial that did not end.

    Args:
        trial: The trial.
        error: Why.
    """
    return {
        **trial.identity,
        "outcome": "error",
        **dict.fromkeys((*_NUMBERS, "guaranteed_feasible", "reasons_against")),
        "error": error,
    }


def _finite(value: float | None) -> float | None:
    """The value, or None for what JSON has no number for."""
    return None if value is None or not math.isfinite(value) else value
