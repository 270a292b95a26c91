"""How large blocks are and how they are stacked, from their text alone [point]."""

from __future__ import annotations

from functools import lru_cache

from vcbf_drake.viz.blocks.sheet import Block, BlockSheet, Pin, Rows

TITLE_SIZE, TEXT_SIZE, LABEL_SIZE = 11.0, 10.0, 9.0
HEAD, ROW, FOOT = 38.0, 17.0, 4.0  # The heights of a block's parts.
_STACK_GAP = 16.0

# A letter's advance in DejaVu Sans, in font sizes; a little more than the real one.
_NARROW, _WIDE = frozenset("fijlrt.,:;'|()[] -"), frozenset("mwMW@%")
_BOLD = 1.12  # Times as wide.
_SIDE = 7.0  # Between text and border.


@lru_cache
def side_width(block: Block, left: bool) -> float:
    """Returns the width of the port names on one side of a block."""
    names = [block.port_name(pin) for pin in block.pins() if block.is_left(pin) == left]
    return _width(names, TEXT_SIZE)


@lru_cache
def block_width(block: Block) -> float:
    """Returns the width of a block."""
    ports = side_width(block, True) + side_width(block, False)
    if not block.framed:
        return ports
    title = _width([block.name], _BOLD * TITLE_SIZE)
    return max(ports, title, _width([block.kind, *block.notes], TEXT_SIZE))


def _width(lines: list[str], size: float) -> float:
    widest = max((sum(map(_advance, line)) for line in lines), default=0.0)
    return round(widest * size + 2 * _SIDE) if widest else 0.0


def _advance(letter: str) -> float:
    if letter in _NARROW:
        return 0.37
    if letter in _WIDE:
        return 0.97
    return 0.72 if letter.isupper() else 0.62


@lru_cache
def block_height(block: Block) -> float:
    """Returns the height of a block."""
    left = sum(block.is_left(pin) for pin in block.pins())
    num_rows = max(left, len(block.inputs) + len(block.outputs) - left)
    return _head(block) + num_rows * ROW + FOOT


def _head(block: Block) -> float:
    return HEAD + len(block.notes) * ROW if block.framed else 0.0


def pin_heights(block: Block, rows: Rows) -> dict[Pin, float]:
    """Returns how far below a block's top each of its ports is."""
    first = _head(block) + ROW / 2
    return {
        pin: first + ROW * i
        for left in (True, False)
        for i, pin in enumerate(rows[block.name, left])
    }


def stack_blocks(sheet: BlockSheet, rows: Rows) -> dict[str, float]:
    """Returns every block's top, from the top of its shelf.

    The first block of a stack moves down or up until a wire from the first block of the
    stack to its left is straight.
    """
    tops: dict[str, float] = {}
    for shelf in range(sheet.num_shelves):
        on_shelf = [block for block in sheet.blocks if block.place.shelf == shelf]
        before: Block | None = None
        for column in sorted({block.place.column for block in on_shelf}):
            stack = [block for block in on_shelf if block.place.column == column]
            top = _straight_top(sheet, rows, tops, before, stack[0])
            for block in stack:
                tops[block.name] = top
                top += block_height(block) + _STACK_GAP
            before = stack[0]
        highest = min((tops[block.name] for block in on_shelf), default=0.0)
        tops |= {block.name: tops[block.name] - highest for block in on_shelf}
    return tops


def _straight_top(
    sheet: BlockSheet,
    rows: Rows,
    tops: dict[str, float],
    before: Block | None,
    block: Block,
) -> float:
    for wire in sheet.wires:
        if before and (wire.source.block, wire.sink.block) == (before.name, block.name):
            start = tops[before.name] + pin_heights(before, rows)[wire.source]
            return start - pin_heights(block, rows)[wire.sink]
    return 0.0
