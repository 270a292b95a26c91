"""The benchmark beside peers: CPU time and error of every route that is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
import time
from typing import Any

import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.primitives import LinearSystem

from tests.benchmarks import peers, reference
from tests.benchmarks.problem import (
    A_PLANT,
    B_PLANT,
    CENTERS,
    GAINS,
    LIMIT,
    NUM_INPUTS,
    NUM_STATES,
    RADII,
    THRESHOLD,
    VOLUME_GAIN,
    Instance,
    polytope,
)
from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import (
    FilterSettings,
    FilterStatus,
    InputSet,
    SafetyFilter,
    VolumeBarrier,
)

OURS = "vcbf_drake"
# What is built or compiled at first use is not a tick's cost.
_WARM_UP = 20


@dataclass(frozen=True)
class Route:
    """One way to do a task.

    Attributes:
        name: What people call it.
        make: Returns the function; raises ImportError when its package is missing.
    """

    name: str
    make: Callable[[], Callable[..., Any]]


@dataclass(frozen=True)
class Task:
    """One thing that several routes do.

    Attributes:
        title: Its heading.
        routes: Who does it, ours first.
        arguments: What a route is called with.
        answer: The right answer; None where there is none.
        error: How far an answer is from the right one.
        unit: The error's unit.
    """

    title: str
    routes: Sequence[Route]
    arguments: Callable[[Instance], tuple[Any, ...]]
    answer: Callable[[Instance], Any]
    error: Callable[[Any, Any], float]
    unit: str


@dataclass(frozen=True)
class Cost:
    """CPU times and errors of a route on the instances of a task.

    Attributes:
        name: The route's.
        median: Of the CPU times [ms].
        p99: Their 99th percentile [ms].
        worst: The largest error where both route and reference have an answer.
        failed: In how many feasible instances the route found nothing.
        infeasible: How many instances have no answer.
        noticed: In how many of these the route said so.
    """

    name: str
    median: float
    p99: float
    worst: float
    failed: int
    infeasible: int
    noticed: int


def safety_filter(method: str) -> SafetyFilter:
    """Returns our filter; a method without observer, as the plant has no wind."""
    plant = LinearSystem(
        A_PLANT, B_PLANT, np.eye(NUM_STATES), np.zeros((NUM_STATES, NUM_INPUTS))
    )
    volume = VolumeBarrier(THRESHOLD, VOLUME_GAIN, widening=1.0)
    return SafetyFilter(
        ControlAffineModel.from_system(plant),
        [
            SphereObstacle(center, radius, form="squared").barrier(GAINS, [0, 1, 2])
            for center, radius in zip(CENTERS, RADII, strict=True)
        ],
        InputSet.box(-LIMIT * np.ones(NUM_INPUTS), LIMIT * np.ones(NUM_INPUTS)),
        FilterSettings(method=method, volume=volume),
    )


def our_tick(method: str) -> Callable[[Array, Array], Array | None]:
    """Returns our tick: ports are set, the decision is read."""
    system = safety_filter(method)
    context = system.CreateDefaultContext()

    def tick(state: Array, wanted: Array) -> Array | None:
        _fix(system, context, state, wanted)
        decision = system.decision(context)
        found = decision.status in (FilterStatus.REFERENCE, FilterStatus.FILTERED)
        return decision.input if found else None

    return tick


def our_volume_gradient() -> Callable[[Array], tuple[float, Array] | None]:
    """Returns rows, ellipsoid and gradient, as the filter has them."""
    system = safety_filter("vcbf-qp")
    context = system.CreateDefaultContext()

    def evaluate(state: Array) -> tuple[float, Array] | None:
        _fix(system, context, state, np.zeros(NUM_INPUTS))
        volume = system.volume(context)
        if volume is None or volume.ellipsoid is None:
            return None
        return volume.value + THRESHOLD, volume.state

    return evaluate


def _fix(system: SafetyFilter, context: Context, state: Array, wanted: Array) -> None:
    system.GetInputPort("state").FixValue(context, state)
    system.GetInputPort("reference").FixValue(context, wanted)


def measure(task: Task, instances: Sequence[Instance]) -> Iterator[Cost | str]:
    """Yields the cost of every route of a task, or the name of one not installed."""
    answers = [task.answer(each) for each in instances]
    for route in task.routes:
        try:
            function = route.make()
        except ImportError:
            yield route.name
            continue
        yield _cost(route.name, task, function, instances, answers)


def _cost(
    name: str,
    task: Task,
    function: Callable[..., Any],
    instances: Sequence[Instance],
    answers: Sequence[Any],
) -> Cost:
    for each in instances[:_WARM_UP]:
        function(*task.arguments(each))
    found, spent = [], []
    for each in instances:
        started = time.process_time()
        found.append(function(*task.arguments(each)))
        spent.append(1e3 * (time.process_time() - started))
    pairs = list(zip(found, answers, strict=True))
    errors = [
        task.error(own, right)
        for own, right in pairs
        if own is not None and right is not None
    ]
    return Cost(
        name,
        median=float(np.median(spent)),
        p99=float(np.percentile(spent, 99.0)),
        worst=float(np.max(errors, initial=0.0)),
        failed=sum(own is None and right is not None for own, right in pairs),
        infeasible=sum(right is None for right in answers),
        noticed=sum(own is None and right is None for own, right in pairs),
    )


def markdown(task: Task, costs: Sequence[Cost | str]) -> Iterator[str]:
    """Yields the lines of a task's table; `costs` as `measure` yields them."""
    yield f"### {task.title}\n"
    error = f"worst error [{task.unit}]"
    yield f"| package | median ms | p99 ms | x ours | {error} | infeasible, detected |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: |"
    ours = next(cost.median for cost in costs if isinstance(cost, Cost))
    for cost in costs:
        if isinstance(cost, str):
            yield f"| {cost} | not installed | | | | |"
            continue
        times = f"{cost.median:.3f} | {cost.p99:.3f} | {cost.median / ours:.3g}"
        noticed = f"{cost.noticed} of {cost.infeasible}"
        noticed += f", {cost.failed} failed" if cost.failed else ""
        yield f"| {cost.name} | {times} | {cost.worst:.0e} | {noticed} |"


def _by(gradient: Callable[[], Any], projection: Callable[[], Any]) -> Any:
    return peers.volume_filter_with(gradient(), projection())


def _project(projection: Callable[[], Any]) -> Any:
    return peers.filter_with(projection())


def _input_error(answer: Any, right: Any) -> float:
    return float(np.abs(answer - right).max())


def _gradient_error(answer: Any, right: Any) -> float:
    return float(np.linalg.norm(answer[1] - right[1]) / np.linalg.norm(right[1]))


CBF_QP = Task(
    title="CBF-QP: rows, QP",
    routes=(
        Route(OURS, partial(our_tick, "cbf-qp")),
        Route("cbfpy", peers.cbfpy),
        Route("quadprog, rows by hand", partial(_project, peers.quadprog)),
        Route("Drake, rows by hand, rebuilt", partial(_project, peers.drake)),
        Route("cvxpy, rows by hand", partial(_project, peers.cvxpy)),
    ),
    arguments=lambda each: (each.state, each.reference),
    answer=lambda each: reference.nearest_input(*polytope(each.state), each.reference),
    error=_input_error,
    unit="m/s^2",
)
GRADIENT = Task(
    title="rows, ellipsoid, gradient of its volume",
    routes=(
        Route(OURS, our_volume_gradient),
        Route("Drake, differences", peers.drake_differences),
        Route("cvxpylayers, SCS", peers.cvxpylayers),
    ),
    arguments=lambda each: (each.state,),
    answer=lambda each: reference.ellipsoid_gradient(each.state),
    error=_gradient_error,
    unit="relative",
)
VCBF_QP = Task(
    title="VCBF-QP: rows, ellipsoid, gradient, QP",
    routes=(
        Route(OURS, partial(our_tick, "vcbf-qp")),
        Route("Drake, differences", partial(_by, peers.drake_differences, peers.drake)),
        Route("cvxpylayers + cvxpy", partial(_by, peers.cvxpylayers, peers.cvxpy)),
    ),
    arguments=lambda each: (each.state, each.reference),
    answer=lambda each: reference.volume_filtered_input(each.state, each.reference),
    error=_input_error,
    unit="m/s^2",
)
TASKS = (CBF_QP, GRADIENT, VCBF_QP)
