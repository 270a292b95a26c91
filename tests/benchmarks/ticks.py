"""CPU time of one control tick, stage by stage, and how it grows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
import time
from typing import Any

import numpy as np
from pydrake.symbolic import Expression, MakeVectorVariable

from vcbf_drake.barriers import Barrier
from vcbf_drake.barriers.functions import as_expressions
from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import FilterSettings, InputSet, SafetyFilter, VolumeBarrier
from vcbf_drake.safety.programs import SOLVERS
from vcbf_drake.safety.volume import VolumeMeasure

STAGES = ("rows", "feasible set", "volume", "QP", "tick")
Times = Mapping[str, tuple[float, float]]

_GAINS = (4.0, 3.0)
# The filter's own ticks are told apart by positions this far from each other [m].
_JITTER = 1e-3
# The values of the observer's ports: estimate, bound and rates.
_ERROR_BOUND = 0.01

# How a tick grows; what is not named is 3 obstacles, 2 of them cutting, 3 inputs.
GROWTH: Mapping[str, list[dict[str, Any]]] = {
    "obstacles": [
        {"num_obstacles": n, "num_cutting": min(n, 2)} for n in (1, 10, 100, 200)
    ],
    "obstacles, none cutting": [
        {"num_obstacles": n, "num_cutting": 0} for n in (1, 10, 100, 200)
    ],
    "obstacles that cut": [
        {"num_obstacles": 32, "num_cutting": n} for n in (0, 1, 2, 4, 8, 16, 32)
    ],
    "inputs": [{"num_inputs": m, "num_cutting": 2} for m in (1, 2, 3, 4, 6, 8, 16)],
    "states": [{"num_states": n} for n in (6, 12, 24)],
    "method": [
        {"method": method, "num_cutting": cutting}
        for method in ("cbf-qp", "dob-cbf-qp", "dob-vcbf-qp")
        for cutting in (0, 2)
    ],
    "a volume row that gives way; no input": [{"room": 0.003}, {"room": -0.05}],
}


def growth_markdown(title: str, ticks: int) -> Iterator[str]:
    """Yields the lines of one table of `GROWTH` [us]."""
    settings = GROWTH[title]
    names = [name.removeprefix("num_") for name in settings[0]]
    columns = [*names, *STAGES, "tick p99"]
    yield f"### {title}\n"
    yield f"| {' | '.join(columns)} |"
    yield "| ---: " * len(columns) + "|"
    for setting in settings:
        times = tick_times(**setting, ticks=ticks)
        numbers = [f"{times[stage][0]:.0f}" for stage in STAGES]
        cells = [*map(str, setting.values()), *numbers, f"{times['tick'][1]:.0f}"]
        yield f"| {' | '.join(cells)} |"


def tick_times(
    num_inputs: int = 3,
    num_obstacles: int = 3,
    num_cutting: int = 2,
    room: float | None = None,
    num_states: int | None = None,
    method: str = "dob-vcbf-qp",
    ticks: int = 200,
) -> Times:
    """Returns first decile and 99th percentile of CPU times, of `STAGES` each [us].

    The first decile, for it hardly moves with what else the machine does. The plant is
    a point mass with one force along each of its axes, at rest among
    balls; the reference flies at them. *rows* are evaluated by themselves; *feasible
    set* includes them; *volume* is V_v with its ellipsoid and derivatives; *QP* comes
    after both; *tick* is everything, as Drake evaluates the filter's input.

    Args:
        num_inputs: m.
        num_obstacles: N, one barrier row each.
        num_cutting: How many of them cut the box of inputs; 0 is the plateau.
        room: When given, the first two cutting obstacles face each other and leave a
            slab of inputs of this half-width, at most 1: near 0 the volume row gives
            way, and below it there is no input left.
        num_states: n, at least 2 m; the states beyond 2 m act on the accelerations.
        method: One of `vcbf_drake.safety.METHODS`.
        ticks: How many ticks are measured, after as many that are not.
    """
    generator = np.random.default_rng(0)
    n = num_states or 2 * num_inputs
    system = filter_among_balls(num_inputs, num_obstacles, num_cutting, room, n, method)
    spent = []
    for _ in range(2 * ticks):
        state = np.zeros(n)
        state[:num_inputs] = _JITTER * generator.normal(size=num_inputs)
        spent.append(_stages(system, state))
    percentiles = 1e6 * np.percentile(spent[ticks:], [10.0, 99.0], axis=0)
    return dict(zip(STAGES, map(tuple, percentiles.T), strict=True))


def solvers_alone(ticks: int = 200) -> float:
    """Returns the CPU time of a tick's two programs alone, solved anew [us].

    Of the tick that `tick_times` measures by default: what the filter's solver takes
    for its QP and its ellipsoid, as `SafetyFilter.programs` states them.

    Args:
        ticks: How many ticks are measured, after as many that are not.
    """
    system = filter_among_balls(3, 3, 2, None, 6, "dob-vcbf-qp")
    solver = SOLVERS[system.settings.solver]()
    generator = np.random.default_rng(0)
    spent = []
    for _ in range(2 * ticks):
        state = np.append(_JITTER * generator.normal(size=3), np.zeros(3))
        stated = system.programs(tick_context(system, state))
        if stated is not None and stated.ellipsoid is not None:
            both = (stated.qp, stated.ellipsoid)
            spent.append(sum(_timed(partial(solver.Solve, each)) for each in both))
    return float(1e6 * np.percentile(spent[ticks:], 10.0))


def agents_time(num_inputs: int, num_pairs: int, ticks: int) -> float:
    """Returns the CPU time of an ellipsoid of agents in a plane [us].

    Two inputs each; random pairs of them keep apart.

    Args:
        num_inputs: m.
        num_pairs: How many rows cut, each with four inputs in it.
        ticks: How many sets are measured, after one that is not.
    """
    generator, m = np.random.default_rng(0), num_inputs
    box, spent = InputSet.box(-np.ones(m), np.ones(m)), []
    measure = VolumeMeasure(box)
    for _ in range(ticks + 1):
        A = np.zeros((num_pairs, m))
        for row in A.reshape(num_pairs, m // 2, 2):
            pair = generator.choice(m // 2, 2, replace=False)
            angle = generator.uniform(0.0, 2.0 * np.pi)
            row[pair[0]] = np.cos(angle), np.sin(angle)
            row[pair[1]] = -row[pair[0]]
        b = generator.uniform(0.1, 1.0, num_pairs)
        spent.append(_timed(partial(measure.largest, A, b)))
    return float(1e6 * np.percentile(spent[1:], 10.0))


def filter_among_balls(
    num_inputs: int,
    num_obstacles: int,
    num_cutting: int,
    room: float | None,
    num_states: int,
    method: str,
) -> SafetyFilter:
    """Returns the filter of a point mass among balls; the arguments of `tick_times`."""
    volume = VolumeBarrier(threshold=0.02, gain=3.0, widening=1.0)
    return SafetyFilter(
        point_mass(num_inputs, num_states),
        _balls(num_inputs, num_obstacles, num_cutting, room),
        InputSet.box(-np.ones(num_inputs), np.ones(num_inputs)),
        FilterSettings(method=method, volume=volume),
        estimate_gain=4.0,
    )


def point_mass(num_inputs: int, num_states: int) -> ControlAffineModel:
    """Returns a point of unit mass with m positions, m velocities, and other states.

    The other n - 2 m states decay by themselves and act on every acceleration, and so
    does an unknown acceleration along each axis.
    """
    m, n = num_inputs, num_states
    state = MakeVectorVariable(n, "x")
    velocity, others = state[m : 2 * m], state[2 * m :]
    push = sum((0.1 * other for other in others), start=Expression(0.0))
    drift = [*velocity, *(push - 0.1 * v for v in velocity), *(-z for z in others)]
    actuated = np.zeros((n, m))
    actuated[m : 2 * m] = np.eye(m)
    expressions = as_expressions(actuated.flat).reshape(n, m)
    return ControlAffineModel(state, as_expressions(drift), expressions, actuated)


def _balls(m: int, count: int, cutting: int, room: float | None) -> list[Barrier]:
    """Balls around the origin, some so near that their rows cut the box |u_j| <= 1.

    At rest in the origin the row of a ball at p, of radius r, is 2 p'u <= k (|p|^2 -
    r^2): a half-space at the distance beta, when r^2 = |p|^2 - 2 beta |p| / k.
    """
    generator = np.random.default_rng(0)

    def function(x: Any, t: Any, p: Any) -> Any:
        offset = x[:m] - p[:m]
        return offset @ offset - p[m]

    balls = []
    for i in range(count):
        distance, beta = 40.0, 6.75
        if i < cutting:
            distance, beta = 4.0, generator.uniform(0.225, 0.6)
        direction = generator.normal(size=m)
        # All to one side, as obstacles ahead are: what they leave is never narrow.
        direction = np.abs(direction) / np.linalg.norm(direction)
        if room is not None and i < 2:
            # The rows keep the error bound as a reserve.
            beta = room + _ERROR_BOUND
            direction = (1 - 2 * i) * np.full(m, m**-0.5)
        square = distance**2 - 2.0 * beta * distance / _GAINS[1]
        parameters = [*(distance * direction), square]
        balls.append(Barrier(function, _GAINS, parameters, name=f"ball {i + 1}"))
    return balls


def _stages(system: SafetyFilter, state: Array) -> list[float]:
    """Returns the CPU time of every stage of one tick [s]."""
    whole, apart = tick_context(system, state), tick_context(system, state)
    return [
        _timed(lambda: system.barrier_set.rows(state, 0.0)),
        _timed(lambda: system.feasible_set(apart)),
        _timed(lambda: system.volume(apart)) if system.method.has_volume_row else 0.0,
        _timed(lambda: system.decision(apart)),
        _timed(lambda: system.decision(whole)),
    ]


def tick_context(system: SafetyFilter, state: Array) -> Any:
    """Returns a context of the filter at a state, the reference towards the balls."""
    context = system.CreateDefaultContext()
    values = {"state": state, "reference": np.full(system.model.num_inputs, 0.9)}
    for i in range(system.num_input_ports()):
        port = system.get_input_port(i)
        usual = 0.0 if port.get_name() == "held_input" else _ERROR_BOUND
        port.FixValue(context, values.get(port.get_name(), np.full(port.size(), usual)))
    return context


def _timed(function: Callable[[], Any]) -> float:
    started = time.thread_time()
    function()
    return time.thread_time() - started
