"""The blimp's backup manoeuvres: climbing or sinking until the way is clear.

Sway has no actuator, so no law keeps a blimp at rest in a wind; heave has one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.model.manoeuvre import ANYWHERE, FOREVER, Box, Manoeuvre, Plan

if TYPE_CHECKING:
    from vcbf_drake.plants.blimp import BlimpParameters

# The horizon over which the way up or down is followed [s].
_HORIZON = 12.0
_ROUNDING = 1e-12


def blimp_climbs(
    parameters: BlimpParameters,
    lower: Array,
    upper: Array,
    disturbance_bound: float,
    period: float,
) -> list[Manoeuvre]:
    """Returns a blimp's ways up and down.

    None of them is safe, and the list is empty, unless no heading matters and heave is
    stronger than d. The arguments are those of `BlimpClimb`.
    """
    p, (m_x, m_y, m_z) = parameters, parameters.effective_masses
    weakest = min(-float(lower[1]), float(upper[1])) / m_z
    is_round = m_x == m_y and p.drag[0] == p.drag[1]
    may_rest = bool(np.all((lower <= 0.0) & (upper >= 0.0)))
    if not (is_round and may_rest and disturbance_bound < weakest < math.inf):
        return []
    given = p, lower, upper, disturbance_bound, period
    return [BlimpClimb(*given, is_up) for is_up in (True, False)]


class BlimpClimb(Manoeuvre):
    """Full heave and no surge (E94, a blimp's drift): a motion that no heading changes.

    Each coordinate then moves independently, p'' = a - c p' + d, and its range for |d|
    <= delta1 is known exactly. Once the blimp rises, it rises for all time: it is safe
    where nothing is above it.

    Args:
        parameters: Parameters of a blimp with equal masses, and drags, in surge and
            sway.
        lower: Least surge force [N], heave force [N] and yaw moment [N m].
        upper: Greatest ones.
        disturbance_bound: delta1 [m/s^2].
        period: The hold period [s].
        is_up: Whether it climbs; else it sinks.
    """

    first = (1,)
    horizon = 6.0

    def __init__(
        self,
        parameters: BlimpParameters,
        lower: Array,
        upper: Array,
        disturbance_bound: float,
        period: float,
        is_up: bool,
    ) -> None:
        p = parameters
        self._mass, _, self._heave_mass = p.effective_masses
        self._drag = p.drag[0] / self._mass
        self._heave_drag = p.drag[2] / self._heave_mass
        self._inertia, self._yaw_drag = p.yaw_inertia, p.yaw_drag
        self._lower, self._upper = lower, upper
        self._delta, self._period, self._is_up = disturbance_bound, period, is_up
        self._heave = float(upper[1] if is_up else lower[1])
        most = np.maximum(np.abs(lower), np.abs(upper))
        self._surge_most = float(most[0]) / self._mass + disturbance_bound
        self._heave_most = float(most[1]) / self._heave_mass + disturbance_bound
        self._num_cells = math.ceil(_HORIZON / period)

    def input(self, state: Array) -> Array:
        """Returns full heave, and a moment that stops the yawing; see `Manoeuvre`."""
        yaw_rate = float(state[7])
        stop = (self._yaw_drag - self._inertia / self._period) * yaw_rate
        moment = min(max(stop, float(self._lower[2])), float(self._upper[2]))
        return np.array([0.0, self._heave, moment])

    def law(self, x: Expressions) -> list[Any]:
        """Returns the heave that remains in the worst wind; see `Manoeuvre`."""
        wind = self._heave_mass * self._delta
        return [0.0, self._heave - wind if self._is_up else self._heave + wind, 0.0]

    def plan(self, state: Array, time: float, u: Array) -> Plan:
        """Returns the plan of an input; see `Manoeuvre`."""
        *places, yaw, vx, vy, vz, yaw_rate = state.tolist()
        surge, heave, moment = u.tolist()
        T, thrust = self._period, surge / self._mass
        middle = yaw + 0.5 * yaw_rate * T
        # The rotation of the thrust while it is held: the drag of every yaw rate is at
        # most the moment, or that of the first yaw rate.
        yawing = (2.0 * abs(moment) + self._yaw_drag * abs(yaw_rate)) / self._inertia
        turned = abs(thrust) * (0.5 * abs(yaw_rate) * T + 0.5 * yawing * T * T)
        c, s = thrust * math.cos(middle), thrust * math.sin(middle)
        held, led = heave / self._heave_mass, self._heave / self._heave_mass
        fixed = T, self._delta
        axes = [
            _Axis(places[0], vx, c, 0.0, self._drag, *fixed, turned),
            _Axis(places[1], vy, s, 0.0, self._drag, *fixed, turned),
            _Axis(places[2], vz, held, led, self._heave_drag, *fixed),
        ]
        most = (self._surge_most, self._surge_most, self._heave_most)
        bends = [
            a + max(axis.drag * abs(axis.speed), a) + turned * max(1.0, axis.drag * T)
            for axis, a in zip(axes, most, strict=True)
        ]
        anywhere = (-ANYWHERE, ANYWHERE)

        def box(i: int, k: int) -> Box:
            # Of many cells with each one's own, so that it contains their boxes.
            spans, ends = ((k - i) ** 2 + (k - i > 1)) * T * T, []
            for axis, bend in zip(axes, bends, strict=True):
                (low_i, high_i), (low_k, high_k) = axis.place(i), axis.place(k)
                # A curve leaves its chord by no more than this.
                slack = 0.125 * bend * spans
                slack += _ROUNDING * (1.0 + abs(low_i) + abs(high_k))
                ends.append((min(low_i, low_k) - slack, max(high_i, high_k) + slack))
            return [*ends, *5 * [anywhere], (time + i * T, time + k * T)]

        def beyond(i: int) -> Box | None:
            slowest, fastest = axes[2].velocity(i)
            if not (slowest > 0.0 if self._is_up else fastest < 0.0):
                return None  # It does not move in the right direction yet.
            # From the end of its cell, chord's slack and all, as later cells have one.
            low, high = box(i, i + 1)[2]
            height = (low, ANYWHERE) if self._is_up else (-ANYWHERE, high)
            around = [anywhere, anywhere, height, *5 * [anywhere]]
            return [*around, (time + i * T, FOREVER)]

        return Plan(self._num_cells, box, beyond)


class _Axis:
    """One coordinate under p'' = a - drag p' + d: `held` for a period, then `led`."""

    def __init__(
        self,
        place: float,
        speed: float,
        held: float,
        led: float,
        drag: float,
        period: float,
        disturbance: float,
        turned: float = 0.0,
    ) -> None:
        self.speed, self.drag = speed, drag
        self._start, self._held, self._led = place, held, led
        self._period, self._disturbance, self._turned = period, disturbance, turned
        decay, first, second = _moments(drag, period)
        self._place = place + first * speed + second * held
        self._speed = decay * speed + first * held

    def place(self, cell: int) -> tuple[float, float]:
        """The range of the position at the start of a cell."""
        _, _, spread = _moments(self.drag, cell * self._period)
        spread *= self._disturbance
        if cell == 0:
            return self._start - spread, self._start + spread
        _, first, second = _moments(self.drag, (cell - 1) * self._period)
        p = self._place + first * self._speed + second * self._led
        spread += self._turned * self._period * (self._period + first)
        return p - spread, p + spread

    def velocity(self, cell: int) -> tuple[float, float]:
        """The range of the velocity at the start of a cell after the first."""
        _, spread, _ = _moments(self.drag, cell * self._period)
        decay, first, _ = _moments(self.drag, max(cell - 1, 0) * self._period)
        v = decay * self._speed + first * self._led
        spread = spread * self._disturbance + decay * self._turned * self._period
        return v - spread, v + spread


def _moments(drag: float, t: float) -> tuple[float, float, float]:
    """exp(-c t), and its first and second integral over [0, t]."""
    decay, z = math.exp(-drag * t), drag * t
    if z < 1e-3:  # A series is used where the closed form cancels.
        first = t * (1.0 - z / 2.0 + z * z / 6.0 - z**3 / 24.0)
        return decay, first, t * t * (0.5 - z / 6.0 + z * z / 24.0 - z**3 / 120.0)
    first = -math.expm1(-z) / drag
    return decay, first, (t - first) / drag
