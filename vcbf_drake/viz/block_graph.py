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


class Pin(NamedTuple):
    """One port of one block.

    Attributes:
        block: The block's name.
        is_output: Whether it is an output port.
        number: Its index among the block's inputs or outputs.
    """

    block: str
    is_output: bool
    number: int

    def __str__(self) -> str:
        """The port as DOT addresses it."""
        return f"{_quoted(self.block)}:{self.identifier}"

    @property
    def identifier(self) -> str:
        """The port's name in its block's table."""
        return f"{'out' if self.is_output else 'in'}_{self.number}"


class Wire(NamedTuple):
    """A connection from an output to an input.

    Attributes:
        source: The output.
        sink: The input.
        size: The length of the vector it carries; 0 when it carries no vector.
    """

    source: Pin
    sink: Pin
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


def graph_dot(
    blocks: Sequence[Block], wires: Sequence[Wire], title: str, heading: str = ""
) -> str:
    """The DOT text of blocks and wires, from left to right, the same for the same.

    Many wires between two blocks' ports of the same names are one thick line. Wires
    that lead back to a block on the way do not move it.

    Args:
        blocks: The blocks, the first ones of the way first.
        wires: The connections between them.
        title: The graph's name.
        heading: What stands above everything.
    """
    from pydot import Dot, Edge, Node

    graph = Dot(_quoted(title), graph_type="digraph", rankdir="LR", bgcolor="white")
    graph.set("nodesep", 0.35)
    graph.set("ranksep", 0.5)
    font: dict[str, Any] = {"fontname": _quoted(_FONT), "fontcolor": _quoted(INK)}
    graph.set_node_defaults(shape="plain", fontsize=10, **font)
    graph.set_edge_defaults(color=_quoted(_LINES), arrowsize=0.7, fontsize=9, **font)
    if heading:
        graph.set("label", _quoted(heading))
        graph.set("labelloc", "t")
        for name, value in (font | {"fontsize": 12}).items():
            graph.set(name, value)
    backward = _backward(blocks, wires)
    wired = {pin for wire in wires for pin in wire[:2]}
    for block in blocks:
        graph.add_node(Node(_quoted(block.name), label=_table(block, wired)))
    bundles = _bundles(blocks, [w for w in wires if w not in backward])
    for (source, sink), bundle in bundles.items():
        text = _quoted(f" {len(bundle)} signals ")
        ends = f"{_quoted(source)}:e", f"{_quoted(sink)}:w"
        graph.add_edge(Edge(*ends, weight=4, penwidth=2.5, label=text))
    bundled = {wire for bundle in bundles.values() for wire in bundle}
    nets: dict[Pin, list[Wire]] = {}
    for wire in (each for each in wires if each not in bundled):
        nets.setdefault(wire.source, []).append(wire)
    for number, net in enumerate(nets.values()):
        for part in _net(f"net_{number}", net, backward):
            (graph.add_node if isinstance(part, Node) else graph.add_edge)(part)
    return str(graph.to_string())


def write_dot(dot: str, directory: Path, name: str) -> list[Path]:
    """Writes DOT text, and its SVG next to it where Graphviz is installed.

    Args:
        dot: The text.
        directory: Where to write; it is made.
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
        (source, _, i), (sink, _, j) = wire.source, wire.sink
        if named[source].outputs[i] == named[sink].inputs[j]:
            found.setdefault((source, sink), []).append(wire)
    return {ends: each for ends, each in found.items() if len(each) >= _BUNDLE}


def _backward(blocks: Sequence[Block], wires: Sequence[Wire]) -> set[Wire]:
    """The wires that close a loop, found by walking forward from the first block."""
    done: set[str] = set()
    on_the_way: list[str] = []
    backward: set[Wire] = set()

    def walk(name: str) -> None:
        on_the_way.append(name)
        for wire in wires:
            if wire.source.block == name:
                if wire.sink.block in on_the_way:
                    backward.add(wire)
                elif wire.sink.block not in done:
                    walk(wire.sink.block)
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

    source = f"{net[0].source}:e"
    point: dict[str, Any] = dict(shape="point", width=0.04, color=_quoted(_LINES))
    returning = [wire for wire in net if wire in backward]
    for wire in net:
        if wire not in returning:
            yield Edge(source, f"{wire.sink}:w", weight=4, **_size(wire))
    trunk = name
    if returning:
        yield Node(trunk, **point)
        yield Edge(source, trunk, dir="none", tailclip="true", headclip="false")
    for k, wire in enumerate(reversed(returning)):
        corner = f"{name}_{k}"
        yield Node(corner, **point)
        yield Edge(corner, trunk, dir="none", minlen=0, headclip="false")
        yield Edge(corner, f"{wire.sink}:w", **_size(wire), tailclip="false")
        trunk = corner


def _size(wire: Wire) -> dict[str, Any]:
    return {"label": _quoted(f" {wire.size} ")} if wire.size else {}


def _table(block: Block, wired: Collection[Pin]) -> str:
    """The HTML-like label: head, notes, and a row for every pair of ports."""
    head = f'<FONT POINT-SIZE="11"><B>{escape(block.name)}</B></FONT>'
    head += f"<BR/>{escape(block.kind)}" if block.kind else ""
    style = f'COLSPAN="2" CELLPADDING="5" BGCOLOR="{block.fill}"'
    red, green, blue = bytes.fromhex(block.fill.removeprefix("#"))
    ink = INK if 0.3 * red + 0.6 * green + 0.1 * blue > 140 else "#ffffff"
    rows = [f'<TD {style}><FONT COLOR="{ink}">{head}</FONT></TD>']
    rows += [f'<TD COLSPAN="2" ALIGN="LEFT">{escape(n)}</TD>' for n in block.notes]
    inputs = [
        _cell(block.name, False, *each, wired) for each in enumerate(block.inputs)
    ]
    outputs = [
        _cell(block.name, True, *each, wired) for each in enumerate(block.outputs)
    ]
    rows += map("".join, zip_longest(inputs, outputs, fillvalue="<TD></TD>"))
    style = f'BORDER="1" COLOR="{MUTED}" CELLBORDER="0" CELLSPACING="0" CELLPADDING="3"'
    return f"<<TABLE {style}>{''.join(f'<TR>{row}</TR>' for row in rows)}</TABLE>>"


def _cell(block: str, output: bool, k: int, name: str, wired: Collection[Pin]) -> str:
    """The cell of a port, which is paler without a wire."""
    pin = Pin(block, output, k)
    color, align = INK if pin in wired else MUTED, "RIGHT" if output else "LEFT"
    text = f'<FONT COLOR="{color}">{escape(name) or "&#160;"}</FONT>'
    return f'<TD ALIGN="{align}" PORT="{pin.identifier}">{text}</TD>'


def _quoted(text: str) -> str:
    escaped = text.replace('"', '\\"')
    return f'"{escaped}"'
