"""The result of a simulation, in memory and on disk, and the CPU time of its ticks."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
import time
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.files import atomic_write, json_text, replacing
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.simulation.loading import dump_scenario, load_scenario
from vcbf_drake.simulation.scenario import Scenario

# Ticks whose CPU time is measured.
_SAMPLES = 200


@dataclass(frozen=True)
class Result:
    """One run: its scenario, its summary and its log.

    Attributes:
        scenario: The resolved scenario.
        summary: The numbers people compare; see `summarise`.
        log: Named arrays, one row a control tick: time (T,), state (T, n), reference
            and input (T, m), disturbance, disturbance_estimate and estimate_rate
            (T, q), error_bound, slack, volume and status (T,), barriers and
            authority (T, N),
            polytope_A (T, rows, m), polytope_b (T, rows), ellipsoid_shape (T, m, m),
            ellipsoid_center (T, m), audit (T, P), the margins of `PROMISES`;
            least_chi (T,) with `between_ticks: certified`, backup (T, 2), the filter's
            port of that name, with `infeasible: backup`. Mapped from files where
            the run's log went to disk.
    """

    scenario: Scenario
    summary: dict[str, Any]
    log: dict[str, Array]

    def save(self, directory: str | Path) -> None:
        """Writes summary.json, log.npz and scenario.yaml; each whole or not at all."""
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        with replacing(directory / "log.npz") as file:
            np.savez_compressed(file, **self.log)  # type: ignore[arg-type]
        atomic_write(directory / "scenario.yaml", dump_scenario(self.scenario))
        atomic_write(directory / "summary.json", json_text(self.summary))


def load_result(directory: str | Path) -> Result:
    """Returns a result that `Result.save` wrote.

    Raises:
        FileNotFoundError: A file is missing.
        ScenarioError: The scenario does not load.
    """
    directory = Path(directory)
    summary = json.loads((directory / "summary.json").read_text())
    with np.load(directory / "log.npz") as archive:
        log = dict(archive)
    return Result(load_scenario(directory / "scenario.yaml"), summary, log)


def step_cpu_time(
    safety_filter: SafetyFilter, log: dict[str, Array]
) -> dict[str, float]:
    """Returns median and 99th percentile of one filter tick's CPU time [ms].

    The filter is pure: ticks of the log are evaluated again, with nothing around them.
    """
    context = safety_filter.CreateDefaultContext()
    ticks = np.unique(
        np.linspace(0, len(log["time"]) - 1, _SAMPLES).round().astype(int)
    )
    held = np.zeros(safety_filter.model.num_inputs)
    spent = []
    for tick in ticks:
        values = {
            "state": log["state"][tick],
            "reference": log["reference"][tick],
            "held_input": held,
        }
        if "obstacles" in log:
            values["obstacles"] = log["obstacles"][tick]
        if safety_filter.HasInputPort("estimate"):
            values["estimate"] = DisturbanceEstimate(
                log["disturbance_estimate"][tick],
                log["estimate_rate"][tick],
                log["error_bound"][tick],
                log["error_bound_rate"][tick],
                log["refused_intervals"][tick],
                log["quadrature_error"][tick],
            ).pack()
        context.SetTime(float(log["time"][tick]))
        for name, value in values.items():
            safety_filter.GetInputPort(name).FixValue(context, value)
        started = time.thread_time()
        safety_filter.decision(context)
        spent.append(1e3 * (time.thread_time() - started))
    return {
        "median": float(np.median(spent)),
        "p99": float(np.percentile(spent, 99.0)),
    }
