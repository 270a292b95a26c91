"""BlockLayout: where the blocks and wires of a sheet are, and how good that is."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from vcbf_drake.viz.blocks.sheet import Pin, Rows, Wire

TRACK = 8.0  # Between wires side by side.
_TOO_CLOSE = 0.5 * TRACK

Point = tuple[float, float]


class Box(NamedTuple):
    """A rectangle, y pointing down [point]."""

    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True)
class BlockLayout:
    """Positions, y pointing down [point].

    Attributes:
        boxes: Where each block is, by its name.
        rows: The order of the ports on each side of each block.
        routes: The corners of every wire, from its source to its sink.
    """

    boxes: dict[str, Box]
    rows: Rows
    routes: dict[Wire, list[Point]]

    @cached_property
    def cost(self) -> tuple[int, int, int]:
        """Crossings first, then length, then disorder; less is better."""
        return self.crossings(), round(self.length()), self.disorder()

    def crossings(self) -> int:
        """Returns how often wires from different outputs touch, or nearly touch."""
        legs = {
            (min(leg), max(leg), wire.source)
            for wire, route in self.routes.items()
            for leg in pairwise(route)
        }
        net = {pin: i for i, pin in enumerate({wire.source for wire in self.routes})}
        starts = np.array([start for start, _, _ in legs]).reshape(-1, 2)
        ends = np.array([end for _, end, _ in legs]).reshape(-1, 2)
        nets = np.array([net[source] for _, _, source in legs])
        begin = np.maximum(starts[:, None], starts)
        finish = np.minimum(ends[:, None], ends)
        touch = np.all(begin < finish + _TOO_CLOSE, axis=-1)
        return int(np.sum(touch & (nets[:, None] < nets)))

    def length(self) -> float:
        """Returns the length of all wires together."""
        return sum(map(_length, self.routes.values()))

    def disorder(self) -> int:
        """Returns how many pairs of ports are not in their blocks' own order."""
        return sum(
            above.number > below.number
            for side, pins in self.rows.items()
            if isinstance(side, tuple)
            for above, below in combinations(pins, 2)
        )

    def branches(self) -> dict[Wire, list[Point]]:
        """Returns the part of every wire that no wire before it covers."""
        covered: dict[Pin, list[list[Point]]] = defaultdict(list)
        branches = {}
        for wire, route in self.routes.items():
            rests = [_after_parting(route, other) for other in covered[wire.source]]
            branches[wire] = min(rests, key=_length, default=route)
            covered[wire.source].append(route)
        return branches

    def outline(self, head: float, margin: float) -> Box:
        """Returns the box around everything, taller by a head and two margins."""
        points = [point for route in self.routes.values() for point in route]
        points += [(box.left, box.top) for box in self.boxes.values()]
        points += [
            (box.left + box.width, box.top + box.height) for box in self.boxes.values()
        ]
        xs, ys = zip(*points, strict=True)
        (left, right), (top, bottom) = ((min(c), max(c)) for c in (xs, ys))
        height = bottom - top + head + 2 * margin
        return Box(left, top - head - margin, right - left, height)


def _length(points: Sequence[Point]) -> float:
    return sum(abs(x1 - x0) + abs(y1 - y0) for (x0, y0), (x1, y1) in pairwise(points))


def _after_parting(route: list[Point], other: list[Point]) -> list[Point]:
    """Returns the part of a route after it parts from another of the same source."""
    common = 1
    while route[common] == other[common]:
        common += 1
    (x, y), ends = route[common - 1], (route[common], other[common])
    (dx, dy), (other_dx, other_dy) = ((end[0] - x, end[1] - y) for end in ends)
    start = (x, y)
    if dx * other_dx + dy * other_dy > 0:  # The same way, but one goes further.
        start = min(ends, key=lambda end: abs(end[0] - x) + abs(end[1] - y))
    return [start, *(point for point in route[common:] if point != start)]
