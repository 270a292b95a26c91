"""SafetyFilter: one control tick of the method as a Drake system."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

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
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceEstimate
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety.backup_rows import BackupRows, manoeuvres_of
from vcbf_drake.safety.cached_system import CachedSystem, held_by
from vcbf_drake.safety.decider import Decider
from vcbf_drake.safety.feasible_set import (
    DisturbanceKnowledge,
    FeasibleSet,
    feasible_set,
    pack_feasible_set,
)
from vcbf_drake.safety.input_set import InputSet, check_inputs
from vcbf_drake.safety.qp import FilterDecision, FilterStatus, least_violation
from vcbf_drake.safety.row_holder import (
    Gate,
    MakeGate,
    MakeRowHolder,
    RowHolder,
    Tick,
    given,
)
from vcbf_drake.safety.row_names import RowNames
from vcbf_drake.safety.settings import METHODS, FilterSettings
from vcbf_drake.safety.tick_programs import TickPrograms
from vcbf_drake.safety.tick_qp import Frame
from vcbf_drake.safety.volume import Volume, VolumeMeasure, threshold_of
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
        make_row_holder: MakeRowHolder | None = None,
        make_gate: MakeGate | None = None,
    ) -> None:
        """Declares ports and cache entries.

        Args:
            model: The plant's f, g, E.
            barriers: The barriers and limits, one row each.
            input_set: The inputs that the actuators can deliver.
            settings: The method and its choices; `FilterSettings()` by default.
            bounds: delta1 and delta2 of the disturbance; none by default. delta2 times
                the hold bounds the change of the disturbance during a hold; it is added
                to the error bound (E28, the certified error bound).
            estimate_gain: The observer's `estimate_gain` [1/s].
            longest_hold: The longest hold, if it can exceed the control period [s].
            make_row_holder: `vcbf_drake.between_ticks.HeldRows`; needed where the
                settings say ``between_ticks: certified``.
            make_gate: `vcbf_drake.between_ticks.BackupGate`; needed where they say
                ``infeasible: backup``.

        Raises:
            ValueError: An argument is outside what is allowed.
            ModelError: A barrier does not fit the model; or there is a hold to certify,
                and the model or a barrier has no enclosure on intervals.
        """
        super().__init__()
        # A copy: settings changed later change no filter.
        self.settings = settings = deepcopy(settings or FilterSettings())
        self.method = METHODS[settings.method]
        self.bounds = bounds or DisturbanceBounds(0.0, 0.0, 0.0)
        check_inputs(input_set, model.num_inputs, model.effort_limits)
        if self.method.has_volume_row and not input_set.is_bounded:
            raise ValueError(
                "input_set: has an infinite limit, and the volume barrier of method"
                f" {settings.method} needs a bounded set of inputs; give limits, or"
                " take a method without volume barrier, as dob-cbf-qp"
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
                manoeuvres_of(model, input_set, *known),
                settings.backup_margin,
            )
        names = (self.backup_rows or self.barrier_set).names
        self.row_names = RowNames.of(input_set, names)
        self._estimate_gain = estimate_gain
        hold = max(settings.period, longest_hold)
        covers_hold = settings.corrections.error_floor
        self.hold_margin = self.bounds.delta2 * hold if covers_hold else 0.0
        self.certified_hold = hold if settings.between_ticks == "certified" else 0.0
        self.row_holder: RowHolder | None = None
        if self.certified_hold:
            make_row_holder = given("between_ticks: certified", make_row_holder)
            self.row_holder = make_row_holder(
                model, self.barrier_set, hold, self.bounds.delta1
            )
        self._costs = settings.row_costs(len(names))
        self.gate: Gate | None = None
        if settings.infeasible == "backup":
            is_hard = np.isinf(self._costs.penalties[: self.barrier_set.size])
            make_gate = given("infeasible: backup", make_gate)
            self.gate = make_gate(model, self.barrier_set, input_set, *known, is_hard)
        self._decide = Decider(
            model, self.barriers, input_set, settings, self.row_holder, self.gate
        )
        widening = settings.volume.widening
        self._measure = VolumeMeasure(input_set, widening, settings.solver)
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
        self._rows_entry = self._entry("barrier rows", self._calc_rows, needs)
        needs = {self._rows_entry.ticket()}
        if self.backup_rows is not None:
            needs |= {self.time_ticket(), self._state.ticket()}
        if self._estimate is not None:
            needs.add(self._estimate.ticket())
        self._feasible_entry = self._entry(
            "feasible set", self._calc_feasible_set, needs
        )
        self._determinant_entry = self._entry(
            "determinants", self._calc_determinant, {self._feasible_entry.ticket()}
        )
        needs = {self._determinant_entry.ticket()}
        if self.settings.volume.threshold is None:
            # xi, from the first tick on: known before anything else happens there, so
            # that the tick is decided once.
            self.DeclareDiscreteState([np.nan])
            self.DeclareInitializationUnrestrictedUpdateEvent(self._take_threshold)
            self.DeclarePeriodicDiscreteUpdateEvent(
                self.settings.period, 0.0, self._keep_threshold
            )
            needs.add(self.xd_ticket())
        self._volume_entry = self._entry("volumes", self._calc_volume, needs)
        needs = {self._reference.ticket(), self._held_input.ticket()}
        needs.add(self._feasible_entry.ticket())
        self._fallback_entry = self._entry("fallback", self._calc_fallback, needs)
        if self.method.has_volume_row:
            needs.add(self._volume_entry.ticket())
        self._decision_entry = self._entry("decision", self._calc_decision, needs)

    def _declare_outputs(self) -> None:
        m, n_rows = self.model.num_inputs, self.num_rows
        N, num_levels = self.barrier_set.size, sum(self.barrier_set.degrees)
        num_soft = len(self._costs.soft)
        decision = self._decision_entry
        self._output("command", m, decision, lambda d: d.input)
        self._output("fallback", m, self._fallback_entry, lambda u: u)
        self._output("slack", 1, decision, lambda d: [d.slack])
        if num_soft:
            none = [np.nan] * num_soft
            self._output(
                "soft_slacks", num_soft, decision, lambda d: d.soft_slacks or none
            )
        self._output("status", 1, decision, lambda d: [d.status])
        self._output("decay", 1, decision, lambda d: [d.decay])
        if self.gate is not None:
            self._output(
                "backup", 2, decision, lambda d: [d.backup, bool(d.is_certified)]
            )
        self._output("row_margin", 1, decision, lambda d: [d.row_margin])
        self._output(
            "volume", 1, self._volume_entry, lambda v: [v.value if v else np.nan]
        )
        rows = self._rows_entry
        self._output("barriers", N, rows, lambda r: r.value)
        self._output(
            "levels", num_levels, rows, lambda r: np.concatenate([[], *r.chain])
        )
        self._output(
            "authority",
            N,
            self._feasible_entry,
            lambda found: self.of_barriers(found.rows.authority(self.input_set.scale)),
        )
        self.DeclareVectorOutputPort(
            "feasible_set",
            n_rows * (m + 1) + m * (m + 1),
            self._calc_packed_feasible_set,
            {self._volume_entry.ticket()},
        )

    @property
    def num_rows(self) -> int:
        """The number of rows of the feasible set: input limits, then barriers."""
        return len(self.row_names)

    def of_barriers(self, of_rows: Array) -> Array:
        """Returns the maximum over each barrier's rows, shape (..., N).

        Args:
            of_rows: A number of every row, shape (..., rows).
        """
        if self.backup_rows is None:
            return of_rows
        return self.backup_rows.most_of_each(of_rows)

    def knowledge(self, context: Context) -> DisturbanceKnowledge:
        """Returns the knowledge of the disturbance that this method uses."""
        if self._estimate is None:
            is_worst = self.method.disturbance == "worst_case"
            bound = self.bounds.delta1 if is_worst else 0.0
            return DisturbanceKnowledge.constant(self.model.num_disturbances, bound)
        known = DisturbanceEstimate.unpack(self._estimate.Eval(context))
        return DisturbanceKnowledge.of(known, self.hold_margin, self._estimate_gain)

    def feasible_set(self, context: Context) -> FeasibleSet:
        """Returns the feasible set at the context's state and time."""
        value: FeasibleSet = held_by(self._feasible_entry, context)
        return value

    def volume(self, context: Context) -> Volume | None:
        """Returns V_v with its derivatives; None when it could not be computed."""
        value: Volume | None = held_by(self._volume_entry, context)
        return value

    def decision(self, context: Context) -> FilterDecision:
        """Returns the chosen input and how it was found."""
        value: FilterDecision = held_by(self._decision_entry, context)
        return value

    def programs(self, context: Context) -> TickPrograms | None:
        """Returns the tick's two programs, stated anew as they were solved.

        Both are stated where no solver was asked, too: the reference that satisfies
        every row is the QP's solution. Of a tick whose answer solves no QP (INFEASIBLE,
        FAILED) there are none.
        """
        decision, feasible = self.decision(context), self.feasible_set(context)
        if decision.qp is None:
            return None
        widening = self.settings.volume.widening
        return TickPrograms.of(decision.qp, feasible, self.row_names, widening)

    def barrier_rows(self, context: Context) -> BarrierRows:
        """Returns the barriers' own rows at the context's state and time."""
        value: BarrierRows = held_by(self._rows_entry, context)
        return value

    def _calc_rows(self, context: Context) -> BarrierRows:
        x, t = self._state.Eval(context), context.get_time()
        return self.barrier_set.rows(x, t, self._seen(context))

    def _seen(self, context: Context) -> Array | None:
        """The perceived obstacles."""
        return None if self._obstacles is None else self._obstacles.Eval(context)

    def _calc_feasible_set(self, context: Context) -> FeasibleSet:
        rows = self.barrier_rows(context)
        if self.backup_rows is not None:
            x, t = self._state.Eval(context), context.get_time()
            rows = self.backup_rows.rows(x, t, rows, self._seen(context))
        return feasible_set(self.input_set, rows, self.knowledge(context), self._costs)

    def threshold(self, context: Context) -> float:
        """Returns xi of the volume barrier.

        Where the settings have none, a share of what the set had at the first tick
        that had one; before it, of what it has.
        """
        if self.settings.volume.threshold is not None:
            return self.settings.volume.threshold
        kept = float(context.get_discrete_state_vector()[0])
        if not np.isnan(kept):
            return kept
        found: Volume | None = held_by(self._determinant_entry, context)
        return threshold_of(found.value if found else np.nan, self.input_set.num_inputs)

    def _take_threshold(self, context: Context, state: State) -> EventStatus:
        state.get_mutable_discrete_state().set_value([self.threshold(context)])
        return EventStatus.Succeeded()

    def _keep_threshold(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value([self.threshold(context)])

    def _calc_determinant(self, context: Context) -> Volume | None:
        return self._measure(self.feasible_set(context))

    def _calc_volume(self, context: Context) -> Volume | None:
        determinant: Volume | None = held_by(self._determinant_entry, context)
        return determinant and determinant.above(self.threshold(context))

    def _calc_decision(self, context: Context) -> FilterDecision:
        reference, held = self._reference.Eval(context), self._held(context)
        x, t = self._state.Eval(context), context.get_time()
        if not np.isfinite(x).all():
            return FilterDecision(self.input_set.project(held), FilterStatus.FAILED)
        rows, feasible = self.barrier_rows(context), self.feasible_set(context)
        tick = Tick(rows, x, t, feasible.known, self._seen(context))
        v = self.volume(context) if self.method.has_volume_row else None
        return self._decide(tick, feasible, v, reference, held)

    def _held(self, context: Context) -> Array:
        if not self._held_input.HasValue(context):
            return np.zeros(self.model.num_inputs)
        held: Array = self._held_input.Eval(context)
        return held

    def _calc_fallback(self, context: Context) -> Array:
        inputs, feasible = self.input_set, self.feasible_set(context)
        reference, held = self._reference.Eval(context), self._held(context)
        if not (feasible.is_finite and np.isfinite(reference).all()):
            return inputs.project(held)
        return least_violation(feasible, Frame.of(inputs), reference, held)

    def _calc_packed_feasible_set(self, context: Context, output: BasicVector) -> None:
        feasible, known = self.feasible_set(context), self.volume(context)
        frame, center = self._measure.ellipsoid(feasible, known)
        output.SetFromVector(pack_feasible_set(feasible.A, feasible.b, frame, center))
