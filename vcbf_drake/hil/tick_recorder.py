"""TickRecorder: the log of a `Result`, from a controller that bus or log drives."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceObserver
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.simulation.loop import logged_ports
from vcbf_drake.simulation.run_log import finish_log


class TickRecorder:
    """Records what a hardware loop's ports say at every tick.

    Of several ticks at one time, as while a vehicle waits, the last one is kept; when
    time goes back, because a vehicle has started again, everything before is dropped.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[float, dict[str, Array]]] = []

    def watch(self, controller: ControllerProcess) -> None:
        """Records a controller from now on, after those that were watched before."""
        named = controller.diagram.GetSubsystemByName
        self._filter: SafetyFilter = named("filter")
        self._observer: DisturbanceObserver = named("filter_observer")
        receiver = named("state_receiver")
        self._ports = {
            "state": receiver.GetOutputPort("state"),
            "applied_input": receiver.GetOutputPort("applied_input"),
            **logged_ports(named("controller"), self._filter, self._observer),
        }
        controller.tick_taps.append(self._record)

    @property
    def is_empty(self) -> bool:
        """Whether there was no tick yet."""
        return not self._rows

    def _record(self, context: Context) -> None:
        now = context.get_time()
        while self._rows and self._rows[-1][0] >= now:
            self._rows.pop()
        row = {
            name: port.Eval(port.get_system().GetMyContextFromRoot(context)).copy()
            for name, port in self._ports.items()
        }
        self._rows.append((now, row))

    def log(self) -> dict[str, Array]:
        """Returns the arrays of a `Result`, one row a tick.

        Nobody tells what the disturbance was: `disturbance` is what the states tell
        with hindsight, from the intervals before and after a tick.
        """
        log = {
            name: np.array([row[name] for _, row in self._rows]) for name in self._ports
        }
        log["time"] = np.array([time for time, _ in self._rows])
        applied = log.pop("applied_input")
        log["disturbance"] = self._disturbances(log["time"], log["state"], applied)
        return finish_log(log, self._filter)

    def _disturbances(self, times: Array, states: Array, applied: Array) -> Array:
        """The disturbance at the ticks, (T, q): between the means of d over intervals.

        A mean (E46) is what d is in the middle of its interval, but for its curvature.
        """
        means = [
            self._observer.mean_disturbance(
                states[k - 1], states[k], applied[k], times[k] - times[k - 1]
            )
            for k in range(1, len(times))
        ]
        if not means:
            return np.zeros((len(times), self._filter.model.num_disturbances))
        middles = (times[1:] + times[:-1]) / 2
        channels = np.transpose(means)
        return np.transpose([np.interp(times, middles, mean) for mean in channels])
