"""The benchmark's tasks: who does each, on what, and how its answers are judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vcbf_drake.studies.bench import ours, peers, reference
from vcbf_drake.studies.bench.problem import Instance, polytope
from vcbf_drake.studies.bench.route import Route

OURS = "vcbf_drake"
_LAYERS = "cvxpylayers, SCS"
_DIFFERENCES = "Drake, differences"


@dataclass(frozen=True)
class Task:
    """What several routes do.

    Attributes:
        name: A word for files.
        title: What people read.
        routes: Who does it, ours first.
        arguments: What a route is called with.
        answer: The right answer; None where there is none.
        error: How far an answer is from the right one.
        error_unit: What that is measured in.
    """

    name: str
    title: str
    routes: Sequence[Route]
    arguments: Callable[[Instance], tuple[Any, ...]]
    answer: Callable[[Instance], Any]
    error: Callable[[Any, Any], float]
    error_unit: str


def _state(instance: Instance) -> tuple[Any, ...]:
    return (instance.state,)


def _state_and_reference(instance: Instance) -> tuple[Any, ...]:
    return instance.state, instance.reference


def _input_error(answer: Any, right: Any) -> float:
    return float(np.abs(answer - right).max())


def _gradient_error(answer: Any, right: Any) -> float:
    return float(np.linalg.norm(answer[1] - right[1]) / np.linalg.norm(right[1]))


def _with_projection(projection: Callable[[], Any]) -> Any:
    return peers.filter_with(projection())


def _with_gradient(gradient: Callable[[], Any], projection: Callable[[], Any]) -> Any:
    return peers.volume_filter_with(gradient(), projection())


# The whole tick, and what the closed loop is run with.
VOLUME_FILTERS = (
    Route(OURS, "derived", partial(ours.filtered_input, "vcbf-qp")),
    Route(
        _DIFFERENCES,
        "by hand",
        partial(_with_gradient, peers.drake_differences, peers.drake),
    ),
    Route(
        _LAYERS + " + cvxpy",
        "by hand",
        partial(_with_gradient, peers.cvxpylayers, peers.cvxpy),
        "cvxpylayers",
    ),
)

TASKS = (
    Task(
        name="cbf_qp_tick",
        title="CBF-QP: rows, QP",
        routes=(
            Route(OURS, "derived", partial(ours.filtered_input, "cbf-qp")),
            Route("cbfpy", "autodiff", peers.cbfpy, "cbfpy"),
            Route(
                "quadprog",
                "by hand",
                partial(_with_projection, peers.quadprog),
                "quadprog",
            ),
            Route("Drake, rebuilt", "by hand", partial(_with_projection, peers.drake)),
            Route("cvxpy", "by hand", partial(_with_projection, peers.cvxpy), "cvxpy"),
        ),
        arguments=_state_and_reference,
        answer=lambda each: reference.nearest_input(
            *polytope(each.state), each.reference
        ),
        error=_input_error,
        error_unit="m/s^2",
    ),
    Task(
        name="ellipsoid_and_gradient",
        title="rows, ellipsoid, gradient of its volume",
        routes=(
            Route(OURS, "derived", ours.volume_gradient),
            Route(_DIFFERENCES, "by hand", peers.drake_differences),
            Route(_LAYERS, "by hand", peers.cvxpylayers, "cvxpylayers"),
        ),
        arguments=_state,
        answer=lambda each: reference.ellipsoid_gradient(each.state),
        error=_gradient_error,
        error_unit="relative",
    ),
    Task(
        name="vcbf_qp_tick",
        title="VCBF-QP: rows, ellipsoid, gradient, QP",
        routes=(
            *VOLUME_FILTERS,
            Route("ours: ellipsoid, QP alone", "derived", ours.SolversAlone),
        ),
        arguments=_state_and_reference,
        answer=lambda each: reference.volume_filtered_input(each.state, each.reference),
        error=_input_error,
        error_unit="m/s^2",
    ),
)
