"""Square routes for the wires of a block sheet, through lanes and aisles.

A lane is free space above, between or below the shelves; an aisle is free space left of
a column, or right of the last. A net, all wires from one output, has one track in every
lane and aisle it uses, so that wires of different nets meet at right angles only.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise

from vcbf_drake.viz.blocks.layout import TRACK, BlockLayout, Box, Point
from vcbf_drake.viz.blocks.sheet import Block, BlockSheet, Pin, Rows, Wire
from vcbf_drake.viz.blocks.size import (
    block_height,
    block_width,
    pin_heights,
    stack_blocks,
)

_LANE_EDGE = 12.0
_SOURCE_EDGE, _SINK_EDGE = 10.0, 25.0  # A sink has an arrowhead and a size.


@dataclass(frozen=True)
class Arrangement:
    """What a layout is free to choose.

    Attributes:
        rows: The order of ports on the sides of blocks, and of nets in lanes.
        detours: The lane of each wire that leads from one aisle to another.
    """

    rows: Rows
    detours: dict[Wire, int]


def lay_out(sheet: BlockSheet, arrangement: Arrangement) -> BlockLayout:
    """Returns the layout that follows from an arrangement."""
    return _Routing(sheet, arrangement).layout()


@dataclass
class _Track:
    """A net in one aisle: the heights it spans, and those where it leaves."""

    heights: list[float] = field(default_factory=list)
    to_left: list[float] = field(default_factory=list)
    to_right: list[float] = field(default_factory=list)

    def add(self, height: float, leads_left: bool) -> None:
        self.heights.append(height)
        (self.to_left if leads_left else self.to_right).append(height)

    def is_straight(self) -> bool:
        return max(self.heights) - min(self.heights) < 1

    def crossings_left_of(self, other: _Track) -> int:
        """Returns how often the two meet when this one is on the left."""
        return sum(map(other._covers, self.to_right)) + sum(
            map(self._covers, other.to_left)
        )

    def _covers(self, height: float) -> bool:
        return min(self.heights) - 1 <= height <= max(self.heights) + 1


class _Routing:
    """One pass: heights of everything first, then widths, then the routes."""

    def __init__(self, sheet: BlockSheet, arrangement: Arrangement) -> None:
        self._sheet = sheet
        self._rows = arrangement.rows
        self._detours = arrangement.detours
        self._tops = stack_blocks(sheet, arrangement.rows)
        self._lane_y: dict[tuple[int, Pin], float] = {}
        self._place_lanes_and_shelves()
        self._pin_y = {
            pin: self._tops[block.name] + below
            for block in sheet.blocks
            for pin, below in pin_heights(block, self._rows).items()
        }
        self._aisles = [_in_order(tracks) for tracks in self._tracks()]
        self._column_x: list[float] = []
        self._track_x: dict[tuple[int, Pin], float] = {}
        self._place_columns_and_aisles()

    def layout(self) -> BlockLayout:
        boxes = {block.name: self._box(block) for block in self._sheet.blocks}
        routes = {wire: self._route(wire, boxes) for wire in self._sheet.wires}
        return BlockLayout(boxes, self._rows, routes)

    def _place_lanes_and_shelves(self) -> None:
        used = {(lane, wire.source) for wire, lane in self._detours.items()}
        y = 0.0
        for lane in range(self._sheet.num_shelves + 1):
            nets = [net for net in self._rows[lane] if (lane, net) in used]
            for i, net in enumerate(nets):
                self._lane_y[lane, net] = y + _LANE_EDGE + i * TRACK
            y += 2 * _LANE_EDGE + max(len(nets) - 1, 0) * TRACK
            y += self._lower_shelf(lane, y)

    def _lower_shelf(self, shelf: int, y: float) -> float:
        """Moves the blocks of a shelf down by y and returns the shelf's height."""
        blocks = [block for block in self._sheet.blocks if block.place.shelf == shelf]
        bottoms = [self._tops[block.name] + block_height(block) for block in blocks]
        for block in blocks:
            self._tops[block.name] += y
        return max(bottoms, default=0.0)

    def _tracks(self) -> list[dict[Pin, _Track]]:
        aisles: list[dict[Pin, _Track]] = [
            defaultdict(_Track) for _ in range(self._sheet.num_columns + 1)
        ]
        for wire in self._sheet.wires:
            ends = [self._sheet.aisles[pin] for pin in wire[:2]]
            for pin, aisle in zip(wire[:2], ends, strict=True):
                faces_left = not self._sheet.by_name[pin.block].is_left(pin)
                aisles[aisle][wire.source].add(self._pin_y[pin], faces_left)
            if wire in self._detours:
                y = self._lane_y[self._detours[wire], wire.source]
                for here, there in (ends, ends[::-1]):
                    aisles[here][wire.source].add(y, there < here)
        return aisles

    def _place_columns_and_aisles(self) -> None:
        x = 0.0
        for aisle, nets in enumerate(self._aisles):
            x += self._edge(aisle, left=True)
            for i, net in enumerate(nets):
                self._track_x[aisle, net] = x + i * TRACK
            x += max(len(nets) - 1, 0) * TRACK + self._edge(aisle, left=False)
            self._column_x.append(x)
            x += self._column_width(aisle)

    def _edge(self, aisle: int, left: bool) -> float:
        """Returns the room between an aisle's tracks and the blocks on one side."""
        pins = self._sheet.faced.get((aisle, left), [])
        return _SOURCE_EDGE if all(pin.is_output for pin in pins) else _SINK_EDGE

    def _column_width(self, column: int) -> float:
        blocks = [b for b in self._sheet.blocks if b.place.column == column]
        return max(map(block_width, blocks), default=0.0)

    def _box(self, block: Block) -> Box:
        column = block.place.column
        return Box(
            self._column_x[column],
            self._tops[block.name],
            self._column_width(column),
            block_height(block),
        )

    def _route(self, wire: Wire, boxes: dict[str, Box]) -> list[Point]:
        net = wire.source
        start, end = (self._pin_position(pin, boxes) for pin in wire[:2])
        x0, x1 = (
            self._track_x.get((self._sheet.aisles[pin], net), start[0])
            for pin in wire[:2]
        )
        points = [start, (x0, start[1])]
        if wire in self._detours:
            y = self._lane_y[self._detours[wire], net]
            points += [(x0, y), (x1, y)]
        return _corners([*points, (x1, end[1]), end])

    def _pin_position(self, pin: Pin, boxes: dict[str, Box]) -> Point:
        box = boxes[pin.block]
        is_left = self._sheet.by_name[pin.block].is_left(pin)
        return box.left + (0.0 if is_left else box.width), self._pin_y[pin]


def _in_order(tracks: dict[Pin, _Track]) -> list[Pin]:
    """Returns the nets that need a track, each inserted where it crosses least."""
    order: list[Pin] = []
    for net, track in tracks.items():
        if not track.is_straight():
            costs = [
                sum(tracks[other].crossings_left_of(track) for other in order[:i])
                + sum(track.crossings_left_of(tracks[other]) for other in order[i:])
                for i in range(len(order) + 1)
            ]
            order.insert(costs.index(min(costs)), net)
    return order


def _corners(points: list[Point]) -> list[Point]:
    """Returns the points without those at which the route does not turn."""
    distinct = [points[0], *(b for a, b in pairwise(points) if a != b)]
    inner = zip(distinct, distinct[1:], distinct[2:], strict=False)
    turns = [b for a, b, c in inner if a[0] != c[0] and a[1] != c[1]]
    return [distinct[0], *turns, distinct[-1]]
