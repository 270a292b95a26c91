"""A route: one way to do one of the benchmark's tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from vcbf_drake.checks import Array

# From the state and the controller's input to the input, or None for "infeasible".
Filter: TypeAlias = Callable[[Array, Array], Array | None]
# From the state to det B and its gradient by the state, or None for "empty".
VolumeGradient: TypeAlias = Callable[[Array], tuple[float, Array] | None]
# From A, b and a point to the nearest point of {u : A u <= b}, or None for "empty".
Projection: TypeAlias = Callable[[Array, Array, Array], Array | None]


@dataclass(frozen=True)
class Route:
    """Somebody's way to do a task.

    Attributes:
        name: What people call it.
        rows: Where the barriers' rows come from: ``derived`` from the system, by
            ``autodiff``, or written ``by hand``.
        make: Returns the function, a Filter or a VolumeGradient; raises ImportError
            when a package is missing. A method `prepare` of it makes, unmeasured, what
            it is called with from the task's arguments.
        package: The package to be named with its version; empty for Drake itself.
    """

    name: str
    rows: str
    make: Callable[[], Any]
    package: str = ""
