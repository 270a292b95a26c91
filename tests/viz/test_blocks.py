"""Block drawings: nothing overlaps, whatever is drawn."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from vcbf_drake.viz.blocks import Block, BlockSheet, Pin, Place, Wire, sheet_dot
from vcbf_drake.viz.blocks.layout import BlockLayout
from vcbf_drake.viz.blocks.search import best_layout

Leg = tuple[tuple[float, float], tuple[float, float]]


def random_sheet(seed: int) -> BlockSheet:
    """Some blocks in random places, about half of their inputs wired at random."""
    generator = np.random.default_rng(seed)
    blocks = [
        Block(
            f"block {i}",
            "Kind",
            tuple(f"in {k}" for k in range(generator.integers(0, 4))),
            tuple(f"out {k}" for k in range(generator.integers(1, 4))),
            Place(
                int(generator.integers(0, 3)),
                int(generator.integers(0, 2)),
                bool(generator.integers(0, 2)),
            ),
        )
        for i in range(5)
    ]
    sources = [pin for block in blocks for pin in block.pins() if pin.is_output]
    wires = [
        Wire(sources[generator.integers(len(sources))], pin, 1)
        for block in blocks
        for pin in block.pins()
        if not pin.is_output and generator.random() < 0.6
    ]
    return BlockSheet(tuple(blocks), tuple(wires))


@pytest.fixture(scope="module", params=range(12))
def drawn(request: pytest.FixtureRequest) -> tuple[BlockSheet, BlockLayout]:
    sheet = random_sheet(request.param)
    return sheet, best_layout(sheet)


def legs(layout: BlockLayout, source: Pin) -> list[Leg]:
    return [
        leg
        for wire, route in layout.routes.items()
        if wire.source == source
        for leg in pairwise(route)
    ]


def overlap(a: Leg, b: Leg, k: int) -> float:
    """How long two legs' shadows on an axis overlap; negative when they do not."""
    (low_a, high_a), (low_b, high_b) = (sorted(p[k] for p in leg) for leg in (a, b))
    return min(high_a, high_b) - max(low_a, low_b)


def test_wires_run_square_from_their_source_to_their_sink(
    drawn: tuple[BlockSheet, BlockLayout],
) -> None:
    sheet, layout = drawn
    assert set(layout.routes) == set(sheet.wires)
    for wire, route in layout.routes.items():
        for pin, (x, y) in zip(wire[:2], (route[0], route[-1]), strict=True):
            block, box = sheet.by_name[pin.block], layout.boxes[pin.block]
            mirrored = block.place.mirrored
            assert x == box.left + (box.width if pin.is_output != mirrored else 0.0)
            assert box.top < y < box.top + box.height
        for (x0, y0), (x1, y1) in pairwise(route):
            assert (x0 == x1) != (y0 == y1)


def test_blocks_do_not_overlap(drawn: tuple[BlockSheet, BlockLayout]) -> None:
    for a, b in combinations(drawn[1].boxes.values(), 2):
        apart_x = a.left + a.width < b.left or b.left + b.width < a.left
        apart_y = a.top + a.height < b.top or b.top + b.height < a.top
        assert apart_x or apart_y


def test_no_wire_runs_through_a_block(drawn: tuple[BlockSheet, BlockLayout]) -> None:
    sheet, layout = drawn
    for wire in sheet.wires:
        for leg in legs(layout, wire.source):
            for box in layout.boxes.values():
                corners = (
                    (box.left, box.top),
                    (box.left + box.width, box.top + box.height),
                )
                assert overlap(leg, corners, 0) <= 0 or overlap(leg, corners, 1) < 0


def test_wires_of_different_outputs_never_share_a_line(
    drawn: tuple[BlockSheet, BlockLayout],
) -> None:
    sheet, layout = drawn
    for a, b in combinations({wire.source for wire in sheet.wires}, 2):
        for leg in legs(layout, a):
            for other in legs(layout, b):
                shared = overlap(leg, other, 0), overlap(leg, other, 1)
                assert min(shared) < 0 or max(shared) == 0


def test_crossings_are_counted(drawn: tuple[BlockSheet, BlockLayout]) -> None:
    sheet, layout = drawn
    expected = sum(
        overlap(leg, other, 0) >= 0 and overlap(leg, other, 1) >= 0
        for a, b in combinations({wire.source for wire in sheet.wires}, 2)
        for leg in set(legs(layout, a))
        for other in set(legs(layout, b))
    )
    assert layout.crossings() == expected


def test_branches_cover_each_net_once(drawn: tuple[BlockSheet, BlockLayout]) -> None:
    """Painted dot by dot, the branches are the routes, and no dot is painted twice."""
    _, layout = drawn
    for source in {wire.source for wire in layout.routes}:
        whole, painted = set(), []
        for wire, branch in layout.branches().items():
            if wire.source == source:
                whole |= dots(layout.routes[wire])
                painted += dots(branch) - {branch[0]}
        painted.append(next(r[0] for w, r in layout.routes.items() if w[0] == source))
        assert set(painted) == whole
        assert len(painted) == len(set(painted))


def dots(route: list[tuple[float, float]]) -> set[tuple[float, float]]:
    """Points along a route at half the unit in which positions are given."""
    found = set(route)
    for (x0, y0), (x1, y1) in pairwise(route):
        steps = round(2 * (abs(x1 - x0) + abs(y1 - y0)))
        found |= {
            (x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps)
            for k in range(steps + 1)
        }
    return {(round(2 * x) / 2, round(2 * y) / 2) for x, y in found}


def test_a_loop_with_two_ways_back_has_no_crossings() -> None:
    blocks = (
        Block("law", "", ("state", "gust"), ("u",), Place(0)),
        Block("plant", "", ("u", "d"), ("state", "speed"), Place(1)),
        Block("observer", "", ("u", "state"), ("gust",), Place(0, 1, True)),
        Block("wind", "", (), ("d",), Place(1, mirrored=True)),
    )

    def wire(source: str, output: int, sink: str, number: int) -> Wire:
        return Wire(Pin(source, True, output), Pin(sink, False, number), 1)

    wires = (
        wire("law", 0, "plant", 0),
        wire("wind", 0, "plant", 1),
        wire("plant", 0, "law", 0),
        wire("law", 0, "observer", 0),
        wire("plant", 0, "observer", 1),
        wire("observer", 0, "law", 1),
    )
    assert best_layout(BlockSheet(blocks, wires)).crossings() == 0


def test_a_sheet_without_wires_is_drawn() -> None:
    sheet = BlockSheet((Block("alone", "Kind", (), (), Place(0)),), ())
    assert best_layout(sheet).crossings() == 0
    assert "alone" in sheet_dot(sheet, "title")
