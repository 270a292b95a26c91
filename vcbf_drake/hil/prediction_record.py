"""PredictionRecord: what predicting the state buys, in millimetres."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from vcbf_drake.checks import Array
from vcbf_drake.hil.report import median_and_p99
from vcbf_drake.hil.state_predictor import StatePredictor

_REMEMBERED = 65_536
_PENDING = 256


class PredictionRecord:
    """Compares predicted positions with those that are measured later.

    Called at every tick. What a prediction was for lies between two measurements; the
    position there is taken from the straight line between them.

    Args:
        diagram: A hardware loop with a predictor.
        dimensions: How many states, the first ones, are the position.
    """

    def __init__(self, diagram: Diagram, dimensions: int) -> None:
        self._predictor: StatePredictor = diagram.GetSubsystemByName("state_predictor")
        self._dimensions = dimensions
        self._last: tuple[float, Array] | None = None
        # When, and where the vehicle should be then, and where it was seen.
        self._pending: deque[tuple[float, Array, Array]] = deque(maxlen=_PENDING)
        self._horizons: deque[float] = deque(maxlen=_REMEMBERED)
        self._errors: deque[float] = deque(maxlen=_REMEMBERED)
        self._moves: deque[float] = deque(maxlen=_REMEMBERED)

    def __call__(self, context: Context) -> None:
        """Looks back at the predictions that are due, and notes a new one."""
        mine = self._predictor.GetMyContextFromRoot(context)
        seen = self._position(self._predictor.GetInputPort("state").Eval(mine))
        now, horizon = context.get_time(), self._predictor.horizon(mine)
        if self._last is not None and now > self._last[0]:
            self._look_back(*self._last, now, seen)
        elif self._last is not None and now < self._last[0]:
            self._pending.clear()
        self._last = now, seen
        if horizon > 0.0:
            predicted = self._predictor.get_output_port().Eval(mine)
            self._pending.append((now + horizon, self._position(predicted), seen))
            self._horizons.append(horizon)

    def report(self) -> dict[str, Any]:
        """Returns how far ahead was predicted, and how far off with and without."""
        return {
            "ahead_ms": median_and_p99(1e3 * np.array(self._horizons)),
            "off_mm": median_and_p99(1e3 * np.array(self._errors)),
            "off_without_mm": median_and_p99(1e3 * np.array(self._moves)),
        }

    def _position(self, state: Array) -> Array:
        return state[: self._dimensions].copy()

    def _look_back(self, before: float, x_0: Array, now: float, x_1: Array) -> None:
        due = [each for each in self._pending if each[0] <= now]
        later = [each for each in self._pending if each[0] > now]
        self._pending = deque(later, maxlen=_PENDING)
        for time, predicted, seen in due:
            x = x_0 + (time - before) / (now - before) * (x_1 - x_0)
            self._errors.append(float(np.linalg.norm(predicted - x)))
            self._moves.append(float(np.linalg.norm(seen - x)))
