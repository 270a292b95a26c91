"""The car's backup manoeuvre: braking on a straight line, then rest."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.math import tanh

from vcbf_drake.checks import Array
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.model.manoeuvre import FOREVER, Box, Manoeuvre, Plan

# The least length of a cell [m], and the bound of rounding at a box's ends.
_SHORTEST_CELL = 5e-4
_ROUNDING = 1e-12
# Below this speed the smooth law brakes less [m/s].
_SLOW = 0.1


class CarStop(Manoeuvre):
    r"""Full brake on a straight line, and small corrections at rest (E91).

    On the line that the heading points along, the car is a point of speed v and
    acceleration a + d. With the weakest braking B = A - delta1 it comes to rest within

    .. math:: R_+(v) = \max(v, 0)^2 / (2 B_-), \quad R_-(v) = \max(-v, 0)^2 / (2 B_+)

    The line is cut into cells. The car never leaves the cells that meet [s - R_-, s +
    R_+], for the law takes the acceleration with the largest clearance from their ends.

    Args:
        mass: The mass of the car [kg].
        lower: Least force [N] and turn rate [rad/s].
        upper: Greatest ones.
        disturbance_bound: delta1 [m/s^2].
        period: The hold period [s].

    Attributes:
        cell: Length of a cell [m].
    """

    first, aside = (0,), (1,)
    horizon = 6.0

    def __init__(
        self,
        mass: float,
        lower: Array,
        upper: Array,
        disturbance_bound: float,
        period: float,
    ) -> None:
        self._mass, self._delta, self._period = mass, disturbance_bound, period
        self._brake, self._push = -float(lower[0]) / mass, float(upper[0]) / mass
        self._brake_least = self._brake - disturbance_bound
        self._push_least = self._push - disturbance_bound
        both = (self._brake, self._push), (self._push, self._brake)
        self.cell = max(_SHORTEST_CELL, *(self._needed(*each) for each in both))

    @staticmethod
    def is_possible(lower: Array, upper: Array, mass: float, delta: float) -> bool:
        """Returns whether brakes and drive are both stronger than d."""
        weakest = min(-float(lower[0]), float(upper[0])) / mass
        return weakest > delta and lower[1] <= 0.0 <= upper[1] and weakest < math.inf

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
        s = x * math.cos(psi) + y * math.sin(psi)
        low, high = self._cells(
            s - _stopping(-v, self._push_least), s + _stopping(v, self._brake_least)
        )

        def room(a: float) -> tuple[float, bool]:
            ahead, back = self._reach(v, a)
            before, behind = high * self.cell - s - ahead, s - back - low * self.cell
            return min(before, behind), before > 0.0  # The upper end is not theirs.

        deadbeat = min(max(-v / self._period, -self._brake), self._push)
        ways = (deadbeat, -self._brake, self._push, self._delta, -self._delta)
        return np.array([self._mass * max(ways, key=room), 0.0])

    def law(self, x: Expressions) -> list[Any]:
        """Returns the weakest braking, smooth at rest; see `Manoeuvre`."""
        weakest = min(self._brake_least, self._push_least)
        return [-self._mass * weakest * tanh(x[2] / _SLOW), 0.0]

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

    def plan(self, state: Array, time: float, u: Array) -> Plan:
        """Returns the plan of an input; see `Manoeuvre`."""
        x, y, v, psi = state.tolist()
        force, omega = u.tolist()
        T, a, delta = self._period, force / self._mass, self._delta
        turn = omega * T
        c, s = math.cos(psi + turn), math.sin(psi + turn)
        along, across = x * c + y * s, y * c - x * s
        ahead, back = self._reach(v, a)
        # The effect of turning: the path bends, so it is shorter and beside the line.
        fastest = abs(v) + (abs(a) + delta) * T
        shorter, beside = fastest * T * turn**2, 0.5 * fastest * T * abs(turn)
        first, last = self._cells(along - back - shorter, along + ahead + shorter)
        # A faster car would not come to rest within its cells.
        length = 2.0 * (last - first) * self.cell * (1.0 + _ROUNDING)
        speeds = (
            -math.sqrt(length * self._push_least),
            math.sqrt(length * self._brake_least),
        )
        headings = (min(psi, psi + turn), max(psi, psi + turn))
        places = (across - beside, across + beside)

        def box(i: int, k: int) -> Box:
            stretch = ((first + i) * self.cell, (first + k) * self.cell)
            return [
                _rotated(stretch, places, c, -s),
                _rotated(stretch, places, s, c),
                speeds,
                headings,
                (time, FOREVER),
            ]

        return Plan(last - first, box)


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
