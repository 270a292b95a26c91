"""Block sheets as Graphviz DOT, with every position fixed.

Graphviz only draws: ``layout=nop2`` makes it keep positions and routes as they are, so
the picture does not depend on its version.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
import logging
from pathlib import Path
import shutil
import subprocess
from typing import Any

from vcbf_drake.viz.blocks.label import block_label, outer_label, port_id
from vcbf_drake.viz.blocks.layout import BlockLayout, Box, Point
from vcbf_drake.viz.blocks.search import best_layout
from vcbf_drake.viz.blocks.sheet import Block, BlockSheet, Wire
from vcbf_drake.viz.blocks.size import HEAD, LABEL_SIZE, ROW, TEXT_SIZE
from vcbf_drake.viz.style import INK, RC_PARAMS

_NO_GRAPHVIZ = (
    "no SVG: Graphviz' program `dot` is not installed"
    " (apt-get install graphviz, or brew install graphviz)"
)
_FONT = f"{RC_PARAMS['font.family']},Verdana,sans-serif"
_ARROW = 7.0
_FORWARD = 1.8  # The line width of straight wires; the others have 1.
_JUNCTION = 0.05  # A diameter [inch].
_LABEL_BEFORE, _LABEL_ABOVE = 15.0, 6.0  # From a wire's tip to its size.


def sheet_dot(sheet: BlockSheet, title: str) -> str:
    """Returns the DOT text of a sheet, the same text for the same sheet.

    Args:
        sheet: What to draw.
        title: The graph's name.
    """
    from pydot import Dot

    layout = best_layout(sheet)
    graph = Dot(_quoted(title), graph_type="digraph", layout="nop2", bgcolor="white")
    font = {"fontname": _quoted(_FONT), "fontcolor": _quoted(INK)}
    graph.set_node_defaults(shape="plain", fontsize=TEXT_SIZE, **font)
    graph.set_edge_defaults(
        color=_quoted(INK), arrowsize=_ARROW / 10, fontsize=LABEL_SIZE, **font
    )
    for node in (*_block_nodes(sheet, layout), *_junction_nodes(layout)):
        graph.add_node(node)
    for wire, branch in layout.branches().items():
        graph.add_edge(_edge(sheet, wire, branch))
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


def _block_nodes(sheet: BlockSheet, layout: BlockLayout) -> Iterator[Any]:
    if sheet.outer is not None:
        box = layout.outline(HEAD, ROW)
        yield _block_node(sheet.outer, box, outer_label(sheet.outer, box))
    for block in sheet.blocks:
        box = layout.boxes[block.name]
        sides = layout.rows[block.name, True], layout.rows[block.name, False]
        yield _block_node(block, box, block_label(block, box, sides, sheet.wired))


def _block_node(block: Block, box: Box, label: str) -> Any:
    from pydot import Node

    center = box.left + box.width / 2, box.top + box.height / 2
    return Node(_quoted(block.name), pos=_quoted(_position(center)), label=label)


def _junction_nodes(layout: BlockLayout) -> Iterator[Any]:
    from pydot import Node

    parted = (
        branch[0]
        for wire, branch in layout.branches().items()
        if branch[0] != layout.routes[wire][0]
    )
    for i, point in enumerate(sorted(set(parted))):
        yield Node(
            f"junction_{i}",
            pos=_quoted(_position(point)),
            shape="circle",
            style="filled",
            fillcolor=_quoted(INK),
            label=_quoted(""),
            width=_JUNCTION,
            height=_JUNCTION,
        )


def _edge(sheet: BlockSheet, wire: Wire, branch: list[Point]) -> Any:
    from pydot import Edge

    x, y = branch[-1]
    outward = -1.0 if sheet.by_name[wire.sink.block].is_left(wire.sink) else 1.0
    corners = [*branch[:-1], (x + outward * _ARROW, y)]
    spline = [corners[0], *(p for leg in pairwise(corners) for p in _bezier(*leg))]
    attributes: dict[str, Any] = {
        "pos": _quoted(" ".join([f"e,{_position((x, y))}", *map(_position, spline)])),
        "penwidth": _FORWARD if _leads_forward(sheet, wire, branch) else 1.0,
    }
    if wire.size:
        label_at = x + outward * _LABEL_BEFORE, y - _LABEL_ABOVE
        attributes |= {"label": wire.size, "lp": _quoted(_position(label_at))}
    source, sink = (f"{_quoted(pin.block)}:{port_id(pin)}" for pin in wire[:2])
    return Edge(source, sink, **attributes)


def _bezier(start: Point, end: Point) -> list[Point]:
    """Returns a straight line's inner control points and its end."""
    (x0, y0), (x1, y1) = start, end
    return [(x0 + (x1 - x0) * k / 3, y0 + (y1 - y0) * k / 3) for k in (1, 2)] + [end]


def _leads_forward(sheet: BlockSheet, wire: Wire, branch: list[Point]) -> bool:
    framed = all(sheet.by_name[pin.block].framed for pin in wire[:2])
    return framed and len(branch) == 2


def _position(point: Point) -> str:
    """Returns a point as Graphviz writes it, y pointing up."""
    x, y = point
    return f"{x:g},{-y:g}"


def _quoted(text: str) -> str:
    escaped = text.replace('"', '\\"')
    return f'"{escaped}"'
