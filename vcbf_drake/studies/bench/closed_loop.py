"""The whole run: one Drake loop, whoever filters in it."""

from __future__ import annotations

import time

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    LinearSystem,
    LogVectorOutput,
    MatrixGain,
    ZeroOrderHold,
)

from vcbf_drake.checks import Array
from vcbf_drake.studies.bench.problem import (
    A_PLANT,
    B_PLANT,
    GOAL_GAINS,
    NUM_INPUTS,
    NUM_STATES,
    PERIOD,
    START,
)
from vcbf_drake.studies.bench.route import Filter


class RouteFilter(LeafSystem):
    """Somebody's filter as a Drake system; it coasts where that finds no input."""

    def __init__(self, route: Filter) -> None:
        super().__init__()
        self._route = route
        self._state = self.DeclareVectorInputPort("state", NUM_STATES)
        self._reference = self.DeclareVectorInputPort("reference", NUM_INPUTS)
        self.DeclareVectorOutputPort("input", NUM_INPUTS, self._calc_input)

    def _calc_input(self, context: Context, output: BasicVector) -> None:
        u = self._route(self._state.Eval(context), self._reference.Eval(context))
        output.SetFromVector(np.zeros(NUM_INPUTS) if u is None else u)


def fly(safety_filter: LeafSystem, duration: float) -> tuple[float, Array]:
    """Runs the loop from the start, logging its state.

    Args:
        safety_filter: Has the ports ``state``, ``reference`` and ``input``.
        duration: How long [s].

    Returns:
        The CPU time [s] and the states at the ticks, shape (T, 6).
    """
    builder = DiagramBuilder()
    identity = np.eye(NUM_STATES)
    plant = builder.AddSystem(
        LinearSystem(A_PLANT, B_PLANT, identity, np.zeros((NUM_STATES, NUM_INPUTS)))
    )
    controller = builder.AddSystem(
        MatrixGain(-np.kron(GOAL_GAINS, np.eye(NUM_INPUTS)))  # Towards the origin.
    )
    builder.AddSystem(safety_filter)
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, NUM_INPUTS))
    state = plant.get_output_port()
    builder.Connect(state, controller.get_input_port())
    builder.Connect(state, safety_filter.GetInputPort("state"))
    builder.Connect(
        controller.get_output_port(), safety_filter.GetInputPort("reference")
    )
    builder.Connect(safety_filter.GetOutputPort("input"), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_input_port())
    sink = LogVectorOutput(state, builder, PERIOD)
    simulator = Simulator(builder.Build())
    simulator.get_mutable_context().SetContinuousState(START)
    simulator.Initialize()
    started = time.process_time()
    simulator.AdvanceTo(duration)
    spent = time.process_time() - started
    return spent, sink.FindLog(simulator.get_context()).data().T.copy()
