"""The faults of a scenario as systems in the wires of its loop."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
    System,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    FirstOrderLowPassFilter,
    Gain,
    Saturation,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.add_safety_filter import AddedSafetyFilter
from vcbf_drake.safety import FilterStatus, InputSet
from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.sensors import (
    UnreliableSensor,
    chance,
    tick_number,
)

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario


# The filter's answers, apart from the command, at a tick that loses them.
_NO_ANSWER = {"slack": 0.0, "status": FilterStatus.FAILED, "row_margin": np.nan}


class LostAnswers(LeafSystem):
    """Replaces a filter's answers at the ticks that lose them.

    .. pydrake_system::

        name: LostAnswers
        input_ports:
        - command
        - slack
        - status
        - row_margin
        - fallback
        output_ports:
        - command
        - slack
        - status
        - row_margin
        - is_down

    If solvers fail, the command is the fallback; while the process is down, and
    ``is_down`` is 1, it is the input nearest to 0. Both depend on the seed and the tick
    alone.
    """

    def __init__(self, faults: Faults, period: float, input_set: InputSet) -> None:
        """Declares the ports.

        Args:
            faults: The faults of solvers and process.
            period: Time between ticks [s].
            input_set: The inputs that the actuators can deliver.
        """
        super().__init__()
        m = input_set.num_inputs
        self._faults, self._period = faults, period
        self._outage_ticks = max(1, -tick_number(-faults.outage_duration, period))
        self._no_input = input_set.project(np.zeros(m))
        self._fallback = self.DeclareVectorInputPort("fallback", m)
        for name, size in {"command": m, **dict.fromkeys(_NO_ANSWER, 1)}.items():
            answer = self.DeclareVectorInputPort(name, size)
            needs = {self.time_ticket(), answer.ticket(), self._fallback.ticket()}
            calc = partial(self._calc, name, answer)
            self.DeclareVectorOutputPort(name, size, calc, needs)
        self.DeclareVectorOutputPort(
            "is_down", 1, self._calc_is_down, {self.time_ticket()}
        )

    def _calc(
        self, name: str, answer: InputPort, context: Context, output: BasicVector
    ) -> None:
        tick = tick_number(context.get_time(), self._period)
        is_down = self._is_down(tick)
        if not is_down and chance(self._faults.seed, tick) >= (
            self._faults.solver_failure
        ):
            output.SetFromVector(answer.Eval(context))
        elif name in _NO_ANSWER:
            output.SetFromVector([_NO_ANSWER[name]])
        elif is_down:
            output.SetFromVector(self._no_input)
        else:
            output.SetFromVector(self._fallback.Eval(context))

    def _calc_is_down(self, context: Context, output: BasicVector) -> None:
        tick = tick_number(context.get_time(), self._period)
        output.SetFromVector([self._is_down(tick)])

    def _is_down(self, tick: int) -> bool:
        return any(
            chance(self._faults.seed, each, 1) < self._faults.outage
            for each in range(max(0, tick - self._outage_ticks + 1), tick + 1)
        )


def true_disturbance(
    builder: DiagramBuilder, faults: Faults, declared: OutputPort
) -> OutputPort:
    """Returns the port of the disturbance that really acts.

    Args:
        builder: Holds the source of the declared one.
        faults: The faults of the disturbance.
        declared: The source's port.
    """
    acting = declared
    if not declared.size():
        return acting  # Nothing disturbs such a robot.
    if faults.disturbance != 1.0:
        gain = Gain(faults.disturbance, declared.size())
        acting = _behind(builder, acting, "scaled_disturbance", gain)
    for i, gust in enumerate(faults.gusts):
        times = [gust.start, gust.start + gust.duration]
        push, none = gust.amplitude, np.zeros(declared.size())
        course = PiecewisePolynomial.ZeroOrderHold(
            [times[0] - 1.0, *times, times[1] + 1.0],
            np.column_stack([none, push, none, none]),
        )
        source = builder.AddNamedSystem(f"gust_{i}", TrajectorySource(course))
        adder = Adder(2, declared.size())
        acting = _behind(builder, acting, f"with_gust_{i}", adder)
        builder.Connect(source.get_output_port(), adder.get_input_port(1))
    return acting


def faulty_measurement(
    builder: DiagramBuilder, scenario: Scenario, state: OutputPort
) -> OutputPort:
    """Returns the port of the measured state with its faults.

    Args:
        builder: Holds the plant, and its noise.
        scenario: With its faults.
        state: The state that a sensor without faults would deliver.
    """
    faults, n = scenario.faults, state.size()
    if any(faults.measurement_bias):
        bias = builder.AddNamedSystem(
            "measurement_bias", ConstantVectorSource(np.array(faults.measurement_bias))
        )
        biased = Adder(2, n)
        state = _behind(builder, state, "biased_state", biased)
        builder.Connect(bias.get_output_port(), biased.get_input_port(1))
    delay, loss = faults.measurement_delay, faults.measurement_loss
    if delay > 0.0 or loss > 0.0:
        sensor = UnreliableSensor(n, scenario.period, delay, loss, faults.seed)
        state = _behind(builder, state, "unreliable_sensor", sensor)
    return state


def faulty_actuator(
    builder: DiagramBuilder, scenario: Scenario, plant_input: InputPort
) -> InputPort:
    """Returns the port that takes the held input in the plant's place.

    Args:
        builder: Holds the plant.
        scenario: With its faults.
        plant_input: The plant's own port.
    """
    faults, limits = scenario.faults, scenario.input_set
    if faults.actuator_lag > 0.0:
        lag = FirstOrderLowPassFilter(faults.actuator_lag, plant_input.size())
        plant_input = _before(builder, plant_input, "actuator_lag", lag)
    if faults.actuator_limit < 1.0:
        least, most = (np.array(each) for each in (limits.lower, limits.upper))
        share = faults.actuator_limit
        saturation = Saturation(share * least, share * most)
        plant_input = _before(builder, plant_input, "actuator_limit", saturation)
    return plant_input


def lose_answers(
    builder: DiagramBuilder, scenario: Scenario, loop: AddedSafetyFilter
) -> None:
    """Adds the faults of a filter's solvers and process to its loop.

    While the process is down there is no command, and the observer is reset. Call this
    after all readers of the filter's answers are connected: it rewires them.

    Args:
        builder: Holds the loop.
        scenario: With its faults.
        loop: The filter, its hold and its observer.
    """
    faults, answering = scenario.faults, loop.filter
    if faults.solver_failure == faults.outage == 0.0:
        return
    readers = builder.connection_map()
    lost = LostAnswers(faults, scenario.period, answering.input_set)
    builder.AddNamedSystem("lost_answers", lost)
    for (reader, reads), (source, index) in readers.items():
        port = source.get_output_port(index)
        if source is answering and lost.HasOutputPort(port.get_name()):
            target = reader.get_input_port(reads)
            builder.Disconnect(port, target)
            builder.Connect(lost.GetOutputPort(port.get_name()), target)
    for name in ("command", *_NO_ANSWER, "fallback"):
        builder.Connect(answering.GetOutputPort(name), lost.GetInputPort(name))
    if faults.outage > 0.0:
        reset = loop.observer.GetInputPort("reset")
        builder.Connect(lost.GetOutputPort("is_down"), reset)


def _behind(
    builder: DiagramBuilder, port: OutputPort, name: str, system: System
) -> OutputPort:
    """Adds a system behind an output port; returns its own."""
    builder.AddNamedSystem(name, system)
    builder.Connect(port, system.get_input_port(0))
    return system.get_output_port()


def _before(
    builder: DiagramBuilder, port: InputPort, name: str, system: System
) -> InputPort:
    """Adds a system before an input port; returns its own."""
    builder.AddNamedSystem(name, system)
    builder.Connect(system.get_output_port(), port)
    return system.get_input_port()
