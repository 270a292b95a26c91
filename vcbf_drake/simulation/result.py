"""The result of a run: its log as it grows, by pieces, in memory and on disk."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
import json
import os
from pathlib import Path
import time
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.files import atomic_write, json_text, replacing
from vcbf_drake.safety import SafetyFilter, unpack_feasible_set
from vcbf_drake.simulation.audit import audit_margins
from vcbf_drake.simulation.collision_monitor import COLLISION_MONITOR
from vcbf_drake.simulation.loading import dump_scenario, load_scenario
from vcbf_drake.simulation.loop import LOG_PREFIX
from vcbf_drake.simulation.scenario import Scenario

# Ticks whose CPU time is measured.
_SAMPLES = 200
_PATH, _PATH_OBSTACLES = "path", "path_obstacles"
_SCALARS = ("slack", "volume", "status", "decay", "least_chi")


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


class RunLog:
    """The log of a simulated run, in memory or on disk.

    Attributes:
        ticks: The arrays of a `Result`'s log, one row a control tick.
        path: ``time`` (S,), ``state`` (S, n) and the least h, ``least_height`` (S,), at
            the integrator's steps.
    """

    def __init__(self, diagram: Diagram, directory: str | Path | None = None) -> None:
        """Makes an empty log.

        Args:
            diagram: A loop that `make_loop` made.
            directory: The directory of the growing log, with the path in its directory
                ``path``; in memory if None.
        """
        self._sinks = {
            system.get_name().removeprefix(LOG_PREFIX): system
            for system in diagram.GetSystems()
            if system.get_name().startswith(LOG_PREFIX)
        }
        self._filter: SafetyFilter = diagram.GetSubsystemByName("filter")
        self._bounds = diagram.GetSubsystemByName("disturbance").bounds
        self._truth = diagram.GetSubsystemByName(COLLISION_MONITOR).barrier_set
        self.ticks: _Lists | LogFiles = _Lists()
        self.path: _Lists | LogFiles = _Lists()
        if directory is not None:
            self.ticks = LogFiles(directory)
            self.path = LogFiles(Path(directory) / _PATH)

    def take(self, context: Context) -> None:
        """Moves the content of the sinks to the log."""
        found = {name: _taken(sink, context) for name, sink in self._sinks.items()}
        times, states = found.pop(_PATH)
        _, seen = found.pop(_PATH_OBSTACLES, (times, None))
        if len(times):
            heights = self._truth.values_along(states, times, seen)
            least = np.fmin.reduce(heights, axis=1, initial=np.inf)
            self.path.append({"time": times, "state": states, "least_height": least})
        ticks = {name: values for name, (_, values) in found.items()}
        ticks["time"], _ = found["state"]
        if len(ticks["time"]):
            log = finish_log(ticks, self._filter)
            log["audit"] = audit_margins(log, self._filter, self._truth, self._bounds)
            self.ticks.append(log)


class _Lists:
    """Arrays that grow in memory."""

    def __init__(self) -> None:
        self._pieces: defaultdict[str, list[Array]] = defaultdict(list)

    def append(self, arrays: Mapping[str, Array]) -> None:
        for name, piece in arrays.items():
            self._pieces[name].append(piece)

    def arrays(self) -> dict[str, Array]:
        return {name: np.concatenate(each) for name, each in self._pieces.items()}


def _taken(sink: System, context: Context) -> tuple[Array, Array]:
    """The times and values of a sink, which is emptied."""
    log = sink.FindMutableLog(context)
    taken = log.sample_times().copy(), log.data().T.copy()
    log.Clear()
    return taken


def finish_log(
    log: Mapping[str, Array], safety_filter: SafetyFilter
) -> dict[str, Array]:
    """Returns the log of a `Result` from the values of ports at the ticks.

    Args:
        log: Arrays (T, size) by the names of `logged_ports`, and others.
        safety_filter: The filter that ran.
    """
    log = {name: v[:, 0] if name in _SCALARS else v for name, v in log.items()}
    log |= DisturbanceEstimate.unpack(log.pop("estimate")).log_arrays()
    packed = unpack_feasible_set(
        log.pop("feasible_set"), safety_filter.model.num_inputs
    )
    log["polytope_A"], log["polytope_b"] = packed.A, packed.b
    rows = packed.A[:, len(safety_filter.input_set.b) :]
    moved = np.linalg.norm(rows * safety_filter.input_set.scale, axis=2)
    log["authority"] = safety_filter.of_barriers(moved)
    log["ellipsoid_shape"], log["ellipsoid_center"] = packed.shape, packed.center
    log["status"] = log["status"].astype(int)
    return log


class LogFiles:
    """Named arrays in a directory, one .npy file each, that grow by whole pieces.

    A piece's numbers are written before the header that counts them, so each file is a
    readable array whenever the writing stops.
    """

    def __init__(self, directory: str | Path) -> None:
        """Makes the directory and empties it of arrays."""
        self._directory = Path(directory)
        self._directory.mkdir(parents=True, exist_ok=True)
        for path in self._directory.glob("*.npy"):
            path.unlink()
        self._lengths: dict[str, int] = {}

    def append(self, arrays: Mapping[str, Array]) -> None:
        """Adds a piece to each array's end; all are alike but for their first axis."""
        for name, values in arrays.items():
            piece, path = np.ascontiguousarray(values), self._path(name)
            before = self._lengths.get(name, 0)
            self._lengths[name] = before + len(piece)
            if not before:
                np.save(path, piece)
                continue
            # Of fixed length: NumPy leaves room for the count to grow.
            header = np.lib.format.header_data_from_array_1_0(piece)
            header["shape"] = (before + len(piece), *piece.shape[1:])
            with path.open("r+b") as file:
                file.seek(0, os.SEEK_END)
                file.write(piece.tobytes())
                file.flush()
                file.seek(0)
                np.lib.format.write_array_header_1_0(file, header)

    def _path(self, name: str) -> Path:
        return self._directory / f"{name}.npy"

    def arrays(self) -> dict[str, Array]:
        """Returns the arrays, mapped from the files rather than read."""
        return read_log_files(self._directory)


def read_log_files(directory: str | Path) -> dict[str, Array]:
    """Returns the arrays that `LogFiles` has written so far, equally long each.

    Raises:
        FileNotFoundError: There are none.
    """
    paths = sorted(Path(directory).glob("*.npy"))
    if not paths:
        raise FileNotFoundError(f"{directory}: no arrays of a log there")
    arrays = {path.stem: np.load(path, mmap_mode="r") for path in paths}
    whole = min(map(len, arrays.values()))  # The last piece may be in some files only.
    return {name: array[:whole] for name, array in arrays.items()}
