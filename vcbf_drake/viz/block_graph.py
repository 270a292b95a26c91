"""Blocks with ports and wires, laid out and drawn by Graphviz through pydot."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
import logging
from pathlib import Path
import shutil
import subprocess
from typing import Any, NamedTuple

from vcbf_drake.viz.style import FONT, GRID, INK, MUTED

_NO_GRAPHVIZ = (
    "no SVG: Graphviz' program `dot` is not installed"
    " (apt-get install graphviz, or brew install graphviz)"
)
_FONT = f"{FONT},Verdana,sans-serif"
_LINES = "#3d4754"
_BUNDLE = 4  # So many wires between two blocks, or more, are drawn as one.


class Wire(NamedTuple):
    """A connection from an output port to an input port.

    Attributes:
        source: The block it comes from.
        output: The index of the port there.
        sink: The block it leads to.
        input: The index of the port there.
        size: The length of the vector it carries; 0 when it carries no vector.
    """

    source: str
    output: int
    sink: str
    input: int
    size: int


@dataclass(frozen=True)
class Block:
    """One box with its ports.

    Attributes:
        name: Unique in its drawing, and written at the top.
        kind: Written below the name.
        inputs: The input ports' names.
        outputs: The output ports' names.
        notes: Lines between the head and the ports.
        fill: The head's background.
    """

    name: str
    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    notes: tuple[str, ...] = ()
    fill: str = GRID


def graph_dot(blocks: Sequence[Block], wires: Sequence[Wire], title: str) -> str:
    """The DOT text of blocks and wires, from left to right, the same for the same.

    Many wires between two blocks' ports of the same names are one thick line. Wires
    that lead back to a block on the way do not move it.

    Args:
        blocks: The blocks, the first ones of the way first.
        wires: The connections between them.
        title: The graph's name.
    """
    from pydot import Dot, Edge, Node

    graph = Dot(_quoted(title), graph_type="digraph", rankdir="LR", bgcolor="white")
    graph.set("nodesep", 0.35)
    graph.set("ranksep", 0.5)
    font: dict[str, Any] = {"fontname": _quoted(_FONT), "fontcolor": _quoted(INK)}
    graph.set_node_defaults(shape="plain", fontsize=10, **font)
    graph.set_edge_defaults(color=_quoted(_LINES), arrowsize=0.7, fontsize=9, **font)
    backward = _backward(blocks, wires)
    for block in blocks:
        graph.add_node(Node(_identifier(block.name), label=_table(block, wires)))
    bundles = _bundles(blocks, [w for w in wires if w not in backward])
    for (source, sink), bundle in bundles.items():
        text = _quoted(f" {len(bundle)} signals ")
        ends = f"{_identifier(source)}:e", f"{_identifier(sink)}:w"
        graph.add_edge(Edge(*ends, weight=4, penwidth=2.5, label=text))
    bundled = {wire for bundle in bundles.values() for wire in bundle}
    nets: dict[tuple[str, int], list[Wire]] = {}
    for wire in (each for each in wires if each not in bundled):
        nets.setdefault(wire[:2], []).append(wire)
    for number, net in enumerate(nets.values()):
        for part in _net(f"net_{number}", net, backward):
            (graph.add_node if isinstance(part, Node) else graph.add_edge)(part)
    return str(graph.to_string())


def write_dot(dot: str, directory: Path, name: str) -> list[Path]:
    """Writes DOT text, and its SVG next to it where Graphviz is installed.

    Args:
        dot: The text.
        directory: The directory to write to; it is made.
        name: The file name without its ending.

    Returns:
        The paths written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    source, picture = directory / f"{name}.dot", directory / f"{name}.svg"
    source.write_text(dot, encoding="utf-8")
    program = shutil.which("dot")
    if program is None:
        logging.getLogger(__name__).warning(_NO_GRAPHVIZ)
        return [source]
    subprocess.run([program, "-Tsvg", "-o", picture, source], check=True)
    return [source, picture]


def _bundles(
    blocks: Sequence[Block], wires: Sequence[Wire]
) -> dict[tuple[str, str], list[Wire]]:
    """The wires that are drawn as one, by the names of the two blocks."""
    named = {block.name: block for block in blocks}
    found: dict[tuple[str, str], list[Wire]] = {}
    for wire in wires:
        names = named[wire.source].outputs, named[wire.sink].inputs
        if names[0][wire.output] == names[1][wire.input]:
            found.setdefault((wire.source, wire.sink), []).append(wire)
    return {ends: each for ends, each in found.items() if len(each) >= _BUNDLE}


def _backward(blocks: Sequence[Block], wires: Sequence[Wire]) -> set[Wire]:
    """The wires that close a loop, found by walking forward from the first block."""
    done: set[str] = set()
    on_the_way: list[str] = []
    backward: set[Wire] = set()

    def walk(name: str) -> None:
        on_the_way.append(name)
        for wire in wires:
            if wire.source == name:
                if wire.sink in on_the_way:
                    backward.add(wire)
                elif wire.sink not in done:
                    walk(wire.sink)
        on_the_way.pop()
        done.add(name)

    for block in blocks:
        if block.name not in done:
            walk(block.name)
    return backward


def _net(name: str, net: Sequence[Wire], backward: Collection[Wire]) -> Iterator[Any]:
    """The points and edges of all wires from one output.

    For Graphviz every edge leads to the right, or the layout is a tangle. A wire that
    leads back therefore runs, unheaded, from a point on the right of its source to a
    point on the left of its sink, laid out from left to right, drawn as one line.
    """
    from pydot import Edge, Node

    source = f"{_identifier(net[0].source)}:out_{net[0].output}:e"
    point: dict[str, Any] = dict(shape="point", width=0.04, color=_quoted(_LINES))
    returning = [wire for wire in net if wire in backward]
    for wire in net:
        if wire not in returning:
            yield Edge(source, _sink(wire), weight=4, **_size(wire))
    trunk = name
    if returning:
        yield Node(trunk, **point)
        yield Edge(source, trunk, dir="none", tailclip="true", headclip="false")
    for k, wire in enumerate(reversed(returning)):
        corner = f"{name}_{k}"
        yield Node(corner, **point)
        yield Edge(corner, trunk, dir="none", minlen=0, headclip="false")
        yield Edge(corner, _sink(wire), **_size(wire), tailclip="false")
        trunk = corner


def _sink(wire: Wire) -> str:
    return f"{_identifier(wire.sink)}:in_{wire.input}:w"


def _size(wire: Wire) -> dict[str, Any]:
    return {"label": _quoted(f" {wire.size} ")} if wire.size else {}


def _table(block: Block, wires: Sequence[Wire]) -> str:
    """The HTML-like label: head, notes, and a row for every pair of ports."""
    red, green, blue = bytes.fromhex(block.fill.removeprefix("#"))
    ink = INK if 0.3 * red + 0.6 * green + 0.1 * blue > 140 else "#ffffff"
    head = f'<FONT POINT-SIZE="11"><B>{escape(block.name)}</B></FONT>'
    head += f"<BR/>{escape(block.kind)}" if block.kind else ""
    style = f'COLSPAN="2" CELLPADDING="5" BGCOLOR="{block.fill}"'
    rows = [f'<TD {style}><FONT COLOR="{ink}">{head}</FONT></TD>']
    rows += [f'<TD COLSPAN="2" ALIGN="LEFT">{escape(n)}</TD>' for n in block.notes]
    heard = {wire.input for wire in wires if wire.sink == block.name}
    told = {wire.output for wire in wires if wire.source == block.name}
    columns = [
        [_cell(f"{end}_{k}", side, name, k in used) for k, name in enumerate(names)]
        for end, side, names, used in (
            ("in", "LEFT", block.inputs, heard),
            ("out", "RIGHT", block.outputs, told),
        )
    ]
    rows += map("".join, zip_longest(*columns, fillvalue="<TD></TD>"))
    style = f'BORDER="1" COLOR="{MUTED}" CELLBORDER="0" CELLSPACING="0" CELLPADDING="3"'
    return f"<<TABLE {style}>{''.join(f'<TR>{row}</TR>' for row in rows)}</TABLE>>"


def _cell(port: str, side: str, name: str, wired: bool) -> str:
    """The cell of a port, which is paler without a wire."""
    text = f'<FONT COLOR="{INK if wired else MUTED}">{escape(name) or "&#160;"}</FONT>'
    return f'<TD ALIGN="{side}" PORT="{port}">{text}</TD>'


def _identifier(name: str) -> str:
    """A block's name in quotes; a colon in it would begin a port for pydot."""
    return _quoted(name.replace(":", "&#58;"))


def _quoted(text: str) -> str:
    escaped = text.replace('"', '\\"')
    return f'"{escaped}"'
