"""Where the CPU time of one control tick goes, and how it grows."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

import numpy as np
from pydrake.symbolic import Expression, MakeVectorVariable

from vcbf_drake.barriers import Barrier
from vcbf_drake.barriers.formula import as_expressions
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import observer_ports
from vcbf_drake.errors import EmptySetError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import InputSet, SafetyFilter
from vcbf_drake.safety.ellipsoid import Ellipsoid
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver

STAGES = ("rows", "feasible set", "ellipsoid", "volume", "QP", "tick")

_GAINS = (4.0, 3.0)
# The filter's own ticks are told apart by positions this far from each other [m].
_JITTER = 1e-3
# What the observer's ports say, estimate, bound and rates.
_ERROR_BOUND = 0.01


def tick_times(
    num_inputs: int = 3,
    num_obstacles: int = 3,
    num_cutting: int = 2,
    room: float | None = None,
    num_states: int | None = None,
    method: str = "dob-vcbf-qp",
    ticks: int = 200,
    seed: int = 0,
) -> dict[str, dict[str, float]]:
    """Returns median and 99th percentile of the CPU time of a tick's stages [us].

    The plant is a point mass with one force along each of its axes, at rest among
    balls; the reference flies at them. The stages are those of `STAGES`: ``rows``; the
    ``feasible set``, its rows included; the ``ellipsoid`` with its certificate; the
    ``volume`` V_v and its derivatives, its ellipsoid included; the ``QP`` with the
    volume row; and the whole ``tick``. All but rows and ellipsoid are as Drake
    evaluates them. Each is measured by itself, on the same data.

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
        seed: Of the obstacles' places and of the ticks' positions.

    Raises:
        ValueError: Fewer states than 2 m, more cutting obstacles than obstacles, or
            room without two cutting obstacles.
    """
    num_states = num_states or 2 * num_inputs
    if num_states < 2 * num_inputs or not 0 <= num_cutting <= num_obstacles:
        raise ValueError(
            f"{num_inputs} inputs, {num_states} states, {num_cutting} of"
            f" {num_obstacles} obstacles cutting: needs 2 states an input or more, and"
            " no more cutting obstacles than obstacles"
        )
    if room is not None and (num_cutting < 2 or not room <= 1.0):
        raise ValueError(
            f"room {room:g} with {num_cutting} cutting obstacles: it is at most 1, and"
            " between two"
        )
    generator = np.random.default_rng(seed)
    model = point_mass(num_inputs, num_states)
    barriers = _balls(num_inputs, num_obstacles, num_cutting, generator, room)
    box = InputSet.box(-np.ones(num_inputs), np.ones(num_inputs))
    safety_filter = SafetyFilter(model, barriers, box, method=method, estimate_gain=4.0)
    solver = InscribedEllipsoidSolver(box)
    spent: dict[str, list[float]] = {stage: [] for stage in STAGES}
    for _ in range(2 * ticks):
        state = np.zeros(num_states)
        state[:num_inputs] = _JITTER * generator.normal(size=num_inputs)
        for stage, seconds in _stages(safety_filter, solver, state).items():
            spent[stage].append(1e6 * seconds)
    return {
        stage: {
            "median": float(np.median(times[ticks:])),
            "p99": float(np.percentile(times[ticks:], 99.0)),
        }
        for stage, times in spent.items()
    }


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


def _balls(
    m: int,
    count: int,
    cutting: int,
    generator: np.random.Generator,
    room: float | None = None,
) -> list[Barrier]:
    """Balls around the origin, some so near that their rows cut the box |u_j| <= 1.

    At rest in the origin the row of a ball at p, of radius r, is 2 p'u <= k (|p|^2 -
    r^2): a half-space at the distance beta, when r^2 = |p|^2 - 2 beta |p| / k.
    """

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


def _stages(
    safety_filter: SafetyFilter, solver: InscribedEllipsoidSolver, state: Array
) -> dict[str, float]:
    """Returns the CPU time of every stage of one tick [s]."""
    contexts = [_context(safety_filter, state) for _ in range(2)]
    apart = contexts[1]
    tick, _ = _timed(lambda: safety_filter.decision(contexts[0]))
    rows, _ = _timed(lambda: safety_filter.barrier_set.rows(state, 0.0))
    feasible_set, feasible = _timed(lambda: safety_filter.feasible_set(apart))
    ellipsoid = volume = 0.0
    if safety_filter.method.volume:
        k = feasible.num_input_rows
        A, b = feasible.A_v[k:], feasible.b_v[k:]
        ellipsoid, _ = _timed(lambda: _solved(solver, A, b))
        volume, _ = _timed(lambda: safety_filter.volume(apart))
    qp, _ = _timed(lambda: safety_filter.decision(apart))
    times = rows, feasible_set, ellipsoid, volume, qp, tick
    return dict(zip(STAGES, times, strict=True))


def _solved(solver: InscribedEllipsoidSolver, A: Array, b: Array) -> Ellipsoid | None:
    try:
        return solver.solve(A, b)
    except EmptySetError:
        return None


def _context(safety_filter: SafetyFilter, state: Array) -> Any:
    model = safety_filter.model
    context = safety_filter.CreateDefaultContext()
    values = {
        "state": state,
        "reference": np.full(model.num_inputs, 0.9),
        "held_input": np.zeros(model.num_inputs),
    }
    for name, size in observer_ports(model.num_disturbances):
        if safety_filter.HasInputPort(name):
            values[name] = np.full(size, _ERROR_BOUND)
    for name, value in values.items():
        safety_filter.GetInputPort(name).FixValue(context, value)
    return context


def _timed(function: Callable[[], Any]) -> tuple[float, Any]:
    started = time.thread_time()
    result = function()
    return time.thread_time() - started, result
