"""Faults that a scenario puts into its loop, and the hypotheses that they break."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated

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
    FirstOrderLowPassFilter,
    Gain,
    Saturation,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake.checks import check_share
from vcbf_drake.safety import Assumption, FilterStatus, InputSet
from vcbf_drake.simulation.sensors import chance, tick_number
from vcbf_drake.typed import (
    Checked,
    Finite,
    NotNegative,
    NotNegativeInt,
    Positive,
    Share,
)

if TYPE_CHECKING:
    from vcbf_drake.add_safety_filter import AddedSafetyFilter
    from vcbf_drake.simulation.scenario import Scenario


@dataclass
class StepGust(Checked):
    """A gust that starts and ends with a jump: not C2, and not declared.

    Attributes:
        amplitude: One value per disturbed channel [m/s^2].
        start: Start time [s].
        duration: Duration [s].
    """

    amplitude: list[Finite]
    start: Finite = 0.0
    duration: Positive = 1.0


@dataclass
class Faults(Checked):
    """Faults of plant, sensors, actuators and solver; none by default.

    The filter and its observer know of none of it. Noise is no fault but `noise`.

    Attributes:
        seed: Seed of the random faults.
        measurement_bias: Bias of the measured state, in its units, (n,); empty for
            none.
        measurement_delay: Delay of the measurements [s].
        measurement_loss: Probability that a tick's measurement is lost; the last one is
            kept.
        sight: Distance to an obstacle's surface below which it is seen [m]; 0 for
            always.
        actuator_lag: Time constant of the actuators [s].
        actuator_limit: Ratio of the true input limits to the declared ones.
        mass: Ratio of the true mass (with inertia and added mass) to the model's.
        drag: Ratio of the true drag to the model's.
        disturbance: Ratio of the true disturbance to the declared one.
        gusts: Gusts added to the disturbance.
        solver_failure: Probability that a tick's solvers fail.
        outage: Probability that the process of filter and observer is killed at a tick.
        outage_duration: Time until it runs again, with a fresh observer [s].
    """

    seed: NotNegativeInt = 0
    measurement_bias: list[Finite] = field(default_factory=list)
    measurement_delay: NotNegative = 0.0
    measurement_loss: Share = 0.0
    sight: NotNegative = 0.0
    actuator_lag: NotNegative = 0.0
    actuator_limit: Annotated[Positive, check_share] = 1.0
    mass: Positive = 1.0
    drag: NotNegative = 1.0
    disturbance: Finite = 1.0
    gusts: list[StepGust] = field(default_factory=list)
    solver_failure: Share = 0.0
    outage: Share = 0.0
    outage_duration: NotNegative = 0.5


def fault_assumptions(faults: Faults, noise: Sequence[float]) -> Iterator[Assumption]:
    """Yields the hypotheses that faults and noise break; none without.

    Args:
        faults: The faults of the loop.
        noise: Standard deviations of the measured states; empty for none.
    """
    whole = _hypotheses(Faults(), [])
    for (name, statement), numbers in _hypotheses(faults, noise).items():
        if numbers != whole[name, statement]:
            yield Assumption(name, statement, False, numbers, "no theorem applies")


def _hypotheses(
    faults: Faults, noise: Sequence[float]
) -> dict[tuple[str, str], dict[str, float]]:
    """The numbers of the faults by the hypotheses, and their statements, they break."""
    return {
        ("true measurement", "the measured state is the state, now"): {
            "largest bias": max(map(abs, faults.measurement_bias), default=0.0),
            "delay": faults.measurement_delay,
            "largest deviation": max(noise, default=0.0),
        },
        ("measurement at every tick", "no measurement is lost"): {
            "probability of loss": faults.measurement_loss
        },
        ("known obstacles", "every obstacle is known from the start"): {
            "sight": faults.sight
        },
        (
            "held input",
            "the plant receives the filter's input, held over the period",
        ): {
            "time constant": faults.actuator_lag,
            "share of limits": faults.actuator_limit,
        },
        (
            "plant as modelled",
            "xdot = f(x) + g(x) u + E d with the model's f and g (R18)",
        ): {"mass ratio": faults.mass, "drag ratio": faults.drag},
        ("disturbance as declared", "|d|, |d'|, |d''| within their bounds (E16)"): {
            "ratio": faults.disturbance,
            "step gusts": float(len(faults.gusts)),
        },
        ("solvers at every tick", "no solver fails"): {
            "probability of failure": faults.solver_failure
        },
        ("process at every tick", "filter and observer run without a break"): {
            "probability of being killed": faults.outage,
            "outage": faults.outage_duration if faults.outage > 0.0 else 0.0,
        },
    }


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
    """Returns the port of the disturbance that really acts."""
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


def faulty_actuator(
    builder: DiagramBuilder, scenario: Scenario, plant_input: InputPort
) -> InputPort:
    """Returns the port that takes the held input in the place of the plant's own."""
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
