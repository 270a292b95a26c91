"""The stops of a car, its backup manoeuvres: straight ahead, or after a turn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.math import tanh

from vcbf_drake.checks import Array
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.model.manoeuvre import FOREVER, Box, Manoeuvre, Plan

# The least length of a cell [m], and the bounds of rounding at a box's ends and of an
# angle [rad].
_SHORTEST_CELL = 5e-4
_ROUNDING = 1e-12
_NO_ANGLE = 1e-9
# By how much [rad] and for how long [s] a car turns at most, and to which headings: to
# all multiples of a full turn over their number.
_MOST_TURN, _LONGEST_TURN = 0.5 * math.pi, 6.0
_HEADINGS = 16
# Below this speed the smooth law brakes less [m/s].
_SLOW = 0.1


def car_stops(
    mass: float, lower: Array, upper: Array, disturbance_bound: float, period: float
) -> list[Manoeuvre]:
    """Returns a car's stops: straight ahead, and after a turn to each heading.

    None of them is safe, and the list is empty, unless brakes and drive are stronger
    than d. The arguments are those of `CarStop`.
    """
    weakest = min(-float(lower[0]), float(upper[0])) / mass
    if not (disturbance_bound < weakest < math.inf and lower[1] <= 0.0 <= upper[1]):
        return []
    given = mass, lower, upper, disturbance_bound, period
    if not lower[1] < 0.0 < upper[1]:
        return [CarStop(*given)]
    headings = (k * (2.0 * math.pi / _HEADINGS) for k in range(_HEADINGS))
    return [CarStop(*given), *(CarStop(*given, heading) for heading in headings)]


class CarStop(Manoeuvre):
    r"""Full brake: while the car turns, then on a line, then corrections at rest (E91).

    On the line that the heading points along, the car is a point of speed v and
    acceleration a + d. With the weakest braking B = A - delta1 it comes to rest within

    .. math:: R_+(v) = \max(v, 0)^2 / (2 B_-), \quad R_-(v) = \max(-v, 0)^2 / (2 B_+)

    The line is cut into cells. The car never leaves the cells that meet [s - R_-, s +
    R_+], for the law takes the acceleration with the largest clearance from their ends.

    While it turns, its heading is known, and speed and position are in intervals that
    are followed from tick to tick (E93a).

    Args:
        mass: The mass of the car [kg].
        lower: Least force [N] and turn rate [rad/s].
        upper: Greatest ones.
        disturbance_bound: delta1 [m/s^2].
        period: The hold period [s].
        heading: The heading that it turns to, as fast as it can [rad]; without one it
            keeps its own. A law that turns may violate a limit of the input that
            depends on the state.

    Attributes:
        cell: Length of a cell [m].
    """

    first, aside = (0,), (1,)

    def __init__(
        self,
        mass: float,
        lower: Array,
        upper: Array,
        disturbance_bound: float,
        period: float,
        heading: float | None = None,
    ) -> None:
        self._mass, self._delta, self._period = mass, disturbance_bound, period
        self._brake, self._push = -float(lower[0]) / mass, float(upper[0]) / mass
        self._rates, self._heading = (float(lower[1]), float(upper[1])), heading
        self._brake_least = self._brake - disturbance_bound
        self._push_least = self._push - disturbance_bound
        both = (self._brake, self._push), (self._push, self._brake)
        self.cell = max(_SHORTEST_CELL, *(self._needed(*each) for each in both))
        self.horizon = 6.0 if heading is None else 0.0
        self.obeys_limits = heading is None

    def _needed(self, brake: float, push: float) -> float:
        """The length that leaves an input to a car at rest near both ends (E93)."""
        delta, T = self._delta, self._period
        most = (brake + delta) * T
        back = 0.5 * most * T + most**2 / (2.0 * (push - delta))
        ahead = (most + delta * T) * T
        ahead += (most + 2.0 * delta * T) ** 2 / (2.0 * (brake - delta))
        return back + ahead

    def input(self, state: Array) -> Array:
        """Returns the force of the brakes or the drive; see `Manoeuvre`."""
        x, y, v, psi = state.tolist()
        deadbeat = self._deadbeat(v)
        if turn := self._turn_left(psi):
            rate = min(max(turn / self._period, self._rates[0]), self._rates[1])
            return np.array([self._mass * deadbeat, rate])
        s = x * math.cos(psi) + y * math.sin(psi)
        low, high = self._cells(
            s - _stopping(-v, self._push_least), s + _stopping(v, self._brake_least)
        )

        def room(a: float) -> tuple[float, bool]:
            ahead, back = self._reach(v, a)
            before, behind = high * self.cell - s - ahead, s - back - low * self.cell
            return min(before, behind), before > 0.0  # The upper end is not theirs.

        ways = (deadbeat, -self._brake, self._push, self._delta, -self._delta)
        return np.array([self._mass * max(ways, key=room), 0.0])

    def detour(self, state: Array) -> float:
        """Returns the angle that it turns by [rad]; see `Manoeuvre`."""
        return abs(self._turn_left(float(state[3])))

    def law(self, x: Expressions) -> list[Any]:
        """Returns the weakest braking, smooth at rest; see `Manoeuvre`."""
        weakest = min(self._brake_least, self._push_least)
        return [-self._mass * weakest * tanh(x[2] / _SLOW), 0.0]

    def _deadbeat(self, v: float) -> float:
        """The acceleration that stops an undisturbed car in a period, in the limits."""
        return min(max(-v / self._period, -self._brake), self._push)

    def _turn_left(self, psi: float) -> float:
        """The angle that is left to turn by [rad]."""
        if self._heading is None:
            return 0.0
        turn = math.remainder(self._heading - psi, 2.0 * math.pi)
        return turn if abs(turn) > _NO_ANGLE else 0.0

    def _turns(self, psi: float, omega: float) -> Array | None:
        """The angles that it turns by in each period until it is on the line.

        None where there are too many.
        """
        first = omega * self._period
        left = self._turn_left(psi + first)
        if not (first or left):
            return np.zeros(0)
        step = self._period * self._rates[left > 0.0]
        count = math.ceil(left / step - _NO_ANGLE) if left else 0
        if abs(left) > _MOST_TURN or count * self._period > _LONGEST_TURN:
            return None
        turns = np.full(1 + count, step)
        if count:
            turns[-1] = left - (count - 1) * step
        turns[0] = first
        return turns

    def _reach(self, v: float, a: float) -> tuple[float, float]:
        """The reach ahead and back of a car that holds a and then stops (E92)."""
        T, delta = self._period, self._delta
        return (
            _farthest(v, a + delta, self._brake_least, T),
            _farthest(-v, delta - a, self._push_least, T),
        )

    def _cells(self, low: float, high: float) -> tuple[int, int]:
        """The cells that hold a stretch of the line; each is without its upper end."""
        return math.floor(low / self.cell), math.floor(high / self.cell) + 1

    def plan(self, state: Array, time: float, u: Array) -> Plan | None:
        """Returns the plan of an input; see `Manoeuvre`."""
        x, y, v, psi = state.tolist()
        force, omega = u.tolist()
        T, a = self._period, force / self._mass
        turns = self._turns(psi, omega)
        if turns is None:
            return None
        line = psi + float(turns.sum())
        c, s = math.cos(line), math.sin(line)
        along, across = x * c + y * s, y * c - x * s
        count, turning = len(turns), np.zeros((0, 4, 2))
        if count:
            turning, ends = self._turning(along, across, v, a, turns)
            (behind, ahead), places, (least, most) = ends.tolist()
            behind -= _stopping(-least, self._push_least)
            ahead += _stopping(most, self._brake_least)
        else:
            ahead, behind = self._reach(v, a)
            behind, ahead, places = along - behind, along + ahead, (across, across)
        first, last = self._cells(behind, ahead)
        # A faster car would not come to rest within its cells.
        length = 2.0 * (last - first) * self.cell * (1.0 + _ROUNDING)
        speeds = (
            -math.sqrt(length * self._push_least),
            math.sqrt(length * self._brake_least),
        )

        def box(i: int, k: int) -> Box:
            # On the line, across it, speed, and heading from the line's.
            i_line, k_line = first + max(i - count, 0), first + k - count
            stretch = (i_line * self.cell, k_line * self.cell)
            hull = [stretch, places, speeds, (0.0, 0.0)]
            if i < count:
                parts = turning[i:k]
                if k > count:
                    parts = np.concatenate([parts, [hull]])
                low, high = parts[..., 0].min(axis=0), parts[..., 1].max(axis=0)
                hull = list(zip(low.tolist(), high.tolist(), strict=True))
            ss, yy, vv, (left, right) = hull
            end = FOREVER if k > count else time + k * T
            return [
                _rotated(ss, yy, c, -s),
                _rotated(ss, yy, s, c),
                vv,
                (line + left, line + right),
                (time + min(i, count) * T, end),
            ]

        return Plan(count + last - first, box)

    def _turning(
        self, along: float, across: float, v: float, a: float, turns: Array
    ) -> tuple[Array, Array]:
        """Returns what a car is in while it turns, and at the end (E93a).

        Returns:
            The least and greatest coordinate along the line and across it, speed, and
            heading from the line's in each period, shape (N, 4, 2); and the first three
            at the end, shape (3, 2).
        """
        T, delta = self._period, self._delta
        speeds, rates = [(v, v)], []
        for j in range(len(turns)):
            low, high = speeds[-1]
            held = (self._deadbeat(low), self._deadbeat(high)) if j else (a, a)
            rates.append((held[0] - delta, held[1] + delta))
            speeds.append((low + rates[j][0] * T, high + rates[j][1] * T))
        V, w = np.array(speeds), np.array(rates)
        start, headings = V[:-1], np.cumsum(turns) - turns.sum()
        # The distance at the end of a period, and the least and greatest before that.
        at_end = (start + 0.5 * w * T) * T
        reverses = (start * w < 0.0) & (np.abs(start) < np.abs(w) * T)
        at_rest = np.where(reverses, -0.5 * start**2 / np.where(reverses, w, 1.0), 0.0)
        least = np.minimum(np.minimum(at_end, at_rest), 0.0)[:, 0]
        most = np.maximum(np.maximum(at_end, at_rest), 0.0)[:, 1]
        before_end = np.column_stack([least, most])
        fastest = np.abs(start).max(axis=1) + (max(self._brake, self._push) + delta) * T
        bends = 0.25 * T * np.abs(turns[:, np.newaxis]) * fastest[:, np.newaxis]
        bends = bends * [-1.0, 1.0]
        middles = (headings - 0.5 * turns)[:, np.newaxis]
        cells, ends = [], []
        for place, share in ((along, np.cos(middles)), (across, np.sin(middles))):
            moved = np.cumsum(np.sort(share * at_end, axis=1) + bends, axis=0)
            starts = place + np.vstack([np.zeros(2), moved[:-1]])
            cells.append(starts + np.sort(share * before_end, axis=1) + bends)
            ends.append(place + moved[-1])
        slowest = np.minimum(V[:-1, 0], V[1:, 0])
        cells.append(np.column_stack([slowest, np.maximum(V[:-1, 1], V[1:, 1])]))
        cells.append(np.sort(np.column_stack([headings - turns, headings]), axis=1))
        return np.stack(cells, axis=1), np.array([*ends, V[-1]])


def _stopping(v: float, weakest: float) -> float:
    """The stopping distance R(v) of the weakest braking [m]."""
    return v * v / (2.0 * weakest) if v > 0.0 else 0.0


def _farthest(v: float, w: float, weakest: float, T: float) -> float:
    """The maximum of v t + w t^2 / 2 + R(v + w t) over [0, T] (E92)."""
    times = [0.0, T]
    if v * w < 0.0 and -v / w < T:
        times.append(-v / w)
    return max((v + 0.5 * w * t) * t + _stopping(v + w * t, weakest) for t in times)


def _rotated(
    a: tuple[float, float], b: tuple[float, float], p: float, q: float
) -> tuple[float, float]:
    """The interval of p a + q b for a and b in intervals, rounded outwards."""
    least = min(p * a[0], p * a[1]) + min(q * b[0], q * b[1])
    most = max(p * a[0], p * a[1]) + max(q * b[0], q * b[1])
    slack = _ROUNDING * (1.0 + abs(least) + abs(most))
    return least - slack, most + slack
