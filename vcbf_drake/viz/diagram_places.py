"""Where the systems of a diagram stand in its picture.

The way forward runs from left to right: controller, filter, hold, plant. What leads
back stands below it and is mirrored.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from pydrake.systems.framework import System

from vcbf_drake.disturbances import DisturbanceObserver
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.viz.blocks.sheet import Pin, Place, Wire


def diagram_places(
    systems: Mapping[str, System], wires: Sequence[Wire]
) -> dict[str, Place]:
    """Returns the place of every system, found by following the wires.

    Without a safety filter the way forward begins at the first system.

    Args:
        systems: By the names that the wires use.
        wires: The connections, in a fixed order.
    """
    line = _way_forward(systems, wires)
    columns = {name: column for column, name in enumerate(line)}
    return {
        name: Place(columns[name])
        if name in columns
        else _place_beside(name, system, columns, wires)
        for name, system in systems.items()
    }


def _way_forward(systems: Mapping[str, System], wires: Sequence[Wire]) -> list[str]:
    """Returns the names from the controller over the filter to the plant."""
    filters = [n for n, system in systems.items() if isinstance(system, SafetyFilter)]
    line = (filters or list(systems))[:1]
    controller = _controllers(line[0], systems, wires) if filters else []
    while line and (after := _next(line[-1], systems, wires, {*controller, *line})):
        line.append(after)
    return controller + line


def _controllers(
    name: str, systems: Mapping[str, System], wires: Sequence[Wire]
) -> list[str]:
    """Returns the name of what feeds a filter's reference, if anything does."""
    reference = int(systems[name].GetInputPort("reference").get_index())
    return [w.source.block for w in wires if w.sink == Pin(name, False, reference)]


def _next(
    name: str,
    systems: Mapping[str, System],
    wires: Sequence[Wire],
    passed: Collection[str],
) -> str | None:
    for wire in wires:
        after = wire.sink.block
        if (
            wire.source.block == name
            and after not in passed
            and systems[after].num_output_ports() > 0
            and not isinstance(systems[after], DisturbanceObserver)
        ):
            return after
    return None


def _place_beside(
    name: str, system: System, columns: Mapping[str, int], wires: Sequence[Wire]
) -> Place:
    last = len(columns) - 1
    before = [columns.get(w.source.block, last) for w in wires if w.sink.block == name]
    after = [columns.get(w.sink.block, last) for w in wires if w.source.block == name]
    if not before:
        return Place(min(after, default=last), mirrored=True)
    if system.num_output_ports() > 0:
        return Place(max(min(before) - 1, 0), shelf=1, mirrored=True)
    if min(before) < last:
        return Place(min(before) + 1)
    return Place(last, shelf=1, mirrored=True)
