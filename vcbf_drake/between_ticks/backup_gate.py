"""BackupGate: every input that passes is followed by a certified plan."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
import math

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.barriers.rows import RowFunctions
from vcbf_drake.between_ticks.enclosures import RowEnclosures
from vcbf_drake.between_ticks.interval import Interval, as_interval, interval_function
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.manoeuvre import FOREVER, Box, Manoeuvre, Plan
from vcbf_drake.safety.decision import FilterDecision, FilterStatus, Tick
from vcbf_drake.safety.input_set import InputSet

# The number of bisections between a filter's input and a manoeuvre's.
_HALVINGS = 5
_TOLERANCE = 1e-9
# Into whiles of which lengths [s] a box's time is parted, and how many of each.
_WHILES = tuple(0.5 * 2.0**k for k in range(8))
_PARTS = 8


class BackupGate:
    """Keeps a certified plan at every tick: an input, and a manoeuvre after it.

    A plan is certified where every barrier is at least 0 in all its cells, by interval
    arithmetic (E90). From a certified plan the manoeuvre leads to another one, so a
    filter that starts with one keeps one for all time (Theorem 5).

    Attributes:
        manoeuvres: The plant's; the least detour is preferred, and of equal ones the
            first.
    """

    def __init__(
        self,
        model: ControlAffineModel,
        barrier_set: BarrierSet,
        input_set: InputSet,
        period: float,
        disturbance_bound: float,
        is_hard: NDArray[np.bool_] | None = None,
    ) -> None:
        """Makes the plant's manoeuvres.

        Args:
            model: The plant.
            barrier_set: The barriers.
            input_set: The input set, a box.
            period: The hold period [s].
            disturbance_bound: delta1 [m/s^2].
            is_hard: The rows that no plan may violate, (N,); all by default. A soft one
                may give way in the QP and counts for nothing here.

        Raises:
            ModelError: The plant has no manoeuvre that is safe under these limits, or a
                barrier has no enclosure on intervals; or the limits are no box.
        """
        limits = input_set.box_limits()
        found = model.manoeuvres(*limits, period, disturbance_bound)
        RowEnclosures.at(barrier_set, 0.0, np.zeros(barrier_set.obstacles_size))
        self._barriers, self._input_set = barrier_set, input_set
        everything = np.ones(barrier_set.size, dtype=bool)
        self._is_hard = everything if is_hard is None else is_hard
        is_limited = not np.all(np.array(barrier_set.degrees)[self._is_hard])
        self.manoeuvres = tuple(
            each for each in found if each.obeys_limits or not is_limited
        )
        self._disturbance_bound = disturbance_bound

    def decide(self, tick: Tick, decision: FilterDecision) -> FilterDecision:
        """Returns a decision with a certified plan; where there is none, one without.

        An input passes with a plan of any manoeuvre. Another one gives way to the input
        of the first manoeuvre that has a plan, by as little as it takes: only the
        `first` inputs, while one `aside` may go to a limit; if that is not enough, all.

        Args:
            tick: The tick of the decision.
            decision: The method's own.
        """
        decision = self._found(tick, decision)
        # Where the observer refutes the bound of d, nothing that rests on it is sure.
        known, most = tick.known, self._disturbance_bound
        if np.linalg.norm(known.estimate) - known.bound > most * (1.0 + _TOLERANCE):
            return decision._replace(is_certified=False)
        return decision

    def _found(self, tick: Tick, decision: FilterDecision) -> FilterDecision:
        if not np.isfinite(tick.state).all():
            return decision._replace(is_certified=False)
        check = _Check(tick, self._barriers, self._input_set, self._is_hard)
        u, laws = decision.input, []
        for each in sorted(self.manoeuvres, key=lambda m: m.detour(tick.state)):
            backup = _input_of(each, tick.state, self._input_set)
            if backup is None:
                continue
            laws.append((each, backup))
            if check.allows(backup) and check.passes(each, u):
                return decision._replace(is_certified=True)
        for each, backup in laws:
            if not check.passes(each, backup):
                continue
            u, share = check.nearest(each, u, backup)
            return decision._replace(
                input=u,
                backup=share,
                is_certified=True,
                qp=None,
            )
        if decision.status < FilterStatus.INFEASIBLE or not laws:
            return decision._replace(is_certified=False)
        return decision._replace(input=laws[0][1], backup=1.0, is_certified=False)


def _input_of(manoeuvre: Manoeuvre, state: Array, input_set: InputSet) -> Array | None:
    """A manoeuvre's input; None beyond what floats hold, or outside the input set."""
    try:
        u = np.asarray(manoeuvre.input(state), dtype=float)
    except (ArithmeticError, ValueError):
        return None
    if u.shape != (input_set.num_inputs,):
        raise ModelError(
            f"{type(manoeuvre).__name__}.input: expected shape"
            f" ({input_set.num_inputs},), got {u.shape}"
        )
    inside = input_set.project(u)
    excess = np.abs(u - inside)
    return inside if np.all(excess <= _TOLERANCE * (1.0 + np.abs(inside))) else None


class _Check:
    """The certification of the plans of one tick."""

    def __init__(
        self,
        tick: Tick,
        barrier_set: BarrierSet,
        input_set: InputSet,
        is_hard: NDArray[np.bool_],
    ) -> None:
        functions = barrier_set.functions_at(tick.time, tick.obstacles)
        hard = np.flatnonzero(is_hard).tolist()
        self._functions = [functions[i] for i in hard if functions[i].relative_degree]
        self._limits = [i for i in hard if not functions[i].relative_degree]
        self._tick, self._input_set = tick, input_set

    def allows(self, u: Array) -> bool:
        """Returns whether an input satisfies all that limits inputs; nan does not."""
        rows, limits, box = self._tick.rows, self._limits, self._input_set
        return bool(
            np.all(box.A @ u <= box.b + _TOLERANCE)
            and np.all(rows.A[limits] @ u <= rows.b[limits] + _TOLERANCE)
        )

    def passes(self, manoeuvre: Manoeuvre, u: Array) -> bool:
        """Returns whether an input's plan is certified (E90)."""
        tick = self._tick
        if not self.allows(u):
            return False
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                plan = manoeuvre.plan(tick.state, tick.time, u)
        except (ArithmeticError, ValueError):  # Beyond what floats hold.
            return False
        cells = self._cells_before_safety(plan) if plan else None
        if plan is None or cells is None:
            return False
        for i, each in enumerate(self._functions):
            if not _is_clear(each, plan, 0, cells):
                # The next plan is similar: the barrier that this one violates is
                # checked first.
                self._functions.insert(0, self._functions.pop(i))
                return False
        return True

    def nearest(
        self, manoeuvre: Manoeuvre, u: Array, end: Array
    ) -> tuple[Array, float]:
        """Returns a certified input that gives way by little, and by which share.

        Args:
            manoeuvre: The manoeuvre of the plans.
            u: An input without a certified plan.
            end: The manoeuvre's input, which has one.
        """

        def certified(v: Array) -> Array | None:
            v = self._input_set.project(v)  # Rounding may have taken it outside.
            return v if self.passes(manoeuvre, v) else None

        # To steer around an obstacle costs less than to brake before it ...
        partly = u.copy()
        partly[list(manoeuvre.first)] = end[list(manoeuvre.first)]
        ways = [u, *self._limits_of(u, manoeuvre.aside)]

        def beside(share: float) -> Array | None:
            for i, v in enumerate(ways):
                found = certified(v + share * (partly - u))
                if found is not None:
                    del ways[:i]  # They would fail at a smaller share, too.
                    return found
            return None

        found = _least_share(beside)
        if found is None:  # ... unless nothing but the manoeuvre itself is safe.
            found = _least_share(lambda share: certified(u + share * (end - u)))
            return found or (end, 1.0)
        v, share = found
        if ways[0] is u:
            return found
        straight = u + share * (partly - u)
        turned = _least_share(lambda part: certified(straight + part * (v - straight)))
        v, part = turned or (v, 1.0)
        return v, max(share, part)

    def _limits_of(self, u: Array, which: tuple[int, ...]) -> list[Array]:
        """An input with one of these at either end of what the limits leave it."""
        A = np.vstack([self._input_set.A, self._tick.rows.A[self._limits]])
        b = np.concatenate([self._input_set.b, self._tick.rows.b[self._limits]])
        spare, inputs = np.maximum(b - A @ u, 0.0), []
        for i in which:
            for sign in (-1.0, 1.0):
                slope, v = sign * A[:, i], u.copy()
                ahead = slope > 0.0
                most = float(np.min(spare[ahead] / slope[ahead], initial=math.inf))
                if math.isfinite(most):
                    v[i] += sign * most
                    inputs.append(v)
        return inputs

    def _cells_before_safety(self, plan: Plan) -> int | None:
        """The number of cells before the one from which on every barrier is clear."""
        if plan.beyond is None:
            return plan.num_cells
        if not self._is_safe_beyond(plan, plan.num_cells):
            return None
        low, high = 0, plan.num_cells
        while low + 1 < high:
            middle = (low + high) // 2
            if self._is_safe_beyond(plan, middle):
                high = middle
            else:
                low = middle
        return high

    def _is_safe_beyond(self, plan: Plan, cell: int) -> bool:
        box = plan.beyond(cell) if plan.beyond else None
        if box is None:
            return False
        return all(_value(each, box).low >= 0.0 for each in self._functions)


def _least_share(
    find: Callable[[float], Array | None],
) -> tuple[Array, float] | None:
    """Returns the result at nearly the least share from 0 to 1, and that share."""
    low, high = 0.0, 1.0
    best = find(high)
    if best is None:
        return None
    if (found := find(low)) is not None:
        return found, low
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if (found := find(middle)) is not None:
            best, high = found, middle
        else:
            low = middle
    return best, high


def _is_clear(function: RowFunctions, plan: Plan, first: int, last: int) -> bool:
    """Whether a barrier is at least 0 in all cells: in many at once, or each alone."""
    box = plan.box(first, last)
    value = _value(function, box)
    if value.low >= 0.0:
        return True
    if value.high < 0.0:
        return False
    is_single, is_for_ever = last - first <= 1, box[-1][1] >= FOREVER
    if (is_single or is_for_ever) and _is_clear_in_turn(function, box):
        return True
    if is_single:
        return False
    middle = (first + last) // 2
    return _is_clear(function, plan, first, middle) and _is_clear(
        function, plan, middle, last
    )


def _is_clear_in_turn(function: RowFunctions, box: Box) -> bool:
    """Whether a barrier that moves is at least 0 in a box, one while after the other.

    The instants that part them are so chosen that those for a later start lack none.
    """
    *states, (start, end) = box
    if _value(function, [*states, (start, start)]).low < 0.0:
        return False
    parted = {
        step * (math.floor(start / step) + i)
        for step in _WHILES
        for i in range(1, _PARTS + 1)
    }
    instants = [start, *sorted(each for each in parted if start < each < end), end]
    return len(instants) > 2 and all(
        _value(function, [*states, each]).low >= 0.0 for each in pairwise(instants)
    )


_UNKNOWN = Interval(-1e300, 1e300)


def _value(function: RowFunctions, box: Box) -> Interval:
    """Encloses a barrier over a box; unbounded where it is singular or overflows."""
    value = interval_function(function.value)
    try:
        if not all(low <= high for low, high in box):
            return _UNKNOWN
        arguments = [Interval(*each) for each in box]
        (h,) = value(*arguments, *function.parameters)
    except (ArithmeticError, ValueError):
        return _UNKNOWN
    except TypeError:
        raise ModelError(
            f"box of a plan: expected (least, greatest) of each state and, last, of the"
            f" time, got {box}"
        ) from None
    return as_interval(h)
