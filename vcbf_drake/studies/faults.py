"""The fault campaign: each fault, with and without volume barrier, and its page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation.audit import CONDITIONS, PROMISES
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.studies.trial import Record, Trial

# Of trials: scenario, fault, method and fidelity.
KIND = ("scenario", "fault", "method", "fidelity")
Kind = tuple[str, str, str, str]
Generator = np.random.Generator

METHODS = ("dob-cbf-qp", "dob-vcbf-qp")
FIDELITIES = ("corrected", "paper")
# Of the starting position's coordinates [m].
_START_OFFSETS = ((-0.1, 0.1), (-0.1, 0.1), (0.0, 0.2))


@dataclass(frozen=True)
class FaultDraw:
    """A fault, drawn anew for every trial, from a random start.

    Attributes:
        name: Its name in results.
    """

    name: str

    @property
    def description(self) -> str:
        """The fault and its numbers, in words."""
        return _FAULTS[self.name][0]

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns one draw, as overrides; see `Draw`."""
        start = _random_start(scenario, np.random.default_rng([seed, index]))
        generator = np.random.default_rng([seed, index, 1])
        if self.name == "noise":
            std = [0.005] * len(scenario.initial_state)
            return start | {"noise": {"std": std, "seed": _seed(generator)}}
        _, fault = _FAULTS[self.name]
        drawn = fault(scenario, generator) if callable(fault) else fault
        return start | {"faults": drawn}


def _random_start(scenario: Scenario, generator: Generator) -> dict[str, Any]:
    """A random start near the scenario's, the same for every fault of an index."""
    offsets = _START_OFFSETS[: len(scenario.target)]
    away = np.array([generator.uniform(*each) for each in offsets])
    start = scenario.vehicle.moved(np.array(scenario.initial_state), away)
    return {"initial_state": start.tolist()}


def _bias(scenario: Scenario, generator: Generator) -> dict[str, Any]:
    signs = generator.choice([-1.0, 1.0], len(scenario.initial_state))
    return {"measurement_bias": (0.02 * signs).tolist()}


def _plant(scenario: Scenario, generator: Generator) -> dict[str, Any]:
    mass, drag = generator.choice([0.7, 1.3], 2).tolist()
    true = {"mass": mass, "drag": drag}  # Of what the vehicle has.
    return {k: each for k, each in true.items() if hasattr(scenario.vehicle, k)}


def _gust(scenario: Scenario, generator: Generator) -> dict[str, Any]:
    source = scenario.make_source()
    size = source.get_output_port().size()
    if not size:
        return {}  # Nothing disturbs such a robot.
    direction = generator.standard_normal(size)
    amplitude = source.bounds.delta1 * direction / np.linalg.norm(direction)
    start = float(generator.uniform(0.1, 0.6)) * scenario.duration
    gust = {"amplitude": amplitude.tolist(), "start": start, "duration": 2.0}
    return {"gusts": [gust]}


def _seed(generator: Generator) -> int:
    return int(generator.integers(2**31))


_Fault = dict[str, Any] | Callable[[Scenario, Generator], dict[str, Any]]
# The faults in words, and the scenario's `faults` that produce them.
_FAULTS: dict[str, tuple[str, _Fault]] = {
    "none": ("nothing is wrong", {}),
    "noise": ("white noise of 0.005 (m, rad, m/s, rad/s) on every state", {}),
    "bias": ("every measured state off by 0.02, either way", _bias),
    "delay": (
        "measurements two control periods old",
        lambda s, g: {"measurement_delay": 2.0 * s.period},
    ),
    "loss": (
        "a tenth of the measurements lost, the last one stays",
        lambda s, g: {"measurement_loss": 0.1, "seed": _seed(g)},
    ),
    "lag": ("actuators of first order, time constant 0.1 s", {"actuator_lag": 0.1}),
    "limit": ("actuators reach 80 % of the declared limits", {"actuator_limit": 0.8}),
    "plant": ("true mass and drag each 30 % above or below the model's", _plant),
    "disturbance": ("the disturbance is twice what is declared", {"disturbance": 2.0}),
    "gust": ("a step of size delta1, 2 s long, in a random direction", _gust),
    "sight": ("obstacles appear 2.5 m ahead", {"sight": 2.5}),
    "solver": (
        "the solvers fail at a twentieth of the ticks",
        lambda s, g: {"solver_failure": 0.05, "seed": _seed(g)},
    ),
    "process": (
        "filter and observer die every 5 s or so; no input for 0.5 s, then anew",
        lambda s, g: {"outage": s.period / 5.0, "seed": _seed(g)},
    ),
}
FAULTS = tuple(map(FaultDraw, _FAULTS))


def fault_trials(
    scenarios: Sequence[str], trials: int, seed: int = 0
) -> dict[Kind, list[Trial]]:
    """Returns the campaign's trials by their kind.

    Where no input is safe the least violation is applied, so that every run goes on and
    shows whether it recovers.

    Args:
        scenarios: Names of shipped scenarios or paths of YAML files.
        trials: The number of trials of each kind; they share their draws.
        seed: The seed of the draws.
    """
    return {
        (scenario, fault.name, method, fidelity): [
            Trial(
                scenario,
                method,
                index,
                seed,
                fault,
                f"{{fidelity: {fidelity}, infeasible: least_violation}}",
            )
            for index in range(trials)
        ]
        for scenario in scenarios
        for fault in FAULTS
        for method in METHODS
        for fidelity in FIDELITIES
    }


def summarise_faults(records: Sequence[Record]) -> dict[str, Any]:
    """Returns the summary of a fault's effect on one method.

    Args:
        records: The records of one kind of trial.
    """
    ended = [each for each in records if each["error"] is None]
    ticks = max(sum(each["ticks"] for each in ended), 1)
    bad = [each for each in ended if each["infeasible_ticks"] + each["failed_ticks"]]
    reasons = [each["reasons_against"] for each in ended]
    inside = [each for each in reasons if _is_inside(each)]
    return {
        "trials": len(records),
        "errors": len(records) - len(ended),
        "reached": sum(each["outcome"] == "reached" for each in ended),
        "collisions": sum(each["outcome"] == "collision" for each in ended),
        "runs_with_bad_ticks": len(bad),
        "recovered": sum(
            each["final_status"] < FilterStatus.INFEASIBLE
            and each["outcome"] != "collision"
            for each in bad
        ),
        **{
            f"{name}_share": sum(each[f"{name}_ticks"] for each in ended) / ticks
            for name in ("relaxed", "infeasible", "failed")
        },
        "least_barrier": min((each["min_barrier"] for each in ended), default=None),
        "illegal_inputs": sum("audit: input" in each for each in reasons),
        "guaranteed": sum(not each for each in reasons),
        "inside_assumptions": len(inside),
        "broken_inside": sum(map(bool, inside)),
    }


def _is_inside(reasons: Sequence[str]) -> bool:
    """Whether every hypothesis and every condition of the theorems on a run held."""
    asked = [f"audit: {name}" for name in CONDITIONS]
    return not any(each.startswith("hypothesis: ") or each in asked for each in reasons)


# The page -----------------------------------------------------------------------------

_PAGE = """\
# Faults in the loop

Produced by `{command}`: {trials} of each fault, method and fidelity, from random
starts. All kinds share their draws.
At infeasible ticks the input of least violation is applied, so that a run continues
until it collides or its time is over. A run has *recovered* if its last tick was
neither infeasible nor failed and it did not collide.

{findings}

A run is *guaranteed* if every hypothesis of `vcbf-drake check` held and the audit,
which knows the true state and disturbance, found every promise below kept at every
tick. It is *inside the assumptions* if the hypotheses held and, during the run, the
conditions of the theorems (*condition* below); the theorems then promise the rest. The
labels are those of the package's docs/theory.md.

| checked at every tick | meaning | role |
| --- | --- | --- |
{promises}

| fault | description |
| --- | --- |
{faults}
"""

_COLUMNS = {
    "reached": "reached",
    "collisions": "collided",
    "relaxed_share": "relaxed ticks",
    "infeasible_share": "infeasible ticks",
    "failed_share": "failed ticks",
    "runs_with_bad_ticks": "runs with such ticks",
    "recovered": "of them recovered",
    "least_barrier": "least h",
    "guaranteed": "called guaranteed",
}


def headline(summaries: Mapping[Kind, Mapping[str, Any]]) -> list[str]:
    """Returns the campaign's main findings, one sentence each."""

    def total(name: str) -> int:
        return sum(int(each[name]) for each in summaries.values())

    in_vain = [kind for kind in summaries if kind[1] != FAULTS[0].name]
    guaranteed = sum(int(summaries[kind]["guaranteed"]) for kind in in_vain)
    return [
        f"{_counted(total('trials'), 'run')}, {total('errors')} ended in an error.",
        f"{_counted(total('illegal_inputs'), 'run')} had an input that was not finite"
        " or outside its limits.",
        f"{_counted(total('inside_assumptions'), 'run')} stayed inside the assumptions;"
        f" {total('broken_inside')} of them broke a promise.",
        f"{_counted(guaranteed, 'run')} under a fault passed as guaranteed.",
    ]


def campaign_markdown(summaries: Mapping[Kind, Mapping[str, Any]], command: str) -> str:
    """Returns the campaign's page.

    Args:
        summaries: The results of `summarise_faults`, for each kind of trial.
        command: The command that makes this page.
    """
    roles = [
        (name, text, "condition" if name in CONDITIONS else "promised")
        for name, text in PROMISES.items()
    ]
    trials = max(each["trials"] for each in summaries.values())
    page = _PAGE.format(
        command=command,
        trials=_counted(trials, "trial"),
        findings="\n".join(f"* {sentence}" for sentence in headline(summaries)),
        promises="\n".join(map(_row, roles)),
        faults="\n".join(_row([fault.name, fault.description]) for fault in FAULTS),
    )
    for scenario in dict.fromkeys(kind[0] for kind in summaries):
        titles = _row([*KIND[1:], *_COLUMNS.values()])
        rule = _row(["---"] * 3 + ["---:"] * len(_COLUMNS))
        rows = [
            _row([*kind[1:], *(_cell(name, summary[name]) for name in _COLUMNS)])
            for kind, summary in summaries.items()
            if kind[0] == scenario
        ]
        page += "\n".join([f"\n## {scenario}\n", titles, rule, *rows, ""])
    return page


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _row(cells: Sequence[str]) -> str:
    # A bar would end its cell.
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name.endswith("_share"):
        return f"{100.0 * value:.1f} %"
    return f"{value:.3f}" if name == "least_barrier" else str(value)
