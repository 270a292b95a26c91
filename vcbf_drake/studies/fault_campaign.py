"""The fault campaign: every fault, with and without the volume barrier."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation.audit import CONDITIONS
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.studies.trial import Record, Trial

METHODS = ("dob-cbf-qp", "dob-vcbf-qp")
FIDELITIES = ("corrected", "paper")
# Of the starting position's coordinates [m].
_START_OFFSETS = ((-0.1, 0.1), (-0.1, 0.1), (0.0, 0.2))

Generator = np.random.Generator


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
        """Returns one draw, as overrides; see `Draw`.

        Args:
            scenario: The scenario around which to draw.
            seed: The study's seed.
            index: Which draw of the study.
        """
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
) -> dict[tuple[str, str, str, str], list[Trial]]:
    """Returns the campaign's trials by (scenario, fault, method, fidelity).

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
    """Returns the summary of a fault's effect on one method, over its trials.

    Args:
        records: The records of one kind of trial.
    """
    ended = [each for each in records if each["error"] is None]
    ticks = sum(each["ticks"] for each in ended)
    bad = [each for each in ended if each["infeasible_ticks"] + each["failed_ticks"]]
    return {
        "trials": len(records),
        "errors": len(records) - len(ended),
        "reached": sum(each["outcome"] == "reached" for each in ended),
        "collisions": sum(each["outcome"] == "collision" for each in ended),
        "runs_with_bad_ticks": len(bad),
        "recovered": sum(map(_recovered, bad)),
        **{
            f"{name}_share": sum(each[f"{name}_ticks"] for each in ended)
            / max(ticks, 1)
            for name in ("relaxed", "infeasible", "failed")
        },
        "least_barrier": min((each["min_barrier"] for each in ended), default=None),
        "illegal_inputs": _count(ended, "audit: input"),
        "guaranteed": sum(not each["reasons_against"] for each in ended),
        "inside_assumptions": sum(map(_is_inside, ended)),
        "broken_inside": sum(
            _is_inside(each) and bool(each["reasons_against"]) for each in ended
        ),
    }


def _recovered(record: Record) -> bool:
    """Whether the last tick was feasible again, without a collision before."""
    good = record["final_status"] < FilterStatus.INFEASIBLE
    return bool(good and record["outcome"] != "collision")


def _is_inside(record: Record) -> bool:
    """Whether every hypothesis and every condition of the theorems on a run held."""
    asked = [f"audit: {name}" for name in CONDITIONS]
    return not any(
        reason.startswith("hypothesis: ") or reason in asked
        for reason in record["reasons_against"]
    )


def _count(records: Sequence[Record], reason: str) -> int:
    return sum(reason in each["reasons_against"] for each in records)
