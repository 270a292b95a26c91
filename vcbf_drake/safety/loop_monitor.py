"""LoopMonitor: reports of failed hypotheses and infeasible ticks."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    State,
)

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate, DisturbanceObserver
from vcbf_drake.safety.assumptions import start_assumptions
from vcbf_drake.safety.cached_system import CachedSystem
from vcbf_drake.safety.decision import FilterStatus
from vcbf_drake.safety.safety_filter import SafetyFilter
from vcbf_drake.safety.volume import least_threshold, unpack_feasible_set

_LOG = logging.getLogger("vcbf_drake")
# The number of refused intervals, and their share of all, that are reported.
_MANY, _SHARE = 10, 0.5


class _Findings(NamedTuple):
    """The findings of a tick or, as the monitor's state, of all ticks so far.

    Attributes:
        status: A `FilterStatus`, the worst.
        refuses: Whether the observer refused most of the intervals so far (E43).
        is_small: Whether the volume row gives way where V_v is below 0.
        is_lost: Whether the policy is ``backup`` and no way to safety is certified.
    """

    status: float
    refuses: float
    is_small: float
    is_lost: float


class LoopMonitor(CachedSystem):
    """Checks the hypotheses at the start, and reports infeasible ticks.

    .. pydrake_system::

        name: LoopMonitor
        input_ports:
        - status
        - feasible_set
        - levels
        - authority
        - volume
        - row_margin
        - backup (optional)
        - estimate (optional)

    All ports are the filter's, the last the observer's. At the start it logs a line for
    each hypothesis about the start that fails, and at the first tick that is INFEASIBLE
    or FAILED one that names the rows that exclude each other; to the logger
    ``vcbf_drake``, unless the setting `warn` is off. With the policy ``stop`` that tick
    ends the simulation. Three more findings are reported once: that V_v is below 0, so
    that the volume row gives way, that the observer refuses most intervals, and, with
    the policy ``backup``, that no plan is certified any more.
    """

    def __init__(
        self, safety_filter: SafetyFilter, observer: DisturbanceObserver
    ) -> None:
        """Declares ports and events.

        Args:
            safety_filter: The filter whose ports are connected.
            observer: The observer that feeds it.
        """
        super().__init__()
        self._filter, self._settings = safety_filter, safety_filter.settings
        self._observer = observer
        self._ports = {
            name: self.DeclareVectorInputPort(
                name, safety_filter.GetOutputPort(name).size()
            )
            for name in (
                *("status", "feasible_set", "levels", "authority", "volume"),
                "row_margin",
            )
        }
        if safety_filter.gate is not None:
            self._ports["backup"] = self.DeclareVectorInputPort("backup", 2)
        if safety_filter.HasInputPort("estimate"):
            size = safety_filter.GetInputPort("estimate").size()
            self._ports["estimate"] = self.DeclareVectorInputPort("estimate", size)
        # The first hypothesis that failed at the start; what was found so far.
        self.DeclareAbstractState(Value[object](("",)))
        self.DeclareDiscreteState(len(_Findings._fields))
        ports = ("status", "volume", "backup", "estimate")
        needs = {self._ports[name].ticket() for name in ports if name in self._ports}
        self._findings = self._cached(
            "findings", self._calc_findings, needs | {self.time_ticket()}
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._check_start)
        # When the tick is decided: by then the filter knows its threshold.
        self.DeclareInitializationPublishEvent(self._check_enclosure)
        period = self._settings.period
        self.DeclarePeriodicPublishEvent(period, 0.0, self._check)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def _read(self, context: Context, port: str) -> Array:
        value: Array = self._ports[port].Eval(context)
        return value

    def _check_start(self, context: Context, state: State) -> EventStatus:
        levels = self._read(context, "levels")
        if len(levels) and np.isnan(levels).all():
            self._warn(
                "at the start no barrier has a value: is the measured state finite, and"
                " at no obstacle's centre? None of the hypotheses could be checked"
            )
            return EventStatus.Succeeded()
        # Not those of the decision, for which the filter has no threshold yet.
        names = ("levels", "authority", "volume", "backup")
        ports = {name: self._read(context, name) for name in self._ports.keys() & names}
        has_volume = self._filter.method.has_volume_row
        is_small = has_volume and ports["volume"][0] < 0.0
        # Without a threshold of its own V_v starts above 0, or at the least one.
        least = least_threshold(self._filter.input_set.num_inputs)
        threshold = self._settings.volume.threshold or least
        found = start_assumptions(self._filter, self._observer, ports, threshold)
        failed = [each for each in found if each.holds is False]
        # A volume that starts below 0 is a hypothesis that fails; so is no plan.
        told = _Findings(0.0, 0.0, is_small, self._has_no_plan(context))
        state.get_mutable_discrete_state().set_value(np.array(told, dtype=float))
        first = failed[0].verdict if failed else ""
        state.get_mutable_abstract_state(0).set_value((first,))
        for each in failed:
            self._warn(f"{each.verdict}: {each.consequence}")
        return EventStatus.Succeeded()

    def _check_enclosure(self, context: Context) -> EventStatus:
        is_certified = self._filter.certified_hold > 0.0
        if is_certified and self._read(context, "row_margin")[0] == -np.inf:
            self._warn(
                "between_ticks: certified does nothing at the start: the motion over a"
                " period cannot be enclosed there; take a shorter one"
            )
        return EventStatus.Succeeded()

    def _check(self, context: Context) -> EventStatus:
        found = self._findings(context)
        told = _Findings(*context.get_discrete_state_vector().CopyToVector().tolist())
        if found.is_lost and not told.is_lost:
            self._warn(
                f"no certified plan at {context.get_time():.4g} s: from here on the"
                " filter may run out of inputs; the plant, its limits, the measured"
                " state, |d|, an obstacle or the manoeuvre is not as declared"
            )
        if found.is_small and not told.is_small:
            self._warn(
                f"V_v is below 0 at {context.get_time():.4g} s: the rows leave less"
                " room than the threshold, no input makes more in time, and so the"
                " volume row gives way (RELAXED); lower volume.threshold, widen the"
                " limits or start further away"
            )
        if found.refuses and not told.refuses:
            self._warn(
                f"the observer refuses most intervals by {context.get_time():.4g} s:"
                " what is measured moves more than bounds, model and noise allow, so"
                " the disturbance is not known; check the bounds, the units and the"
                " measured state"
            )
        if found.status < FilterStatus.INFEASIBLE:
            return EventStatus.Succeeded()
        if self._settings.infeasible == "stop":
            reason = self._reason(context, found.status)
            return EventStatus.ReachedTermination(self, reason)
        if told.status < FilterStatus.INFEASIBLE:
            self._warn(self._reason(context, found.status))
        return EventStatus.Succeeded()

    def _remember(self, context: Context, discrete: DiscreteValues) -> None:
        told = context.get_discrete_state_vector().CopyToVector()
        discrete.set_value(np.maximum(told, self._findings(context)))

    def _calc_findings(self, context: Context) -> _Findings:
        status = float(self._read(context, "status")[0])
        is_small = (
            status == FilterStatus.RELAXED and self._read(context, "volume")[0] < 0.0
        )
        refuses = False
        if "estimate" in self._ports:
            estimate = DisturbanceEstimate.unpack(self._read(context, "estimate"))
            ticks = context.get_time() / self._settings.period
            refuses = estimate.refused_intervals >= max(_MANY, _SHARE * ticks)
        return _Findings(status, refuses, is_small, self._has_no_plan(context))

    def _has_no_plan(self, context: Context) -> bool:
        return "backup" in self._ports and not self._read(context, "backup")[1]

    def _warn(self, line: str) -> None:
        if self._settings.warn:
            _LOG.warning("%s: %s", self._filter.get_name(), line)

    def _reason(self, context: Context, status: float) -> str:
        """One line on why there is no safe input at a tick."""
        at = f"at {context.get_time():.4g} s"
        if status == FilterStatus.FAILED:
            reason = (
                f"FAILED {at}: data are not finite, or no solver's answer was verified"
            )
        else:
            packed = unpack_feasible_set(
                self._read(context, "feasible_set"), self._filter.model.num_inputs
            )
            rows = self._filter.names_in_conflict(packed.A, packed.b)
            reason = f"no feasible input {at}"
            reason += f": {' against '.join(rows)}" if rows else ""
        (failed,) = context.get_abstract_state(0).get_value()
        return f"{reason}; at the start: {failed}" if failed else reason
