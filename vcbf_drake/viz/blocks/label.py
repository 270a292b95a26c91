"""The HTML-like label with which Graphviz draws a block."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from html import escape

from vcbf_drake.viz.blocks.layout import Box
from vcbf_drake.viz.blocks.sheet import Block, Pin
from vcbf_drake.viz.blocks.size import FOOT, HEAD, ROW, TITLE_SIZE, side_width
from vcbf_drake.viz.style import INK, MUTED

_LEADING = 3.0  # Between a block's name and its kind.
_INDENT = "&#160;&#160;"


def block_label(
    block: Block,
    box: Box,
    sides: tuple[Sequence[Pin], Sequence[Pin]],
    wired: Collection[Pin],
) -> str:
    """Returns the label of a block.

    Args:
        block: The block.
        box: Its place; only the size matters.
        sides: Its ports on the left and on the right, from above.
        wired: The ports that a wire touches; the others are written paler.
    """
    rows = [_head(block, box)] if block.framed else []
    rows += [
        _line(_INDENT + escape(note), box.width, ROW, ' ALIGN="LEFT"')
        for note in block.notes
    ]
    left, right = sides
    left_width = side_width(block, True) if right else box.width
    for i in range(max(len(left), len(right))):
        cells = _cell(block, left[i : i + 1], left_width, "LEFT", wired)
        cells += _cell(block, right[i : i + 1], box.width - left_width, "RIGHT", wired)
        rows.append(f"<TR>{cells}</TR>")
    return _table([*rows, _line("", box.width, FOOT)], block.framed)


def outer_label(block: Block, box: Box) -> str:
    """Returns the label of a block without ports that others are drawn upon."""
    rest = _line("", box.width, box.height - HEAD)
    return _table([_head(block, box), rest], block.framed)


def port_id(pin: Pin) -> str:
    """Returns the name of a port in DOT."""
    return f"{'out' if pin.is_output else 'in'}_{pin.number}"


def _table(rows: Sequence[str], framed: bool) -> str:
    style = f'BORDER="{int(framed)}" COLOR="{MUTED}"'
    style += ' CELLBORDER="0" CELLSPACING="0" CELLPADDING="0"'
    return f"<<TABLE {style}>{''.join(rows)}</TABLE>>"


def _head(block: Block, box: Box) -> str:
    text = _inked(
        f'<FONT POINT-SIZE="{TITLE_SIZE:g}"><B>{escape(block.name)}</B></FONT><BR/>'
        f'<FONT POINT-SIZE="{_LEADING:g}"> <BR/></FONT>{escape(block.kind)}',
        block.ink,
    )
    return _line(text, box.width, HEAD, f' BGCOLOR="{block.fill}"')


def _line(text: str, width: float, height: float, style: str = "") -> str:
    return f'<TR><TD COLSPAN="2" {_size(width, height)}{style}>{text}</TD></TR>'


def _inked(text: str, ink: str) -> str:
    return f'<FONT COLOR="{ink}">{text}</FONT>'


def _cell(
    block: Block, pins: Sequence[Pin], width: float, align: str, wired: Collection[Pin]
) -> str:
    """Returns the cell of one port, or of none."""
    if width <= 0:
        return ""
    port, text = "", ""
    for pin in pins:
        port = f' PORT="{port_id(pin)}"'
        name = escape(block.port_name(pin))
        text = name + _INDENT if align == "RIGHT" else _INDENT + name
        text = _inked(text, INK if pin in wired else MUTED)
    return f'<TD {_size(width, ROW)} ALIGN="{align}"{port}>{text}</TD>'


def _size(width: float, height: float) -> str:
    return f'FIXEDSIZE="TRUE" WIDTH="{width:g}" HEIGHT="{height:g}"'
