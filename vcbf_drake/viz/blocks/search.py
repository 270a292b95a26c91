"""The search for a layout with few crossings and short wires."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

from vcbf_drake.viz.blocks.layout import BlockLayout
from vcbf_drake.viz.blocks.routing import Arrangement, lay_out
from vcbf_drake.viz.blocks.sheet import BlockSheet, Pin, Rows, Wire


def best_layout(sheet: BlockSheet) -> BlockLayout:
    """Returns a layout that no single change of its arrangement improves.

    The descent begins with every detour above the blocks, and where crossings are left
    once more with every detour below them. Nothing is random.
    """
    layout = _descend(sheet, 0)
    if layout.crossings() == 0:
        return layout
    return min(layout, _descend(sheet, -1), key=lambda found: found.cost)


def _descend(sheet: BlockSheet, lane: int) -> BlockLayout:
    """Takes the first improvement as long as there is one.

    Args:
        sheet: What to lay out.
        lane: Which of its lanes every wire takes at first, as an index.
    """
    arrangement = _first_arrangement(sheet, lane)
    layout = lay_out(sheet, arrangement)
    improved = True
    while improved:
        improved = False
        for changed in _neighbours(sheet, arrangement):
            candidate = lay_out(sheet, changed)
            if candidate.cost < layout.cost:
                arrangement, layout = changed, candidate
                improved = True
                break
    return layout


def _first_arrangement(sheet: BlockSheet, lane: int) -> Arrangement:
    rows: Rows = {
        (block.name, left): sorted(
            (pin for pin in block.pins() if block.is_left(pin) == left),
            key=lambda pin: pin not in sheet.wired,
        )
        for block in sheet.blocks
        for left in (True, False)
    }
    detours = {
        wire: lanes[lane] for wire in sheet.wires if (lanes := _lanes(sheet, wire))
    }
    nets = list(dict.fromkeys(wire.source for wire in detours))
    return Arrangement(
        rows | dict.fromkeys(range(sheet.num_shelves + 1), nets), detours
    )


def _lanes(sheet: BlockSheet, wire: Wire) -> list[int]:
    """Returns the lanes next to both ends; none when the ends share an aisle."""
    if sheet.aisles[wire.source] == sheet.aisles[wire.sink]:
        return []
    shelves = [sheet.by_name[pin.block].place.shelf for pin in wire[:2]]
    return list(range(max(shelves), min(shelves) + 2))


def _neighbours(sheet: BlockSheet, arrangement: Arrangement) -> Iterator[Arrangement]:
    """Yields arrangements with two nets exchanged somewhere, or one wire rerouted."""
    net_at = {pin: wire.source for wire in sheet.wires for pin in wire[:2]}
    for nets in combinations(dict.fromkeys(net_at.values()), 2):
        exchanged = _exchanged(arrangement.rows, net_at, nets)
        for count in range(1, len(exchanged) + 1):
            for some in combinations(exchanged.items(), count):
                yield replace(arrangement, rows=arrangement.rows | dict(some))
    for wire in arrangement.detours:
        alike = [
            other
            for other in arrangement.detours
            if (other.source, other.sink.block) == (wire.source, wire.sink.block)
        ]
        for lane in _lanes(sheet, wire):
            detours = arrangement.detours | dict.fromkeys(alike, lane)
            yield replace(arrangement, detours=detours)
            rows = _outermost(sheet, arrangement.rows, alike, lane)
            yield Arrangement(rows, detours)


def _outermost(sheet: BlockSheet, rows: Rows, wires: Sequence[Wire], lane: int) -> Rows:
    """Returns the rows with the wires' sinks nearest to the lane they come from."""
    block = sheet.by_name[wires[0].sink.block]
    side = block.name, block.is_left(wires[0].sink)
    moved = [pin for pin in rows[side] if pin in {wire.sink for wire in wires}]
    stay = [pin for pin in rows[side] if pin not in moved]
    at = 0 if lane <= block.place.shelf else sum(pin in sheet.wired for pin in stay)
    return rows | {side: [*stay[:at], *moved, *stay[at:]]}


def _exchanged(rows: Rows, net_at: dict[Pin, Pin], nets: tuple[Pin, Pin]) -> Rows:
    """Returns the rows in which both nets appear, with the two exchanged."""
    exchanged: Rows = {}
    for row, pins in rows.items():
        found = [net_at.get(pin) for pin in pins]
        if all(net in found for net in nets):
            i, j = map(found.index, nets)
            exchanged[row] = list(pins)
            exchanged[row][i], exchanged[row][j] = pins[j], pins[i]
    return exchanged
