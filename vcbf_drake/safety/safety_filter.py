"""SafetyFilter: one control tick of the method as a Drake system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
import math
from typing import NoReturn

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    State,
)

from vcbf_drake.barriers import Barrier, BarrierRows, BarrierSet, StateInputLimit
from vcbf_drake.barriers.backup_rows import BackupRows
from vcbf_drake.checks import Array, require
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceEstimate
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.cached_system import CachedSystem
from vcbf_drake.safety.decision import (
    FilterDecision,
    FilterStatus,
    Gate,
    RowHolder,
    Tick,
    TickPrograms,
    choose_input,
    least_violation,
)
from vcbf_drake.safety.input_set import InputSet, check_inputs
from vcbf_drake.safety.polytope import emptiness_certificate
from vcbf_drake.safety.qp import (
    DisturbanceKnowledge,
    FeasibleSet,
    Frame,
    feasible_set,
)
from vcbf_drake.safety.settings import METHODS, FilterSettings
from vcbf_drake.safety.volume import Volume, VolumeMeasure, threshold_of, volume_row
from vcbf_drake.typed import NotNegative, typed


class SafetyFilter(CachedSystem):
    r"""Changes a reference input as little as possible so that every barrier holds.

    At every evaluation it solves (E47), or (E54) when the method has a volume row:

    .. math:: \min_u |u - u_{ref}|^2 \quad \text{s.t.} \quad A u \le b + \Delta b,
              \quad \dot V_v \ge -\lambda_{Vv} V_v

    The norm is that of the normalised inputs (u - center) / scale of the input set.
    The system is pure: its outputs are functions of its input ports and the time
    alone, computed once and cached. Put a ZeroOrderHold behind ``command``;
    `AddSafetyFilter` does.

    | port | size | what |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``reference`` | m | the controller's input |
    | ``estimate`` | 2q + 4 | the observer's `DisturbanceEstimate` |
    | ``held_input`` | m | the input applied now; read by the fallbacks only |
    | ``obstacles`` | | the perceived obstacles: see `PerceivedSpheres` |
    | ``command`` | m | the chosen input: finite and inside the input set, always |
    | ``fallback`` | m | the command where no solver's answer can be verified |
    | ``volume`` | 1 | V_v, what the volume row keeps positive; nan on failure |
    | ``slack`` | 1 | delta of (E54), at most 0; 0 unless the volume row gave way |
    | ``soft_slacks`` | | how far each soft row gave way, at most 0; nan without a QP |
    | ``barriers`` | N | h_i; nan for a state-dependent input limit or an empty slot |
    | ``levels`` | | phi_0, ..., phi_(r-1) of every barrier, one after the other (E3) |
    | ``authority`` | N | how far the inputs move each row; 0 when not at all (R33) |
    | ``row_margin`` | 1 | the rows' least until the next tick (E88); nan unless asked |
    | ``decay`` | 1 | the largest factor on a decay rate (E69); 1 where none grew |
    | ``backup`` | 2 | the share of a backup manoeuvre; 1 if its plan is certified |
    | ``status`` | 1 | a `FilterStatus` |
    | ``feasible_set`` | | A, b, ellipsoid: see `unpack_feasible_set` |

    Methods without an observer declare no port ``estimate``; without perceived barriers
    there is no port ``obstacles``.

    Attributes:
        barrier_rows: Returns the barriers' own rows at a context's state and time.
        feasible_set: Returns the feasible set there.
        volume: Returns V_v with its derivatives; None where it could not be computed.
        decision: Returns the chosen input and how it was found.
        row_names: The names of the feasible set's rows: input limits, then barriers.
    """

    @typed
    def __init__(
        self,
        model: ControlAffineModel,
        barriers: Sequence[Barrier | StateInputLimit],
        input_set: InputSet,
        settings: FilterSettings | None = None,
        *,
        bounds: DisturbanceBounds | None = None,
        estimate_gain: NotNegative = 0.0,
        longest_hold: NotNegative = 0.0,
        make_row_holder: Callable[..., RowHolder] | None = None,
        make_gate: Callable[..., Gate] | None = None,
    ) -> None:
        """Declares ports and cache entries.

        Args:
            model: The plant's f, g, E.
            barriers: The barriers and limits, one row each.
            input_set: The inputs that the actuators can deliver.
            settings: The method and its choices; `FilterSettings()` by default.
            bounds: delta1 and delta2 of the disturbance; none by default. delta2 times
                the hold is added to the error bound (E28, the certified error bound).
            estimate_gain: The observer's `estimate_gain` [1/s].
            longest_hold: The longest hold, if it can exceed the control period [s].
            make_row_holder: `vcbf_drake.between_ticks.HeldRows`; needed where the
                settings say ``between_ticks: certified``.
            make_gate: `vcbf_drake.between_ticks.BackupGate`; needed where they say
                ``infeasible: backup``.

        Raises:
            ValueError: An argument is outside what is allowed.
            ModelError: A barrier does not fit the model, or has no enclosure on
                intervals where a hold is to be certified.
        """
        super().__init__()
        # A copy: settings changed later change no filter.
        self.settings = settings = deepcopy(settings or FilterSettings())
        self.method = METHODS[settings.method]
        self.bounds = bounds or DisturbanceBounds(0.0, 0.0, 0.0)
        check_inputs(input_set, model.num_inputs, model.effort_limits)
        require(
            input_set.is_bounded or not self.method.has_volume_row,
            "input_set",
            "an infinite limit",
            f"finite for the volume barrier of {settings.method}; dob-cbf-qp has none",
        )
        self.model, self.input_set = model, input_set
        self.barrier_set = BarrierSet(
            model, barriers, by_chains=self.method.feasibility != "backup"
        )
        self.barriers = self.barrier_set.barriers
        known = settings.period, self.bounds.delta1
        self.backup_rows: BackupRows | None = None
        if self.method.feasibility == "backup":
            self.backup_rows = BackupRows(
                model,
                self.barriers,
                self.barrier_set,
                model.manoeuvres(*input_set.box_limits(), *known),
                settings.backup_margin,
            )
        names = (self.backup_rows or self.barrier_set).names
        self.row_names = (*input_set.row_names, *names)
        self._estimate_gain = estimate_gain
        hold = max(settings.period, longest_hold)
        covers_hold = settings.corrections.error_floor
        self.hold_margin = self.bounds.delta2 * hold if covers_hold else 0.0
        self.certified_hold = hold if settings.between_ticks == "certified" else 0.0
        self.row_holder: RowHolder | None = None
        if self.certified_hold:
            make = make_row_holder or _missing("between_ticks: certified")
            self.row_holder = make(model, self.barrier_set, hold, self.bounds.delta1)
        self._costs = settings.row_costs(len(names))
        self.gate: Gate | None = None
        if settings.infeasible == "backup":
            is_hard = np.isinf(self._costs.penalties[: self.barrier_set.size])
            make_gate = make_gate or _missing("infeasible: backup")
            self.gate = make_gate(model, self.barrier_set, input_set, *known, is_hard)
        self._frame = Frame.of(input_set, settings.input_weights)
        widening, solver = settings.volume.widening, settings.solver
        self._measure = VolumeMeasure(input_set, widening, solver)
        self._declare_inputs()
        self._declare_cache_entries()
        self._declare_outputs()

    def _declare_inputs(self) -> None:
        m, q = self.model.num_inputs, self.model.num_disturbances
        self._state = self.DeclareVectorInputPort("state", self.model.num_states)
        self._reference = self.DeclareVectorInputPort("reference", m)
        self._held_input = self.DeclareVectorInputPort("held_input", m)
        self._obstacles: InputPort | None = None
        if size := self.barrier_set.obstacles_size:
            self._obstacles = self.DeclareVectorInputPort("obstacles", size)
        self._estimate: InputPort | None = None
        if self.method.disturbance == "estimated":
            size = DisturbanceEstimate.packed_size(q)
            self._estimate = self.DeclareVectorInputPort("estimate", size)

    def _declare_cache_entries(self) -> None:
        needs = {self.time_ticket(), self._state.ticket()}
        if self._obstacles is not None:
            needs.add(self._obstacles.ticket())
        self.barrier_rows = self._cached("barrier rows", self._calc_rows, needs)
        needs = {self.barrier_rows.ticket}
        if self.backup_rows is not None:
            needs |= {self.time_ticket(), self._state.ticket()}
        if self._estimate is not None:
            needs.add(self._estimate.ticket())
        self.feasible_set = self._cached("feasible set", self._calc_feasible_set, needs)
        of_set = {self.feasible_set.ticket}
        self._determinant = self._cached(
            "det B", lambda c: self._measure(self.feasible_set(c)), of_set
        )
        needs = {self._determinant.ticket}
        if self.settings.volume.threshold is None:
            # xi, from the first tick on: known before anything else happens there, so
            # that the tick is decided once.
            self.DeclareDiscreteState([np.nan])
            self.DeclareInitializationUnrestrictedUpdateEvent(self._take_threshold)
            self.DeclarePeriodicDiscreteUpdateEvent(
                self.settings.period, 0.0, self._keep_threshold
            )
            needs.add(self.xd_ticket())
        self.volume = self._cached("volume", self._calc_volume, needs)
        needs = of_set | {self._reference.ticket(), self._held_input.ticket()}
        self._fallback = self._cached("fallback", self._calc_fallback, needs)
        if self.method.has_volume_row:
            needs = needs | {self.volume.ticket}
        self.decision = self._cached("decision", self._calc_decision, needs)

    def _declare_outputs(self) -> None:
        m = self.model.num_inputs
        N, num_levels = self.barrier_set.size, sum(self.barrier_set.degrees)
        decision, rows = self.decision, self.barrier_rows
        self._output("command", m, decision, lambda d: d.input)
        self._output("fallback", m, self._fallback, lambda u: u)
        self._output("slack", 1, decision, lambda d: [d.slack])
        if count := len(self._costs.soft):
            none = [np.nan] * count
            self._output(
                "soft_slacks", count, decision, lambda d: d.soft_slacks or none
            )
        self._output("status", 1, decision, lambda d: [d.status])
        self._output("decay", 1, decision, lambda d: [d.decay])
        if self.gate is not None:
            self._output(
                "backup", 2, decision, lambda d: [d.backup, bool(d.is_certified)]
            )
        self._output("row_margin", 1, decision, lambda d: [d.row_margin])
        self._output("volume", 1, self.volume, lambda v: [v.value if v else np.nan])
        self._output("barriers", N, rows, lambda r: r.value)
        self._output(
            "levels", num_levels, rows, lambda r: np.concatenate([[], *r.chain])
        )
        self._output(
            "authority",
            N,
            self.feasible_set,
            lambda found: self.of_barriers(found.rows.authority(self.input_set.scale)),
        )
        self.DeclareVectorOutputPort(
            "feasible_set",
            (len(self.row_names) + m) * (m + 1),
            self._calc_packed_feasible_set,
            {self.volume.ticket},
        )

    def of_barriers(self, of_rows: Array) -> Array:
        """Returns the maximum over each barrier's rows, (..., N)."""
        rows = self.backup_rows
        return of_rows if rows is None else rows.most_of_each(of_rows)

    def names_in_conflict(self, A: Array, b: Array) -> tuple[str, ...]:
        """Returns the names of rows of a feasible set that exclude each other.

        None are named where none surely do.
        """
        limiting = np.isfinite(b).nonzero()[0]
        proof = emptiness_certificate(A[limiting], b[limiting])
        conflict = () if proof is None else proof.conflict
        return tuple(self.row_names[limiting[row]] for row in conflict)

    def knowledge(self, context: Context) -> DisturbanceKnowledge:
        """Returns the knowledge of the disturbance that this method uses."""
        if self._estimate is None:
            is_worst = self.method.disturbance == "worst_case"
            bound = self.bounds.delta1 if is_worst else 0.0
            return DisturbanceKnowledge.constant(self.model.num_disturbances, bound)
        known = DisturbanceEstimate.unpack(self._estimate.Eval(context))
        return DisturbanceKnowledge(
            known.disturbance,
            known.rate,
            float(known.error_bound) + self.hold_margin,
            float(known.error_bound_rate),
            self._estimate_gain,
        )

    def programs(self, context: Context) -> TickPrograms | None:
        """Returns the tick's two programs, stated anew as they were solved.

        Also where the reference passes, which is the QP's solution; not where no QP's
        solution is the answer (INFEASIBLE, FAILED).
        """
        decision, feasible = self.decision(context), self.feasible_set(context)
        names, widening = self.row_names, self.settings.volume.widening
        return decision.qp and TickPrograms.of(decision.qp, feasible, names, widening)

    def _calc_rows(self, context: Context) -> BarrierRows:
        return self.barrier_set.rows(*self._situation(context))

    def _situation(self, context: Context) -> tuple[Array, float, Array | None]:
        """The measured state, the time and the perceived obstacles."""
        seen = None if self._obstacles is None else self._obstacles.Eval(context)
        return self._state.Eval(context), context.get_time(), seen

    def _calc_feasible_set(self, context: Context) -> FeasibleSet:
        rows = self.barrier_rows(context)
        if self.backup_rows is not None:
            x, t, seen = self._situation(context)
            rows = self.backup_rows.rows(x, t, rows, seen)
        return feasible_set(self.input_set, rows, self.knowledge(context), self._costs)

    def threshold(self, context: Context) -> float:
        """Returns xi: the settings', or a share of det B at the first tick with one."""
        if self.settings.volume.threshold is not None:
            return self.settings.volume.threshold
        kept = float(context.get_discrete_state_vector()[0])
        if not np.isnan(kept):
            return kept
        found = self._determinant(context)
        return threshold_of(found.value if found else np.nan, self.input_set.num_inputs)

    def _take_threshold(self, context: Context, state: State) -> EventStatus:
        state.get_mutable_discrete_state().set_value([self.threshold(context)])
        return EventStatus.Succeeded()

    def _keep_threshold(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value([self.threshold(context)])

    def _calc_volume(self, context: Context) -> Volume | None:
        determinant = self._determinant(context)
        return determinant and determinant.above(self.threshold(context))

    def _calc_decision(self, context: Context) -> FilterDecision:
        reference, held = self._wanted_and_held(context)
        (x, t, seen), settings = self._situation(context), self.settings
        if not all(map(math.isfinite, x.tolist())):
            return FilterDecision(self.input_set.project(held), FilterStatus.FAILED)
        feasible, row = self.feasible_set(context), None
        v = self.volume(context) if self.method.has_volume_row else None
        if v is not None and not v.is_on_plateau:  # There 0 <= lambda_Vv V_v.
            fixes, known = settings.corrections, feasible.known
            is_total, is_hard = fixes.total_derivative, fixes.exact_slack
            barrier = settings.volume
            row = volume_row(v, self.model, x, known, barrier, is_total, is_hard)
        is_known = v is not None and (row is None or row.is_finite)
        rates = settings.decay_rates(feasible, self.barriers)

        def choose(margin: Array | None = None) -> FilterDecision:
            return choose_input(
                feasible if margin is None else feasible.tightened(margin),
                row if is_known else None,
                reference,
                held,
                settings.infeasible,
                settings.solver,
                self._frame,
                rates,
            )

        decision, holder = choose(), self.row_holder
        if self.method.has_volume_row and not is_known:
            # The tick fails, and takes the input of the QP without the row.
            decision, holder = FilterDecision(decision.input, FilterStatus.FAILED), None
        if holder is None and self.gate is None:
            return decision
        tick = Tick(self.barrier_rows(context), x, t, feasible.known, seen)
        if holder is not None:
            decision = holder.lasting_decision(tick, decision, choose)
        return decision if self.gate is None else self.gate.decide(tick, decision)

    def _wanted_and_held(self, context: Context) -> tuple[Array, Array]:
        """The reference, and the held input: zeros where nothing is connected."""
        held = np.zeros(self.model.num_inputs)
        if self._held_input.HasValue(context):
            held = self._held_input.Eval(context)
        return self._reference.Eval(context), held

    def _calc_fallback(self, context: Context) -> Array:
        reference, held = self._wanted_and_held(context)
        return least_violation(self.feasible_set(context), self._frame, reference, held)

    def _calc_packed_feasible_set(self, context: Context, output: BasicVector) -> None:
        feasible, known = self.feasible_set(context), self.volume(context)
        output.SetFromVector(self._measure.packed(feasible, known))


def _missing(setting: str) -> NoReturn:
    raise ValueError(
        f"{setting}; it needs what vcbf_drake.between_ticks makes for it"
        " (AddSafetyFilter gives it)"
    )
