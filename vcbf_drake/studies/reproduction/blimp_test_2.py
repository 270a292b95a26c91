"""Test 2 of the paper: many spheres, with and without the volume barrier."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.simulation.result import Result
from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.estimation import estimation
from vcbf_drake.studies.reproduction.section import (
    Records,
    Section,
    entries,
    runs_under,
)
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT
from vcbf_drake.studies.trial import Record

SCENARIO = "blimp-multiple-obstacles"
METHODS = (WITH, WITHOUT)

_FIRST_SNAPSHOT = 2.0  # The paper's first time [s]; its second is the last feasible.
# In normalised inputs, whose range is 2.
_INSIDE = 1e-6


def test_2(settings: Settings) -> Section:
    """Returns the section: both filters, and the printed equations beside them."""
    runs = runs_under(METHODS, SCENARIO, "test_2")
    runs |= runs_under((WITH,), SCENARIO, "test_2_as_printed", {"fidelity": "paper"})

    def evaluate(archive: Archive, records: Records) -> Record:
        results = {method: archive.result(f"test_2/{method}") for method in METHODS}
        times = _snapshot_times(results[WITHOUT])
        return {
            "description": _DESCRIPTION,
            "command": f"vcbf-drake compare {SCENARIO} --methods {','.join(METHODS)}",
            "runs": entries(archive, runs, "test_2"),
            "as_printed": entries(archive, runs, "test_2_as_printed"),
            "snapshots": times,
            "at_snapshots": {
                method: [_at(result, time) for time in times]
                for method, result in results.items()
            },
            "volumes": _compare_volumes(results[WITH], results[WITHOUT]),
            "interior": {m: _interior(result) for m, result in results.items()},
            "estimation": estimation(results[WITH]),
        }

    return Section("test_2", evaluate, runs)


def _snapshot_times(result: Result) -> list[float]:
    """The paper's 2 s, and the last tick at which the run had a feasible input."""
    infeasible_at, time = result.summary["infeasible_at"], result.log["time"]
    end = time[-1] if infeasible_at is None else time[time < infeasible_at][-1]
    return [_FIRST_SNAPSHOT, float(end)]


def _at(result: Result, time: float) -> dict[str, Any]:
    tick = int(np.argmin(abs(result.log["time"] - time)))
    log, inside = result.log, _margins(result, "reference")
    return {
        "time": float(log["time"][tick]),
        "volume": float(log["volume"][tick]),
        "reference": log["reference"][tick].tolist(),
        "input": log["input"][tick].tolist(),
        "reference_is_feasible": bool(inside[tick] >= 0.0),
        "input_to_nearest_face": float(_margins(result, "input")[tick]),
    }


def _compare_volumes(own: Result, other: Result) -> dict[str, Any]:
    """Whose V_v is higher, at the ticks that both runs have."""
    ticks = min(len(own.log["volume"]), len(other.log["volume"]))
    difference = own.log["volume"][:ticks] - other.log["volume"][:ticks]
    return {
        "not_lower": _among(difference >= 0.0),
        "greatest_deficit": float(max(0.0, -difference.min())),
        "mean_difference": float(difference.mean()),
    }


def _interior(result: Result) -> dict[str, Any]:
    """How often a reference outside the feasible set became an input inside it."""
    outside = _margins(result, "reference") < -_INSIDE
    has_interior = np.isfinite(result.log["ellipsoid_center"]).all(axis=1)
    changed = outside & has_interior
    inside = _margins(result, "input") > _INSIDE
    return _among(inside[changed])


def _among(ticks: NDArray[np.bool_]) -> Record:
    """A share of ticks; they follow from each other, so it has no interval."""
    count, total = int(np.sum(ticks)), len(ticks)
    return {"count": count, "of": total, "rate": count / total if total else None}


def _margins(result: Result, name: str) -> Array:
    """Distance of an input to the nearest face at each tick, in normalised inputs."""
    inputs = result.scenario.input_set.input_set()
    A, b, u = (result.log[key] for key in ("polytope_A", "polytope_b", name))
    norms = np.linalg.norm(A * inputs.scale, axis=2)
    slack = b - np.einsum("tri,ti->tr", A, u)
    # A row that no input moves has no face.
    distance = np.divide(slack, norms, out=np.full_like(slack, np.inf), where=norms > 0)
    nearest: Array = distance.min(axis=1)
    return nearest


_DESCRIPTION = (
    "Start, target and all gains are the paper's; spheres, thrust limits and wind are"
    " ours: course 5 of the random ones, chosen because the outcome is the same from"
    " all random starts; how often such courses occur stands under the unselected"
    " layouts."
)
