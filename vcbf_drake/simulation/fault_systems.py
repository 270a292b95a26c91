"""The faults of a scenario as systems in the wires of its loop."""

from __future__ import annotations

from collections.abc import Callable
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
from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.sensors import (
    DelayedMeasurement,
    LostMeasurements,
    chance,
    tick_number,
)

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario


class LostAnswers(LeafSystem):
    """Puts a fallback in the place of a filter's answer at the ticks that lose it.

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
        - is_lost
    """

    def __init__(self, num_inputs: int, is_lost: Callable[[float], bool]) -> None:
        """Declares the ports.

        Args:
            num_inputs: m.
            is_lost: Whether the answer of a time [s] is lost, the same for a whole
                tick.
        """
        super().__init__()
        self._is_lost = is_lost
        self._fallback = self.DeclareVectorInputPort("fallback", num_inputs)
        nothing = {"slack": 0.0, "status": FilterStatus.FAILED, "row_margin": np.nan}
        self._replace("command", num_inputs, self._fallback.Eval)
        for name, value in nothing.items():
            self._replace(name, 1, lambda _, value=value: [value])  # type: ignore[misc]
        self.DeclareVectorOutputPort(
            "is_lost",
            1,
            lambda context, output: output.SetFromVector([is_lost(context.get_time())]),
            {self.time_ticket()},
        )

    def _replace(
        self, name: str, size: int, fallback: Callable[[Context], object]
    ) -> None:
        answer = self.DeclareVectorInputPort(name, size)

        def calc(context: Context, output: BasicVector) -> None:
            lost = self._is_lost(context.get_time())
            output.SetFromVector((fallback if lost else answer.Eval)(context))

        needs = {self.time_ticket(), answer.ticket(), self._fallback.ticket()}
        self.DeclareVectorOutputPort(name, size, calc, needs)


def true_disturbance(
    builder: DiagramBuilder, faults: Faults, declared: OutputPort
) -> OutputPort:
    """Returns the port of the disturbance that really acts.

    Args:
        builder: Holds the source of the declared one.
        faults: What is wrong with it.
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
    """Returns the port of what reaches filter, observer and controller.

    Args:
        builder: Holds the plant, and its noise.
        scenario: With its faults.
        state: What a sensor without them would deliver.
    """
    faults, period, n = scenario.faults, scenario.period, state.size()
    if any(faults.measurement_bias):
        bias = builder.AddNamedSystem(
            "measurement_bias", ConstantVectorSource(np.array(faults.measurement_bias))
        )
        biased = Adder(2, n)
        state = _behind(builder, state, "biased_state", biased)
        builder.Connect(bias.get_output_port(), biased.get_input_port(1))
    if faults.measurement_delay > 0.0:
        late = DelayedMeasurement(n, period, faults.measurement_delay)
        state = _behind(builder, state, "delayed_measurement", late)
    if faults.measurement_loss > 0.0:
        lossy = LostMeasurements(n, period, faults.measurement_loss, faults.seed)
        state = _behind(builder, state, "lost_measurements", lossy)
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
    """Lets a filter's solvers fail, and its process be killed, where these are faults.

    While the process is down it asks for nothing, and its observer forgets all. Call it
    when everything that reads the filter's answers is connected: it reads them from
    here then.

    Args:
        builder: Holds the loop.
        scenario: With its faults.
        loop: The filter, its hold and its observer.
    """
    faults, period, inputs = scenario.faults, scenario.period, loop.filter.input_set
    answering: System = loop.filter
    if faults.solver_failure > 0.0:

        def solvers_fail(t: float) -> bool:
            tick = tick_number(t, period)
            return chance(faults.seed, tick) < faults.solver_failure

        failing = LostAnswers(inputs.num_inputs, solvers_fail)
        fallback = loop.filter.GetOutputPort("fallback")
        answering = _answer_for(builder, answering, "solver_failures", failing)
        builder.Connect(fallback, failing.GetInputPort("fallback"))
    if faults.outage > 0.0:
        length = max(1, -tick_number(-faults.outage_duration, period))

        def is_down(t: float) -> bool:
            tick = tick_number(t, period)
            return any(
                chance(faults.seed, each, 1) < faults.outage
                for each in range(max(0, tick - length + 1), tick + 1)
            )

        down = LostAnswers(inputs.num_inputs, is_down)
        _answer_for(builder, answering, "outages", down)
        nothing = ConstantVectorSource(inputs.project(np.zeros(inputs.num_inputs)))
        builder.AddNamedSystem("no_input", nothing)
        builder.Connect(nothing.get_output_port(), down.GetInputPort("fallback"))
        builder.Connect(
            down.GetOutputPort("is_lost"), loop.observer.GetInputPort("reset")
        )


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


def _answer_for(
    builder: DiagramBuilder, answering: System, name: str, instead: LostAnswers
) -> LostAnswers:
    """Adds a system behind another's ports of the same names, for all who read them."""
    readers = builder.connection_map()
    builder.AddNamedSystem(name, instead)
    for (reader, reads), (source, index) in readers.items():
        port = source.get_output_port(index)
        if source is answering and instead.HasOutputPort(port.get_name()):
            target = reader.get_input_port(reads)
            builder.Disconnect(port, target)
            builder.Connect(instead.GetOutputPort(port.get_name()), target)
    for port_name in ("command", "slack", "status", "row_margin"):
        builder.Connect(
            answering.GetOutputPort(port_name), instead.GetInputPort(port_name)
        )
    return instead
