"""StatePredictor: the state at which a command will arrive over a slow link."""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
)

from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel


class StatePredictor(LeafSystem):
    """Predicts the state over the delays of the link, both ways.

    .. pydrake_system::

        name: StatePredictor
        input_ports:
        - state
        - delays
        - held_input
        - disturbance_estimate
        output_ports:
        - predicted_state

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the measured state |
    | ``delays`` | 2 | the age of that state, and how long a command takes [s] |
    | ``held_input`` | m | the command that was sent last |
    | ``disturbance_estimate`` | q | held over the prediction |
    | ``predicted_state`` | n | the state when a command sent now arrives |

    What the vehicle applies meanwhile is known: the commands that are on their way,
    each from when it was sent plus a command's delay. The model is integrated over each
    of them by a step of Runge and Kutta's fourth order.

    Args:
        model: The vehicle's f, g, E.
        period: The control period [s].
        longest: No longer delay than this is predicted over, each way [s].
    """

    def __init__(
        self, model: ControlAffineModel, period: float, longest: float
    ) -> None:
        super().__init__()
        self._model, self._longest = model, longest
        n, m, q = model.num_states, model.num_inputs, model.num_disturbances
        self._state = self.DeclareVectorInputPort("state", n)
        self._delays = self.DeclareVectorInputPort("delays", 2)
        self._held = self.DeclareVectorInputPort("held_input", m)
        self._estimate = self.DeclareVectorInputPort("disturbance_estimate", q)
        # When the last command was sent, then earlier ones: time and input, each.
        self._remembered = math.ceil(2.0 * longest / period) + 1
        self.DeclareDiscreteState([0.0])
        self.DeclareDiscreteState(np.full(self._remembered * (1 + m), np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)
        self.DeclareVectorOutputPort("predicted_state", n, self._calc)

    def _remember(self, context: Context, discrete: DiscreteValues) -> None:
        """Puts the last command to the earlier ones; the next one is sent now."""
        commands = self._sent(context)
        kept = np.full((self._remembered, commands.shape[1]), np.nan)
        kept[-len(commands) :] = commands[-self._remembered :]
        discrete.set_value(1, kept.ravel())
        discrete.set_value(0, [context.get_time() + self._delays.Eval(context)[0]])

    def _sent(self, context: Context) -> Array:
        """The commands that were sent, the oldest first: time and input, (K, 1 + m)."""
        m = self._model.num_inputs
        sent_at = context.get_discrete_state(0).CopyToVector()
        earlier = context.get_discrete_state(1).CopyToVector().reshape(-1, 1 + m)
        last = np.append(sent_at, self._held.Eval(context))
        # Neither what was never sent, nor what was sent before time went back.
        return np.vstack([earlier[earlier[:, 0] < sent_at], last])

    def horizon(self, context: Context) -> float:
        """Returns how far ahead is predicted: both delays together [s]."""
        return float(np.sum(self._usable_delays(context)))

    def _usable_delays(self, context: Context) -> Array:
        delays: Array = np.clip(self._delays.Eval(context), 0.0, self._longest)
        return delays

    def _calc(self, context: Context, output: BasicVector) -> None:
        x, d = self._state.Eval(context), self._estimate.Eval(context)
        for duration, u in self._applied(context):
            x = runge_kutta_step(self._model, x, u, d, duration)
        output.SetFromVector(x)

    def _applied(self, context: Context) -> Iterator[tuple[float, Array]]:
        """Yields how long which input is applied until a command sent now arrives."""
        sent, (_, delay) = self._sent(context), self._usable_delays(context)
        begin = context.get_time()
        end = begin + self.horizon(context)
        # A command is applied from when it arrives to when the next one does. What was
        # before the first one that is remembered is taken for that one.
        arrivals = np.clip(sent[:, 0] + delay, begin, end)
        arrivals[0] = begin
        for arrival, following, u in zip(
            arrivals, [*arrivals[1:], end], sent[:, 1:], strict=True
        ):
            if following > arrival:
                yield following - arrival, u


def runge_kutta_step(
    model: ControlAffineModel, x: Array, u: Array, d: Array, h: float
) -> Array:
    """Returns the state after a step of Runge and Kutta's fourth order.

    Args:
        model: f, g, E.
        x: The state at its beginning, (n,).
        u: The input, held, (m,).
        d: The disturbance, held, (q,).
        h: How long it is [s].
    """
    push = model.disturbance_matrix @ d

    def rate(at: Array) -> Array:
        return np.asarray(model.nominal_rate(at, u) + push)

    k_1 = rate(x)
    k_2 = rate(x + h / 2 * k_1)
    k_3 = rate(x + h / 2 * k_2)
    k_4 = rate(x + h * k_3)
    return np.asarray(x + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4))
