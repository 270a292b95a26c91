"""run_bench: CPU times and errors of every route that is installed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import platform
import time
from typing import Any

import numpy as np

from vcbf_drake.studies.bench import reference
from vcbf_drake.studies.bench.closed_loop import RouteFilter, fly
from vcbf_drake.studies.bench.ours import safety_filter
from vcbf_drake.studies.bench.problem import Instance, instances
from vcbf_drake.studies.bench.route import Route
from vcbf_drake.studies.bench.tasks import OURS, TASKS, VOLUME_FILTERS, Task
from vcbf_drake.versions import installed_version

Numbers = dict[str, Any]

# How many instances, and how long the closed loop runs [s].
_FULL, _QUICK = (200, 5.0), (20, 0.5)
# What is built or compiled at first use is not a tick's cost.
_WARM_UP = 20


def run_bench(
    quick: bool = False, progress: Callable[[float], None] | None = None
) -> Numbers:
    """Measures every route on the same instances, in this process.

    Args:
        quick: Few instances and a short run; percentiles are rough then.
        progress: Called now and then with the fraction that is done.

    Returns:
        A dict that JSON can hold: ``software`` with versions, how many ``instances``,
        the ``duration`` of the run [s], and ``tasks``. A task has a ``name``, a
        ``title``, an ``error_unit``, ``routes`` and ``missing``: names of packages to
        install. A route has a ``name``, where its ``rows`` come from, a ``version``,
        its CPU time ``median_ms`` and ``p99_ms``, the ``ratio`` of its median to ours,
        its ``error_median`` and ``error_max`` where both it and the reference have an
        answer, in how many instances it ``failed`` to find one, of how many
        ``infeasible`` ones it ``noticed`` that. In the run, the milliseconds are those
        of one control period, the error is how far its path is from the reference's.
    """
    count, duration = _QUICK if quick else _FULL
    steps = sum(len(task.routes) for task in TASKS) + len(VOLUME_FILTERS) + 1
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / steps)

    chosen = instances(count)
    tasks = [_task(task, chosen, step) for task in TASKS]
    tasks.append(_run(duration, step))
    return {
        "software": {
            "python": platform.python_version(),
            **{name: installed_version(name) for name in ("drake", "numpy")},
        },
        "instances": count,
        "duration": duration,
        "tasks": tasks,
    }


def _task(task: Task, chosen: Sequence[Instance], step: Callable[[], None]) -> Numbers:
    answers = [task.answer(each) for each in chosen]

    def measure(function: Any) -> Numbers:
        found, spent = [], []
        prepare = getattr(function, "prepare", _as_they_are)
        for each in chosen[:_WARM_UP]:
            function(*prepare(*task.arguments(each)))
        for each in chosen:
            arguments = prepare(*task.arguments(each))
            started = time.process_time()
            found.append(function(*arguments))
            spent.append(1e3 * (time.process_time() - started))
        pairs = list(zip(found, answers, strict=True))
        errors = [
            task.error(own, right)
            for own, right in pairs
            if own is not None and right is not None
        ]
        return {
            "median_ms": float(np.median(spent)),
            "p99_ms": float(np.percentile(spent, 99.0)),
            "error_median": float(np.median(errors)) if errors else None,
            "error_max": float(np.max(errors)) if errors else None,
            "failed": sum(own is None and right is not None for own, right in pairs),
            "infeasible": sum(right is None for right in answers),
            "noticed": sum(own is None and right is None for own, right in pairs),
        }

    return {
        "name": task.name,
        "title": task.title,
        "error_unit": task.error_unit,
        **_compared(task.routes, measure, step),
    }


def _as_they_are(*arguments: Any) -> tuple[Any, ...]:
    return arguments


def _run(duration: float, step: Callable[[], None]) -> Numbers:
    _, path = fly(RouteFilter(reference.volume_filtered_input), duration)
    step()
    ticks = len(path) - 1

    def measure(function: Any) -> Numbers:
        spent, own = fly(function, duration)
        error = float(np.linalg.norm((own - path)[:, :3], axis=1).max())
        per_tick = 1e3 * spent / ticks
        return {"median_ms": per_tick, "p99_ms": None, "error_max": error}

    routes = [
        Route(route.name, route.rows, _system_of(route), route.package)
        for route in VOLUME_FILTERS
    ]
    return {
        "name": "run",
        "title": f"closed loop of {duration:g} s at {ticks / duration:.0f} Hz, a tick",
        "error_unit": "m",
        **_compared(routes, measure, step),
    }


def _system_of(route: Route) -> Callable[[], Any]:
    if route.name == OURS:
        return lambda: safety_filter("vcbf-qp")
    return lambda: RouteFilter(route.make())


def _compared(
    routes: Sequence[Route], measure: Callable[[Any], Numbers], step: Callable[[], None]
) -> Numbers:
    """The numbers of the routes that can be made, and the packages of those not."""
    measured, missing = [], []
    for route in routes:
        try:
            function = route.make()
        except ImportError:
            missing.append(route.package)
        else:
            measured.append({**_names(route), **measure(function)})
        step()
    for numbers in measured:
        numbers["ratio"] = numbers["median_ms"] / measured[0]["median_ms"]
    return {"routes": measured, "missing": missing}


def _names(route: Route) -> Numbers:
    own = installed_version(route.package) if route.package else None
    return {"name": route.name, "rows": route.rows, "version": own}
