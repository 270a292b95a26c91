"""What is inside a safety filter: its cache entries and what each is computed from.

The wires are read from the system: they are the prerequisites of its cache entries and
of its output ports. The numbered steps in the blocks are a reading aid, with the labels
that the equations have in docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from pydrake.systems.framework import CacheEntry, CacheIndex, InputPortIndex

from vcbf_drake.safety import SafetyFilter
from vcbf_drake.viz.block_graph import Block, Pin, Wire, graph_dot, write_dot
from vcbf_drake.viz.diagram import system_block

_INPUTS, _OUTPUTS = "inputs", "outputs"


class _Supply(NamedTuple):
    """What a dependency ticket stands for.

    Attributes:
        source: Where it comes from on the sheet.
        name: What it is called where it goes to.
        size: The vector's length; 0 for what is no vector.
    """

    source: Pin
    name: str
    size: int


def write_filter_diagram(
    safety_filter: SafetyFilter, directory: Path, name: str
) -> list[Path]:
    """Writes the picture of a filter's inside as DOT and, with Graphviz, as SVG.

    Args:
        safety_filter: Such as ``diagram.GetSubsystemByName("filter")``.
        directory: Where to write; it is made.
        name: The file name without its ending.

    Returns:
        The paths written.
    """
    return write_dot(filter_dot(safety_filter), directory, name)


def filter_dot(safety_filter: SafetyFilter) -> str:
    """Returns the picture of a filter's inside as DOT, the same in every process."""
    name: str = safety_filter.get_name()
    whole = system_block(name, safety_filter)
    entries = _needed_entries(safety_filter)
    supplies = _input_supplies(safety_filter, entries)
    names = tuple(supply.name for supply in supplies.values())
    blocks = [Block(_INPUTS, "", (), names, framed=False)]
    wires: list[Wire] = []
    for entry in entries:
        needs = [supply for t, supply in supplies.items() if t in _prerequisites(entry)]
        block = _entry_block(safety_filter, entry, needs)
        blocks.append(block)
        wires += [
            Wire(need.source, Pin(block.name, False, i), need.size)
            for i, need in enumerate(needs)
        ]
        supplies[int(entry.ticket())] = _Supply(Pin(block.name, True, 0), block.name, 0)
    blocks.append(Block(_OUTPUTS, "", whole.outputs, (), framed=False))
    wires += _output_wires(safety_filter, supplies)
    return graph_dot(blocks, wires, name, heading=f"{name}: {whole.kind}")


def _output_wires(
    safety_filter: SafetyFilter, supplies: Mapping[int, _Supply]
) -> Iterator[Wire]:
    for i in range(safety_filter.num_output_ports()):
        port = safety_filter.get_output_port(i)
        for ticket in _prerequisites(port.cache_entry()):
            yield Wire(supplies[ticket].source, Pin(_OUTPUTS, False, i), port.size())


def _prerequisites(entry: CacheEntry) -> list[int]:
    return sorted(map(int, entry.prerequisites()))


def _needed_entries(safety_filter: SafetyFilter) -> list[CacheEntry]:
    """Returns the entries between inputs and outputs, every one after what it needs."""
    ports = range(safety_filter.num_output_ports())
    ends = [safety_filter.get_output_port(i).cache_entry() for i in ports]
    older = map(CacheIndex, range(min(int(end.cache_index()) for end in ends)))
    entries = {int(e.ticket()): e for e in map(safety_filter.get_cache_entry, older)}
    needed: set[int] = set()
    found = ends
    while found:
        tickets = {t for entry in found for t in _prerequisites(entry)} - needed
        needed |= tickets
        found = [entries[ticket] for ticket in tickets if ticket in entries]
    return [entry for ticket, entry in sorted(entries.items()) if ticket in needed]


def _input_supplies(
    safety_filter: SafetyFilter, entries: Sequence[CacheEntry]
) -> dict[int, _Supply]:
    """Returns the input ports, and the time, that entries need, by their tickets."""
    needed = {ticket for entry in entries for ticket in _prerequisites(entry)}
    named: dict[int, tuple[str, int]] = {}
    for i in map(InputPortIndex, range(safety_filter.num_input_ports())):
        port = safety_filter.get_input_port(i)
        named[int(safety_filter.input_port_ticket(i))] = port.get_name(), port.size()
    named[int(safety_filter.time_ticket())] = ("time", 1)
    return {
        ticket: _Supply(Pin(_INPUTS, True, i), *named[ticket])
        for i, ticket in enumerate(t for t in named if t in needed)
    }


def _entry_block(
    safety_filter: SafetyFilter, entry: CacheEntry, needs: Sequence[_Supply]
) -> Block:
    name: str = entry.description()
    inputs, notes = tuple(need.name for need in needs), _steps(safety_filter).get(name)
    return Block(name, "cache entry", inputs, ("",), notes or ())


def _steps(safety_filter: SafetyFilter) -> dict[str, tuple[str, ...]]:
    """Returns what each entry computes, numbered on the way from state to input."""
    method, settings = safety_filter.method, safety_filter.settings
    steps: dict[str, tuple[str, ...]] = {
        "barrier rows": ("1  barrier rows (E7)",),
        "feasible set": ("2  feasible polytope (E46)",),
        "determinants": ("3  inscribed ellipsoid (E48)", "4  its gradient (E58)"),
        "volumes": ("5  V_v, above the threshold",),
    }
    if not method.has_volume_row:
        label = "E69" if method.feasibility == "decay" else "E47"
        return steps | {
            "determinants": ("inscribed ellipsoid (E48)", "for the log only"),
            "volumes": (),
            "decision": (f"3  nearest input, QP ({label})",),
        }
    label = "E62" if settings.corrections.total_derivative else "E54"
    label = label if method.disturbance == "estimated" else "E52"
    decision = (f"6  volume row ({label})", "7  nearest input, QP (E54)")
    return steps | {"decision": decision}
