"""The result of a simulation, in memory and on disk."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.files import json_text, replacing
from vcbf_drake.simulation.loading import dump_scenario, load_scenario
from vcbf_drake.simulation.scenario import Scenario


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
        with replacing(directory / "scenario.yaml") as file:
            file.write(dump_scenario(self.scenario).encode())
        with replacing(directory / "summary.json") as file:
            file.write(json_text(self.summary).encode())


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
