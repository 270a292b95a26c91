"""BlockSheet: what a block diagram shows, before anything has a position."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from vcbf_drake.viz.style import GRID, INK


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


# What is in order, from above: the ports on a block's left (True) or right, or the nets
# in a lane, each named by its source.
Row = tuple[str, bool] | int
Rows = dict[Row, list[Pin]]


class Wire(NamedTuple):
    """A connection.

    Attributes:
        source: An output.
        sink: An input.
        size: The length of the vector it carries; 0 when it carries no vector.
    """

    source: Pin
    sink: Pin
    size: int


class Place(NamedTuple):
    """Where a block stands.

    Attributes:
        column: Counted from the left.
        shelf: 0 for the way forward, 1 for what stands below it and leads back.
        mirrored: Whether the outputs are on the left.
    """

    column: int
    shelf: int = 0
    mirrored: bool = False


@dataclass(frozen=True)
class Block:
    """One box with its ports.

    Attributes:
        name: Unique on its sheet, and written at the top.
        kind: Written below the name.
        inputs: The input ports' names.
        outputs: The output ports' names.
        place: Where it stands; blocks of one place are stacked.
        notes: Lines between the head and the ports.
        ink: The head's text colour.
        fill: The head's background.
        framed: Whether head and border are drawn; without them only ports are.
    """

    name: str
    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    place: Place
    notes: tuple[str, ...] = ()
    ink: str = INK
    fill: str = GRID
    framed: bool = True

    def pins(self) -> Iterator[Pin]:
        """Yields every port, inputs first."""
        for is_output, names in ((False, self.inputs), (True, self.outputs)):
            for number in range(len(names)):
                yield Pin(self.name, is_output, number)

    def port_name(self, pin: Pin) -> str:
        """Returns a port's name."""
        return (self.outputs if pin.is_output else self.inputs)[pin.number]

    def is_left(self, pin: Pin) -> bool:
        """Returns whether a port is on the left side."""
        return pin.is_output == self.place.mirrored

    def aisle(self, pin: Pin) -> int:
        """Returns the aisle a port opens to; aisle i is to the left of column i."""
        return self.place.column + (not self.is_left(pin))


@dataclass(frozen=True)
class BlockSheet:
    """Blocks and the wires between them.

    Attributes:
        blocks: In the order in which stacks are filled, from above.
        wires: Between the blocks.
        outer: A box around them all, or None; its ports are not drawn.
    """

    blocks: tuple[Block, ...]
    wires: tuple[Wire, ...]
    outer: Block | None = None

    @cached_property
    def by_name(self) -> dict[str, Block]:
        """The blocks by their names."""
        return {block.name: block for block in self.blocks}

    @cached_property
    def wired(self) -> frozenset[Pin]:
        """The ports that a wire touches."""
        return frozenset(pin for wire in self.wires for pin in wire[:2])

    @property
    def num_shelves(self) -> int:
        """How many shelves there are."""
        return 1 + max(block.place.shelf for block in self.blocks)

    @property
    def num_columns(self) -> int:
        """How many columns there are."""
        return 1 + max(block.place.column for block in self.blocks)

    @cached_property
    def aisles(self) -> dict[Pin, int]:
        """The aisle that each port opens to."""
        return {pin: block.aisle(pin) for block in self.blocks for pin in block.pins()}

    @cached_property
    def faced(self) -> dict[tuple[int, bool], list[Pin]]:
        """The wired ports on an aisle's left (True) or right, where there are any."""
        faced: dict[tuple[int, bool], list[Pin]] = defaultdict(list)
        for pin in sorted(self.wired):
            is_left_of_aisle = not self.by_name[pin.block].is_left(pin)
            faced[self.aisles[pin], is_left_of_aisle].append(pin)
        return dict(faced)
