"""What a System says of its states: their names, which wrap, which are its position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any

from pydrake.systems.framework import Diagram, System


@dataclass(frozen=True)
class DeclaredStates:
    """What a System's attributes say of its continuous states.

    Attributes:
        names: ``state_names``, or a MultibodyPlant's, or x0, x1, ...
        periods: ``wrapped_states``: after how much each of these is the same again.
        position: ``position_indices``: which states are the position; None where the
            System does not say.
        velocities: Which of the states Drake has as generalized velocities v.
    """

    names: tuple[str, ...]
    periods: Mapping[str, Any]
    position: tuple[int, ...] | None
    velocities: tuple[int, ...]


def declared_states(system: System) -> DeclaredStates:
    """Returns what a System says; a Diagram says what the Systems in it do.

    Where several of these have states, their names come before those of the states.
    """
    if isinstance(system, Diagram) and not hasattr(system, "state_names"):
        parts = [each for each in system.GetSystems() if _size(each)]
        found = [declared_states(each) for each in parts]
        if len(found) == 1:
            return found[0]
        names: list[str] = []
        periods: dict[str, Any] = {}
        velocities: list[int] = []
        for part, states in zip(parts, found, strict=True):
            prefix = f"{part.get_name()}_"
            velocities += [len(names) + i for i in states.velocities]
            names += [prefix + name for name in states.names]
            periods |= {prefix + name: p for name, p in states.periods.items()}
        return DeclaredStates(tuple(names), periods, None, tuple(velocities))
    position = getattr(system, "position_indices", None)
    kinds = system.AllocateTimeDerivatives()
    first, size = kinds.num_q(), kinds.num_v()
    return DeclaredStates(
        _names(system),
        wrapping(getattr(system, "wrapped_states", ())),
        None if position is None else tuple(position),
        tuple(range(first, first + size)),
    )


def wrapping(wrapped_states: Any) -> Mapping[str, Any]:
    """Returns the periods of wrapped states: 2 pi where they are names alone."""
    if isinstance(wrapped_states, Mapping):
        return wrapped_states
    return dict.fromkeys(wrapped_states, 2.0 * math.pi)


def _size(system: System) -> int:
    return int(system.num_continuous_states())


def _names(system: Any) -> tuple[str, ...]:
    names = getattr(system, "state_names", None)
    if names is None and hasattr(system, "GetStateNames"):
        names = system.GetStateNames()
    return tuple(names) if names else tuple(f"x{i}" for i in range(_size(system)))
