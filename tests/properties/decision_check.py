"""What a decision of the filter promises, checked by arithmetic.

Nothing here is shared with the filter but its data, and no solver is asked. A decision
comes with enough to be verified from first principles: the point itself proves that
there is one, multipliers prove that none is better, or that there is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import chain, combinations
import math

import numpy as np

from tests.properties.first_order_optimality import (
    dot,
    rational,
    solve_exactly,
    suboptimality,
)
from vcbf_drake.checks import Array
from vcbf_drake.safety import FilterDecision, FilterStatus, InputSet
from vcbf_drake.safety.decision import InfeasiblePolicy
from vcbf_drake.safety.qp import VolumeRow

# What is done where no input satisfies the rows, of all that asks for nothing but them:
# the policy "backup" needs a plant, and a manoeuvre of it.
POLICIES: tuple[InfeasiblePolicy, ...] = ("stop", "least_violation", "hold", "decay")
# The filter said that no solver's answer was verified: no promise, but worth a count.
UNSOLVED = "solved"
# How far outside a row an input may be, as a distance in normalised inputs.
FEASIBILITY = 1e-9
# How much better another input may be, relative to the size of the cost's terms.
OPTIMALITY = 1e-8
# The same, relative to a cost that is mostly the penalty of slacks.
COST = 1e-9
# What (omega - 1)^2 costs, of a factor on a decay rate.
DECAY_PENALTY = 100.0
# A reference further away than this counts as one that is this far.
_FARTHEST = 1e6
# A row further away than this has no direction to speak of.
_FARTHEST_ROW = 1e20
# Multipliers of sum 1 balance rows of unit length when what is left is below this.
_BALANCE = 1e-11
_EPSILON = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Tick:
    """Everything that one decision depends on.

    Attributes:
        input_set: The inputs the actuators can produce.
        A: The barriers' rows, shape (N, m).
        b: Their right-hand sides, the disturbance's margin included, shape (N,).
        weights: How much a violation of each counts, shape (N,).
        volume_row: The volume barrier's, if there is one.
        reference: Shape (m,).
        held_input: Shape (m,).
        exact_slack: Whether the volume row gives way by as little as possible.
        policy: What is done where no input satisfies the barriers' rows.
        state: What the rows are of; empty where that is nothing in particular.
        rates: What the volume row needs beside it; empty where it is given.
        slopes: By how much a row opens for each unit its decay rate grows by, in shares
            of itself, shape (N,); 0 where it may not, empty where none may.
        growth: By how much each may grow, shape (N,).
        decays_always: Whether rates may grow where the rows have an input, too.
        knows_volume: Whether the volume row is known; else nothing is said of which
            input is nearest.
    """

    input_set: InputSet
    A: Array
    b: Array
    weights: Array
    volume_row: VolumeRow | None
    reference: Array
    held_input: Array
    exact_slack: bool
    policy: InfeasiblePolicy
    state: Array = field(default_factory=lambda: np.zeros(0))
    rates: Array = field(default_factory=lambda: np.zeros(0))
    slopes: Array = field(default_factory=lambda: np.zeros(0))
    growth: Array = field(default_factory=lambda: np.zeros(0))
    decays_always: bool = False
    knows_volume: bool = True

    @property
    def is_finite(self) -> bool:
        """Whether state, rows and reference are numbers, so that there is an answer."""
        parts = (self.state, self.A, self.b, self.reference)
        return all(bool(np.isfinite(part).all()) for part in parts)

    def normalised(self, u: Array) -> Array:
        """Returns an input as v, u = center + scale v."""
        v: Array = (u - self.input_set.center) / self.input_set.scale
        return v

    def far(self, u: Array) -> Array:
        """Returns the same, brought near from where no difference is left."""
        with np.errstate(over="ignore"):
            v = self.normalised(u)
        return v.clip(-_FARTHEST, _FARTHEST)


def broken_promises(tick: Tick, decision: FilterDecision) -> tuple[str, ...]:
    """Returns what the decision does not keep, a word or two each.

    Args:
        tick: What the filter was given.
        decision: What it answered.
    """
    if not np.isfinite([*decision.input, decision.slack]).all():
        return ("finite",)
    with np.errstate(over="ignore"):  # Rows of next to nothing are infinitely far.
        return tuple(dict.fromkeys(_broken(tick, decision)))


def _broken(tick: Tick, decision: FilterDecision) -> Iterator[str]:
    status, v = decision.status, tick.normalised(decision.input)
    limits = _Rows.of(tick.input_set, tick.input_set.A, tick.input_set.b)
    if limits.violation(v) > FEASIBILITY:
        yield "inside"
    if decision.backup > 0.0:  # A manoeuvre acts; the QP is not what is to be judged.
        if tick.policy != "backup":
            yield "backup"
        return
    if (status == FilterStatus.RELAXED) != (decision.slack < 0.0):
        yield "slack"
    if bool(decision.conflict) != (status == FilterStatus.INFEASIBLE):
        yield "conflict"
    if not tick.is_finite:
        if status != FilterStatus.FAILED:
            yield "status"
        elif not _is_held(tick, limits, v, decision.input):
            yield "fallback"
        return
    rows = _Rows.of(tick.input_set, tick.A, tick.b)
    if status == FilterStatus.FAILED:
        if np.isfinite(tick.rates).all():
            yield UNSOLVED
    elif status == FilterStatus.INFEASIBLE:
        yield from _broken_when_infeasible(tick, decision, limits, rows, v)
    else:
        if tick.decays_always:
            if not _is_least_decay(tick, decision, limits, rows, v):
                yield "decay"
        elif decision.decay > 1.0:
            yield "decay"
        elif rows.violation(v) > FEASIBILITY:
            yield "rows"
        if (
            status == FilterStatus.REFERENCE
            and (decision.input != tick.reference).any()
        ):
            yield "reference"
        if tick.knows_volume:
            yield from _broken_when_feasible(tick, decision, limits.and_(rows), v)


def _broken_when_infeasible(
    tick: Tick, decision: FilterDecision, limits: _Rows, rows: _Rows, v: Array
) -> Iterator[str]:
    if not _is_conflict(limits.and_(rows), list(decision.conflict)):
        yield "conflict"
    if tick.policy == "hold":
        if not _is_held(tick, limits, v, decision.input):
            yield "fallback"
    elif decision.decay > 1.0:
        if tick.policy != "decay" or tick.decays_always:
            yield "decay"
        elif not _is_least_decay(tick, decision, limits, rows, v):
            yield "decay"
    elif not _is_least_violation(tick.weights, limits, rows, v):
        yield "least violation"
    elif tick.policy == "decay" or tick.decays_always:
        if not _is_empty(limits.and_(_fastest(tick)), list(decision.conflict)):
            yield "decay"


def _fastest(tick: Tick) -> _Rows:
    """The rows with every decay rate as large as it may be."""
    room = tick.slopes * tick.growth if len(tick.slopes) else 0.0
    return _Rows.of(tick.input_set, tick.A, tick.b + room)


def _is_least_decay(
    tick: Tick, decision: FilterDecision, limits: _Rows, rows: _Rows, v: Array
) -> bool:
    """Whether (v, s) minimises |v - reference|^2 + |s|^2, s = 10 (omega - 1), (E69).

    At v each factor omega is the least that its row asks for.
    """
    grows = np.flatnonzero(tick.slopes > 0.0) if len(tick.slopes) else np.zeros(0, int)
    root, k = math.sqrt(DECAY_PENALTY), len(grows)
    slope = tick.slopes[grows] if k else np.zeros(0)
    asked = np.maximum(-rows.slack(v)[grows] * rows.unit[grows] / slope, 0.0)
    s, most = root * asked, root * tick.growth[grows] if k else np.zeros(0)
    both = limits.and_(rows)
    per_unit = np.zeros((len(both.h), k))
    at = len(limits.h) + grows
    per_unit[at, np.arange(k)] = -slope / (root * both.unit[at])
    sides = np.hstack([np.zeros((2 * k, len(v))), np.vstack([np.eye(k), -np.eye(k)])])
    G = np.vstack([np.hstack([both.G, per_unit]), sides])
    h = np.concatenate([both.h, most, np.zeros(k)])
    rounding = np.append(both.rounding, np.zeros(2 * k))
    length = np.maximum(np.linalg.norm(G, axis=1), 1.0)
    G, h, rounding = G / length[:, None], h / length, rounding / length
    point, gradient = np.append(v, s), np.append(v - tick.far(tick.reference), s)
    if np.max(G @ point - h - rounding, initial=0.0) > FEASIBILITY:
        return False
    if abs(decision.decay - 1.0 - np.max(asked, initial=0.0)) > COST * decision.decay:
        return False
    enough = OPTIMALITY * (1.0 + float(np.linalg.norm(gradient)))
    enough += COST * float(gradient @ gradient)
    reach = np.append(np.full(len(v), 2.0), most)
    return suboptimality(gradient, G, h, point, reach, enough) <= enough


def _is_empty(rows: _Rows, guess: list[int]) -> bool:
    """Whether the rows guessed, or others, m + 1 at most, exclude each other."""
    numbers, m = range(len(rows.h)), rows.G.shape[1]
    choices = (list(c) for k in range(1, m + 2) for c in combinations(numbers, k))
    return any(_is_conflict(rows, choice) for choice in chain([guess], choices))


def _broken_when_feasible(
    tick: Tick, decision: FilterDecision, rows: _Rows, v: Array
) -> Iterator[str]:
    if tick.volume_row is None:
        if decision.slack != 0.0:
            yield "slack"
        if not rows.is_optimal(v - tick.far(tick.reference), v, decision.input):
            yield "optimal"
        return
    a, c = tick.volume_row.a, tick.volume_row.c
    row_v = _Rows.of(tick.input_set, a[None], np.array([c]))
    unit, slack = float(row_v.unit[0]), float(row_v.slack(v)[0])
    if abs(decision.slack - unit * min(0.0, slack)) > FEASIBILITY * (1.0 + unit):
        yield "slack"
    if decision.status != FilterStatus.RELAXED and row_v.violation(v) > FEASIBILITY:
        yield "volume row"
    gradient = v - tick.far(tick.reference)
    if not tick.exact_slack:
        penalty = tick.volume_row.slack_penalty
        if not _is_least_penalty(rows, row_v, penalty, gradient, v):
            yield "optimal"
        return
    if slack < -FEASIBILITY and not rows.is_optimal(row_v.G[0], v, decision.input):
        yield "least slack"
    relaxed = rows.and_(row_v.relaxed(min(slack, 0.0)))
    if not relaxed.is_optimal(gradient, v, decision.input):
        yield "optimal"


@dataclass(frozen=True)
class _Rows:
    """Rows ``G v <= h`` of unit length in normalised inputs v.

    Attributes:
        G: Shape (n, m); zeros where a row has no direction.
        h: Shape (n,).
        unit: What the rows were divided by: their length, or 1, shape (n,).
        rounding: How well h can be known, shape (n,).
        A: The rows as they were given, for inputs as they are, shape (n, m).
        b: Their right-hand sides, shape (n,).
    """

    G: Array
    h: Array
    unit: Array
    rounding: Array
    A: Array
    b: Array

    @staticmethod
    def of(inputs: InputSet, A: Array, b: Array) -> _Rows:
        """The rows ``A u <= b``."""
        G, h = A * inputs.scale, b - A @ inputs.center
        size = np.abs(A) @ (np.abs(inputs.center) + inputs.scale) + np.abs(b)
        # By the largest entry first: squares of tiny entries would vanish.
        largest = np.abs(G).max(axis=1, initial=0.0)
        unit = np.where(largest > 0.0, largest, 1.0)
        G, h, size = G / unit[:, None], h / unit, size / unit
        length = np.maximum(np.linalg.norm(G, axis=1), 1.0)  # At least 1, or it is 0.
        G, h, size = G / length[:, None], h / length, size / length
        return _Rows(G, h, unit * length, 8.0 * _EPSILON * size, A, b)

    def and_(self, other: _Rows) -> _Rows:
        mine, others = vars(self).values(), vars(other).values()
        return _Rows(*(np.concatenate(pair) for pair in zip(mine, others, strict=True)))

    def relaxed(self, slack: float) -> _Rows:
        b = self.b - slack * self.unit
        return replace(self, h=self.h - slack, b=b)

    def slack(self, v: Array) -> Array:
        slack: Array = self.h - self.G @ v
        return slack

    def violation(self, v: Array) -> float:
        """The largest distance to a row's wrong side, beyond rounding."""
        return float(np.max(-self.slack(v) - self.rounding, initial=0.0))

    def exact_slack(self, u: Array) -> Array:
        """The slack at an input, of rows and inputs as they are, without rounding."""
        sums = (
            sum(Fraction(a) * Fraction(x) for a, x in zip(row, u.tolist(), strict=True))
            for row in self.A.tolist()
        )
        pairs = zip(self.b.tolist(), sums, self.unit.tolist(), strict=True)
        return np.array(
            [
                float((Fraction(b) - total) / Fraction(unit)) if np.isfinite(b) else b
                for b, total, unit in pairs
            ]
        )

    def is_optimal(self, gradient: Array, v: Array, u: Array) -> bool:
        """Whether no point that meets the rows is better to first order.

        Between rows that are all but opposite multipliers are so large that the
        rounding of v and h decides; then the slack is taken at u, exactly.
        """
        enough = OPTIMALITY * (1.0 + float(np.linalg.norm(gradient)))
        reach = np.full(len(v), 2.0)  # In the box |v_j| <= 1 that bounds all inputs.
        if suboptimality(gradient, self.G, self.h, v, reach, enough) <= enough:
            return True
        h, here = self.exact_slack(u), np.zeros(len(v))
        return suboptimality(gradient, self.G, h, here, reach, enough) <= enough


def _is_held(tick: Tick, limits: _Rows, v: Array, u: Array) -> bool:
    """Whether v is the input nearest to the held one."""
    if np.isfinite(tick.held_input).all():
        return limits.is_optimal(v - tick.far(tick.held_input), v, u)
    return bool(np.allclose(v, tick.normalised(tick.input_set.interior), atol=1e-9))


def _is_conflict(rows: _Rows, named: list[int]) -> bool:
    """Whether no input meets the rows that are named, and some point any fewer.

    Farkas: y >= 0 with y'G = 0, to rounding, and y'h < 0 even so on the box |v_j| <= 1.
    Without one of them the rows are independent, and so have a common point.
    """
    if not named:
        return False
    G, h = rows.G[named], rows.h[named]
    G = np.where(np.abs(h)[:, None] < _FARTHEST_ROW, G, 0.0)
    balanced = np.vstack([G.T, np.ones(len(named))])
    y = np.linalg.lstsq(balanced, np.append(np.zeros(len(G.T)), 1.0), rcond=None)[0]
    y = np.maximum(y, 0.0)
    imbalance = float(np.abs(y @ G).sum())
    is_proof = imbalance <= _BALANCE and float(y @ h) + imbalance < 0.0
    fewer = (np.delete(G, i, axis=0) for i in range(len(named)))
    is_known = is_proof and all(_are_independent(each) for each in fewer)
    return is_known or _is_exact_conflict(G, h)


def _is_exact_conflict(G: Array, h: Array) -> bool:
    """The same in rationals, of rows that are apart by less than floats round."""
    rows, right = list(map(rational, G)), rational(h)
    multipliers = []
    for i, row in enumerate(rows):  # Its own is 1.
        others = rows[:i] + rows[i + 1 :]
        gram = [[dot(a, b) for b in others] for a in others]
        y = solve_exactly(gram, [-dot(a, row) for a in others])
        if y is None:
            return False
        multipliers.append([*y[:i], Fraction(1), *y[i:]])
    y = max(multipliers, key=min)
    imbalance = sum(abs(dot(column, y)) for column in zip(*rows, strict=True))
    is_balanced = min(y) >= 0 and imbalance <= _BALANCE * sum(y)
    return is_balanced and dot(y, right) + imbalance < 0


def _are_independent(G: Array) -> bool:
    singular = np.linalg.svd(G, compute_uv=False)
    return len(G) <= len(G.T) and bool(singular.min(initial=1.0) > 4.0 * _EPSILON)


def _is_least_violation(weights: Array, limits: _Rows, rows: _Rows, v: Array) -> bool:
    """Whether the worst weighted violation t at v is the least of all.

    A linear program in (v, t): rows of the limits as they are, rows of the barriers
    G v - t / weight <= h, in units of t in which its coefficients are 1 or more.
    """
    weight = weights * rows.unit
    if not len(weight):
        return True
    worst = float(np.max(-weight * rows.slack(v), initial=0.0)) / weight.max()
    give = np.concatenate([np.zeros(len(limits.h)), weight.max() / weight])
    both = limits.and_(rows)
    no_reward = np.append(np.zeros(len(v)), -1.0)  # t >= 0
    G = np.vstack([np.column_stack([both.G, -give]), no_reward])
    h, length = np.append(both.h, 0.0), np.linalg.norm(G, axis=1)
    length[length == 0.0] = 1.0
    gradient = np.append(np.zeros(len(v)), 1.0)
    rounding = float(np.max(weight * rows.rounding)) / weight.max()
    enough = OPTIMALITY * (1.0 + worst) + rounding
    reach, point = np.append(np.full(len(v), 2.0), worst), np.append(v, worst)
    gap = suboptimality(gradient, G / length[:, None], h / length, point, reach, enough)
    return bool(gap <= enough)


def _is_least_penalty(
    rows: _Rows, volume_row: _Rows, penalty: float, gradient: Array, v: Array
) -> bool:
    """Whether (v, s) minimises |v - reference|^2 + s^2, where s = sqrt(M) delta."""
    root, unit = math.sqrt(penalty), float(volume_row.unit[0])
    s = root * min(float(volume_row.slack(v)[0]) * unit, 0.0)
    firm = np.column_stack([rows.G, np.zeros(len(rows.h))])
    G = np.vstack([firm, np.append(volume_row.G[0], 1.0 / (root * unit))])
    length = np.linalg.norm(G, axis=1)
    length[length == 0.0] = 1.0
    h = np.concatenate([rows.h, volume_row.h])
    slope, point = np.append(gradient, s), np.append(v, s)
    pull = float(np.linalg.norm(gradient) + abs(s) * root * unit)
    enough = OPTIMALITY * (1.0 + pull) + COST * float(slope @ slope)
    reach = np.append(np.full(len(v), 2.0), abs(s))
    gap = suboptimality(slope, G / length[:, None], h / length, point, reach, enough)
    return gap <= enough
