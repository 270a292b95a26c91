"""Decider: the input of one tick."""

from __future__ import annotations

from collections.abc import Sequence

from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.decay import DecayRates
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.qp import FilterDecision, FilterStatus, choose_input
from vcbf_drake.safety.row_holder import Gate, RowHolder, Tick
from vcbf_drake.safety.settings import METHODS, FilterSettings
from vcbf_drake.safety.tick_qp import Frame
from vcbf_drake.safety.volume import Volume, volume_row


class Decider:
    """The steps of a decision: the method's QP, the row holder, the gate.

    Args:
        model: The plant's f, g, E.
        barriers: The barriers and limits behind the rows.
        input_set: The inputs that the actuators can deliver.
        settings: The filter's.
        row_holder: With ``between_ticks: certified``.
        gate: With ``infeasible: backup``.
    """

    def __init__(
        self,
        model: ControlAffineModel,
        barriers: Sequence[object],
        input_set: InputSet,
        settings: FilterSettings,
        row_holder: RowHolder | None,
        gate: Gate | None,
    ) -> None:
        self._model, self._barriers, self._input_set = model, barriers, input_set
        self._settings, self._method = settings, METHODS[settings.method]
        self._row_holder, self._gate = row_holder, gate
        self._frame = Frame.of(input_set, settings.input_weights)

    def __call__(
        self,
        tick: Tick,
        feasible: FeasibleSet,
        v: Volume | None,
        reference: Array,
        held: Array,
    ) -> FilterDecision:
        """Returns the decision.

        Args:
            tick: The data of the tick, with a finite state.
            feasible: The feasible set.
            v: V_v of it; None where it could not be computed, or no row asks for it.
            reference: The reference input, shape (m,).
            held: The input applied now, shape (m,).
        """
        settings, row = self._settings, None
        if v is not None and not v.is_on_plateau:  # There 0 <= lambda_Vv V_v.
            is_total = settings.corrections.total_derivative
            x, known, barrier = tick.state, tick.known, settings.volume
            row = volume_row(v, self._model, x, known, barrier, is_total)
        is_known = v is not None and (row is None or row.is_finite)
        if not is_known:  # The tick fails, and takes the input of the QP without it.
            row = None
        decay_rates = self._decay_rates(feasible)

        def choose(margin: Array | None = None) -> FilterDecision:
            return choose_input(
                feasible if margin is None else feasible.tightened(margin),
                row,
                reference,
                held,
                self._input_set,
                settings.corrections.exact_slack,
                settings.infeasible,
                settings.solver,
                self._frame,
                decay_rates,
            )

        decision = choose()
        if self._method.has_volume_row and not is_known:
            decision = FilterDecision(decision.input, FilterStatus.FAILED)
        elif self._row_holder is not None:
            decision = self._row_holder.lasting_decision(tick, decision, choose)
        return decision if self._gate is None else self._gate.decide(tick, decision)

    def _decay_rates(self, feasible: FeasibleSet) -> DecayRates | None:
        """The decay rates that may grow; None where they may not."""
        always = self._method.feasibility == "decay"
        if not (always or self._settings.infeasible == "decay"):
            return None
        return DecayRates.at(
            feasible.rows.chain,
            self._barriers,
            self._settings.period,
            self._settings.decay_penalty,
            only_where_empty=not always,
        )
