"""Block diagrams as Graphviz DOT and SVG: of Drake diagrams, and of a filter's inside.

The wires of a diagram are its connections. Those of a filter's inside are the
prerequisites of its cache entries and of its output ports; the numbered steps in its
blocks are a reading aid, with the labels that the equations have in docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
import re

from pydrake.systems.framework import (
    CacheEntry,
    CacheIndex,
    Diagram,
    InputPortIndex,
    System,
)
from pydrake.systems.primitives import VectorLogSink

from vcbf_drake.safety import METHODS, SafetyFilter
from vcbf_drake.viz.block_graph import Block, Wire, graph_dot, write_dot
from vcbf_drake.viz.style import METHOD_STYLES

# The systems that only observe the others.
_NOT_DRAWN = VectorLogSink

_SCALAR = "_\N{MATHEMATICAL BOLD SCRIPT CAPITAL T}"  # Begins a template's arguments.
_ADDRESS = re.compile(r"@[0-9a-f]{8,}$")


def write_diagram(
    system: Diagram | SafetyFilter, directory: Path, name: str
) -> list[Path]:
    """Writes a picture as DOT, and as SVG where Graphviz is installed.

    Args:
        system: A built diagram, such as `make_loop` returns, or a filter, such as its
            ``diagram.GetSubsystemByName("filter")``, whose inside is drawn.
        directory: The directory to write to; it is made.
        name: The file name without its ending.

    Returns:
        The paths written.
    """
    draw = filter_dot if isinstance(system, SafetyFilter) else diagram_dot
    return write_dot(draw(system), directory, name)


def diagram_dot(diagram: Diagram) -> str:
    """A diagram's picture as DOT: one block per system that takes part.

    Log sinks only look on. The text depends on the systems' names, types,
    ports and connections only: it is the same in every process.
    """
    drawn = [s for s in diagram.GetSystems() if not isinstance(s, _NOT_DRAWN)]
    systems = dict(zip(_unique([_readable_name(s) for s in drawn]), drawn, strict=True))
    wires = _wires(diagram, systems)
    blocks = [system_block(n, systems[n]) for n in _in_order(systems, wires)]
    return graph_dot(blocks, wires, _readable_name(diagram))


def _in_order(systems: Mapping[str, System], wires: Sequence[Wire]) -> list[str]:
    """The systems' names, the way forward first.

    It begins at what gives a safety filter its reference; without a filter, at the
    systems without wired inputs.
    """
    references = [
        wire.source
        for wire in wires
        if isinstance(systems[wire.sink], SafetyFilter)
        and _port_name(systems[wire.sink], wire.input) == "reference"
    ]
    fed = {wire.sink for wire in wires}
    filters = [n for n, system in systems.items() if isinstance(system, SafetyFilter)]
    sources = [] if filters else [name for name in systems if name not in fed]
    return list(dict.fromkeys([*references, *filters, *sources, *systems]))


def system_block(name: str, system: System) -> Block:
    """The block that stands for a system; a safety filter is in colour."""
    inputs = [_port_name(system, i) for i in range(system.num_input_ports())]
    outputs = map(system.get_output_port, range(system.num_output_ports()))
    names = tuple(port.get_name() for port in outputs)
    block = Block(name, _kind(system), tuple(inputs), names)
    if isinstance(system, SafetyFilter):
        method = next(n for n, each in METHODS.items() if each == system.method)
        kind, fill = f"{block.kind}, {method}", METHOD_STYLES[method].color
        return replace(block, kind=kind, fill=fill)
    return block


def _port_name(system: System, number: int) -> str:
    return str(system.get_input_port(number).get_name())


def _wires(diagram: Diagram, systems: Mapping[str, System]) -> list[Wire]:
    names = {system: name for name, system in systems.items()}
    wires = [
        Wire(names[source], int(output), names[sink], int(number), port.size())
        for (sink, number), (source, output) in diagram.connection_map().items()
        if sink in names and source in names
        for port in [sink.get_input_port(number)]
    ]
    order = list(systems)
    return sorted(wires, key=lambda wire: (order.index(wire.sink), wire.input))


def _kind(system: System) -> str:
    """A system's class without its scalar type."""
    return type(system).__name__.partition(_SCALAR)[0]


def _readable_name(system: System) -> str:
    """A system's name, or its class where Drake put an address for a name."""
    name: str = system.get_name()
    return _kind(system) if _ADDRESS.search(name) else name


def _unique(names: list[str]) -> list[str]:
    counts = [names[: i + 1].count(name) for i, name in enumerate(names)]
    return [
        f"{name} {count}" if count > 1 else name
        for name, count in zip(names, counts, strict=True)
    ]


def filter_dot(safety_filter: SafetyFilter) -> str:
    """The picture of a filter's inside as DOT, the same in every process."""
    name: str = safety_filter.get_name()
    whole, entries = system_block(name, safety_filter), _needed_entries(safety_filter)
    given = _given(safety_filter, entries)
    blocks = [Block("inputs", whole.kind, (), tuple(text for _, text, _ in given))]
    wires: list[Wire] = []
    # By ticket: the block and the output it stands for, how that is called, its size.
    sources = {t: ("inputs", i, text, size) for i, (t, text, size) in enumerate(given)}
    for entry in entries:
        block: str = entry.description()
        needs = [sources[ticket] for ticket in sources if ticket in _tickets(entry)]
        inputs = tuple(text for _, _, text, _ in needs)
        notes = _steps(safety_filter).get(block, ())
        blocks.append(Block(block, "cache entry", inputs, ("",), notes))
        for i, (source, k, _, size) in enumerate(needs):
            wires.append(Wire(source, k, block, i, size))
        sources[int(entry.ticket())] = block, 0, block, 0
    blocks.append(Block("outputs", whole.kind, whole.outputs, ()))
    for i in range(safety_filter.num_output_ports()):
        port = safety_filter.get_output_port(i)
        for ticket in _tickets(port.cache_entry()):
            wires.append(Wire(*sources[ticket][:2], "outputs", i, port.size()))
    return graph_dot(blocks, wires, name)


def _tickets(entry: CacheEntry) -> list[int]:
    """The tickets of an entry's prerequisites."""
    return sorted(map(int, entry.prerequisites()))


def _needed_entries(safety_filter: SafetyFilter) -> list[CacheEntry]:
    """The entries between inputs and outputs, every one after what it needs."""
    ports = range(safety_filter.num_output_ports())
    ends = [safety_filter.get_output_port(i).cache_entry() for i in ports]
    older = map(CacheIndex, range(min(int(end.cache_index()) for end in ends)))
    entries = {int(e.ticket()): e for e in map(safety_filter.get_cache_entry, older)}
    needed: set[int] = set()
    found = ends
    while found:
        tickets = {t for entry in found for t in _tickets(entry)} - needed
        needed |= tickets
        found = [entries[ticket] for ticket in tickets if ticket in entries]
    return [entry for ticket, entry in sorted(entries.items()) if ticket in needed]


def _given(
    safety_filter: SafetyFilter, entries: Sequence[CacheEntry]
) -> list[tuple[int, str, int]]:
    """The ticket, the name and the size of every input that entries need, and time."""
    needed = {ticket for entry in entries for ticket in _tickets(entry)}
    found = [(int(safety_filter.time_ticket()), "time", 1)]
    for i in reversed(range(safety_filter.num_input_ports())):
        port = safety_filter.get_input_port(i)
        ticket = int(safety_filter.input_port_ticket(InputPortIndex(i)))
        found.insert(0, (ticket, port.get_name(), port.size()))
    return [each for each in found if each[0] in needed]


def _steps(safety_filter: SafetyFilter) -> dict[str, tuple[str, ...]]:
    """The computation of each entry, numbered on the way from state to input."""
    method, settings = safety_filter.method, safety_filter.settings
    steps: dict[str, tuple[str, ...]] = {
        "barrier rows": ("1  barrier rows (E7)",),
        "feasible set": ("2  feasible polytope (E46)",),
        "det B": ("3  inscribed ellipsoid (E48)", "4  its gradient (E58)"),
        "volume": ("5  V_v, above the threshold",),
    }
    if not method.has_volume_row:
        label = "E69" if method.feasibility == "decay" else "E47"
        return steps | {
            "det B": ("inscribed ellipsoid (E48)", "for the log only"),
            "volume": (),
            "decision": (f"3  nearest input, QP ({label})",),
        }
    label = "E62" if settings.corrections.total_derivative else "E54"
    label = label if method.disturbance == "estimated" else "E52"
    decision = (f"6  volume row ({label})", "7  nearest input, QP (E54)")
    return steps | {"decision": decision}
