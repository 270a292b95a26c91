"""RunLog: what a loop's log sinks record, finished and audited piece by piece."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.safety import SafetyFilter, unpack_feasible_set
from vcbf_drake.simulation.audit import audit_margins
from vcbf_drake.simulation.log_files import LogFiles
from vcbf_drake.simulation.loop import COLLISION_MONITOR, LOG_PREFIX

_PATH = "path"
_SCALARS = ("slack", "volume", "status", "least_chi")


class _Store(Protocol):
    """Arrays that grow by pieces."""

    def append(self, arrays: Mapping[str, Array]) -> None: ...

    def arrays(self) -> dict[str, Array]: ...


class RunLog:
    """The log of a simulated run, in memory or on disk.

    Attributes:
        ticks: The arrays of a `Result`'s log, one row a control tick.
        path: ``time`` (S,), ``state`` (S, n) and every h, ``heights`` (S, N), at the
            integrator's steps.
        is_on_disk: Whether they are files, which grow whenever `take` is called.
    """

    def __init__(self, diagram: Diagram, directory: str | Path | None = None) -> None:
        """Makes an empty log.

        Args:
            diagram: A loop that `make_loop` made.
            directory: Where the log grows, with the path in its directory ``path``; in
                memory if None.
        """
        self._sinks = {
            system.get_name().removeprefix(LOG_PREFIX): system
            for system in diagram.GetSystems()
            if system.get_name().startswith(LOG_PREFIX)
        }
        self._filter: SafetyFilter = diagram.GetSubsystemByName("filter")
        self._bounds = diagram.GetSubsystemByName("disturbance").bounds
        self._truth = diagram.GetSubsystemByName(COLLISION_MONITOR).barrier_set
        self.is_on_disk = directory is not None
        self.ticks: _Store = _Lists()
        self.path: _Store = _Lists()
        if directory is not None:
            self.ticks = LogFiles(directory)
            self.path = LogFiles(Path(directory) / _PATH)

    def take(self, context: Context) -> None:
        """Moves what the sinks hold to the log.

        Args:
            context: The loop's.
        """
        found = {name: _taken(sink, context) for name, sink in self._sinks.items()}
        times, states = found.pop(_PATH)
        if len(times):
            heights = self._truth.values_along(states, times)
            self.path.append({"time": times, "state": states, "heights": heights})
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
    """The times and values that a sink holds, which then holds none."""
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
        log.pop("feasible_set"), safety_filter.num_rows, safety_filter.model.num_inputs
    )
    log["polytope_A"], log["polytope_b"] = packed.A, packed.b
    rows = packed.A[:, len(safety_filter.input_set.b) :]
    log["authority"] = np.linalg.norm(rows * safety_filter.input_set.scale, axis=2)
    log["ellipsoid_shape"], log["ellipsoid_center"] = packed.shape, packed.center
    log["status"] = log["status"].astype(int)
    return log
