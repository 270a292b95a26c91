"""A car pressed against a wall that moves to and fro: where sampling costs the most."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.math import sin
from pydrake.symbolic import Expression
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from vcbf_drake.add_safety_filter import AddSafetyFilter
from vcbf_drake.barriers import Barrier
from vcbf_drake.between_ticks.certified_heights import certified_least_barrier
from vcbf_drake.disturbances import DisturbanceEstimate, DisturbanceSource
from vcbf_drake.disturbances.source import Constant
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.plants import Car
from vcbf_drake.safety import (
    FilterSettings,
    FilterStatus,
    InputSet,
)
from vcbf_drake.safety.settings import BetweenTicks

# The wall's way to either side [m] and its rate [rad/s]; the barrier's gains.
_WALL = (0.5, 2.0)
_GAINS = (4.0, 4.0)
# The car starts ahead of the wall and is driven back against it as hard as it goes.
_START = (0.6, 0.0, 0.0, 0.0)
_PUSH = (-11.0, 0.0)
_INPUTS = InputSet.box([-12.0, -2.0], [12.0, 2.0])
_DISTURBANCE = Constant([0.2])
_DURATION = 10.0
# How densely h is looked at, whatever the control rate [s].
_STEP = 5e-4

_OF_FILTER = ("barriers", "status", "volume", "slack")


def ahead_of_wall(x: Expressions, t: Expression, p: Expressions) -> Expression:
    """Returns h = x - a sin(omega t), the car's distance from the wall [m].

    Args:
        x: The car's state.
        t: The time [s].
        p: The amplitude a [m] and the rate omega [rad/s].
    """
    distance: Expression = x[0] - p[0] * sin(p[1] * t)
    return distance


def press_against_wall(rate: float, between_ticks: BetweenTicks) -> dict[str, Any]:
    """Returns how near the wall the car came; the keys are those of a run's summary.

    Args:
        rate: The control rate [Hz].
        between_ticks: What is asked of the rows between ticks.
    """
    builder, period = DiagramBuilder(), 1.0 / rate
    car = builder.AddNamedSystem("car", Car())
    push = builder.AddNamedSystem("push", ConstantVectorSource(_PUSH))
    slope = builder.AddNamedSystem(
        "slope", DisturbanceSource([_DISTURBANCE], _DURATION)
    )
    builder.Connect(slope.get_output_port(), car.GetInputPort("disturbance"))
    loop = AddSafetyFilter(
        builder,
        plant=car,
        reference=push.get_output_port(),
        barriers=[Barrier(ahead_of_wall, _GAINS, _WALL, "wall")],
        input_set=_INPUTS,
        bounds=slope.bounds,
        settings=FilterSettings(period=period, between_ticks=between_ticks),
    )
    ports = {
        "state": car.get_output_port(),
        **{name: loop.filter.GetOutputPort(name) for name in _OF_FILTER},
        "input": loop.filter.GetOutputPort("command"),
        "estimate": loop.observer.GetOutputPort("estimate"),
    }
    sinks = {
        name: LogVectorOutput(port, builder, period) for name, port in ports.items()
    }
    path = LogVectorOutput(car.get_output_port(), builder, _STEP)
    simulator = Simulator(builder.Build())
    integrator = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=_STEP, use_error_control=False
    )
    ApplySimulatorConfig(integrator, simulator)
    simulator.get_mutable_context().SetContinuousState(_START)
    simulator.AdvanceTo(_DURATION)

    context = simulator.get_context()
    log = {name: sink.FindLog(context).data().T for name, sink in sinks.items()}
    log |= DisturbanceEstimate.unpack(log["estimate"]).log_arrays()
    log["time"] = sinks["state"].FindLog(context).sample_times()
    seen = path.FindLog(context)
    heights = loop.filter.barrier_set.values_along(seen.data().T, seen.sample_times())
    return {
        "min_barrier": float(heights.min()),
        "certified_min_barrier": certified_least_barrier(
            loop.filter, log, len(log["time"]) - 1, period, slope.bounds.delta1
        ),
        "median_barrier": float(np.median(heights)),
        "min_volume": float(log["volume"].min()),
        "max_abs_slack": float(np.abs(log["slack"]).max()),
        "infeasible_ticks": int(np.sum(log["status"] == FilterStatus.INFEASIBLE)),
        "reached_at": None,
    }
