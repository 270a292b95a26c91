"""Block diagrams drawn from built Drake diagrams, as Graphviz DOT and SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
import re

from pydrake.systems.framework import Diagram, System
from pydrake.systems.primitives import VectorLogSink

from vcbf_drake.safety import METHODS, SafetyFilter
from vcbf_drake.simulation.audit import Audit
from vcbf_drake.viz.block_graph import Block, Pin, Wire, graph_dot, write_dot
from vcbf_drake.viz.style import INK, METHOD_STYLES

# What only looks on, at everything.
_NOT_DRAWN = VectorLogSink, Audit

_SCALAR = "_\N{MATHEMATICAL BOLD SCRIPT CAPITAL T}"  # Begins a template's arguments.
_ADDRESS = re.compile(r"@[0-9a-f]{8,}$")


def write_diagram(diagram: Diagram, directory: Path, name: str) -> list[Path]:
    """Writes a diagram's picture as DOT, and as SVG where Graphviz is installed.

    Args:
        diagram: A built diagram, such as `make_loop` returns.
        directory: Where to write; it is made.
        name: The file name without its ending.

    Returns:
        The paths written.
    """
    return write_dot(diagram_dot(diagram), directory, name)


def diagram_dot(diagram: Diagram) -> str:
    """Returns a diagram's picture as DOT: one block per system that takes part.

    Log sinks and the audit only look on. The text depends on the systems' names, types,
    ports and connections only: it is the same in every process.
    """
    drawn = [s for s in diagram.GetSystems() if not isinstance(s, _NOT_DRAWN)]
    systems = dict(zip(_unique([_readable_name(s) for s in drawn]), drawn, strict=True))
    wires = _wires(diagram, systems)
    blocks = [system_block(n, systems[n]) for n in _in_order(systems, wires)]
    return graph_dot(blocks, wires, _readable_name(diagram))


def _in_order(systems: Mapping[str, System], wires: Sequence[Wire]) -> list[str]:
    """Returns the systems' names, the way forward first.

    It begins at what gives a safety filter its reference; without a filter, at the
    systems without wired inputs.
    """
    references = [
        wire.source.block
        for wire in wires
        if isinstance(systems[wire.sink.block], SafetyFilter)
        and wire.sink.number == _reference_index(systems[wire.sink.block])
    ]
    fed = {wire.sink.block for wire in wires}
    filters = [n for n, system in systems.items() if isinstance(system, SafetyFilter)]
    sources = [] if filters else [name for name in systems if name not in fed]
    return list(dict.fromkeys([*references, *filters, *sources, *systems]))


def _reference_index(safety_filter: System) -> int:
    return int(safety_filter.GetInputPort("reference").get_index())


def system_block(name: str, system: System) -> Block:
    """Returns the block that stands for a system; a safety filter is in colour."""
    kind = _kind(system)
    inputs = map(system.get_input_port, range(system.num_input_ports()))
    outputs = map(system.get_output_port, range(system.num_output_ports()))
    input_names, output_names = (
        tuple(port.get_name() for port in ports) for ports in (inputs, outputs)
    )
    block = Block(name, kind, input_names, output_names)
    if isinstance(system, SafetyFilter):
        method = next(n for n, each in METHODS.items() if each == system.method)
        fill = METHOD_STYLES[method].color
        return replace(block, kind=f"{kind}, {method}", ink=_ink_on(fill), fill=fill)
    return block


def _ink_on(fill: str) -> str:
    red, green, blue = bytes.fromhex(fill.removeprefix("#"))
    return INK if 0.3 * red + 0.6 * green + 0.1 * blue > 140 else "#ffffff"


def _wires(diagram: Diagram, systems: dict[str, System]) -> tuple[Wire, ...]:
    names = {system: name for name, system in systems.items()}
    wires = [
        Wire(
            Pin(names[source], True, int(output)),
            Pin(names[sink], False, int(input_)),
            sink.get_input_port(input_).size(),
        )
        for (sink, input_), (source, output) in diagram.connection_map().items()
        if sink in names and source in names
    ]
    number = {name: i for i, name in enumerate(systems)}
    return tuple(sorted(wires, key=lambda w: (number[w.sink.block], w.sink.number)))


def _kind(system: System) -> str:
    """Returns a system's class without its scalar type."""
    return type(system).__name__.partition(_SCALAR)[0]


def _readable_name(system: System) -> str:
    """Returns a system's name, or its class where Drake put an address for a name."""
    name: str = system.get_name()
    return _kind(system) if _ADDRESS.search(name) else name


def _unique(names: list[str]) -> list[str]:
    counts = [names[: i + 1].count(name) for i, name in enumerate(names)]
    return [
        f"{name} {count}" if count > 1 else name
        for name, count in zip(names, counts, strict=True)
    ]
