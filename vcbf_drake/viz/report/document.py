"""What a report is made of; how it looks is for the page and for the Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result


@dataclass(frozen=True)
class Paragraph:
    """Words, with `code`, *emphasis* and [links](https://...) as in Markdown."""

    text: str


@dataclass(frozen=True)
class Missing:
    """A line that says what is left out, and why."""

    text: str


@dataclass(frozen=True)
class Commands:
    """Command lines to copy, one below the other.

    Attributes:
        title: What they do.
        lines: The commands.
    """

    title: str
    lines: Sequence[str]


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: Its head.
        number: Whether its cells are numbers, which stand flush right.
        whole: Whether its cells stay on one line, as numbers do.
    """

    title: str
    number: bool = False
    whole: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of cells, whose text is marked up as in a paragraph.

    Attributes:
        caption: What it says and what to notice.
        columns: The columns.
        rows: The cells, one for each column.
        notes: A line under each row, as long as the rows; empty for none.
        command: What makes its numbers; empty when the rows say so.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    command: str = ""


@dataclass(frozen=True)
class Figure:
    """A picture that is drawn when it is shown.

    Attributes:
        name: The name of its files, and of its place in the page.
        caption: What is drawn and what to notice.
        draw: Returns the ``matplotlib.figure.Figure``; raises FileNotFoundError where
            what it draws is missing.
        command: What makes it.
    """

    name: str
    caption: str
    draw: Callable[[], Any] = field(repr=False)
    command: str = ""


@dataclass(frozen=True)
class Replay:
    """A Meshcat page beside the report.

    Attributes:
        name: The name of its file.
        words: What it shows.
        results: Returns the results to replay; raises FileNotFoundError where one is
            missing.
    """

    name: str
    words: str
    results: Callable[[], Sequence[Result]] = field(repr=False)


Block: TypeAlias = Paragraph | Missing | Commands | Table | Figure | Replay


@dataclass(frozen=True)
class Section:
    """A part of the report with a title of its own.

    Attributes:
        key: Its name in links.
        title: Its title.
        blocks: What it shows, in order.
    """

    key: str
    title: str
    blocks: Sequence[Block]


def number_columns(*titles: str) -> list[Column]:
    """Columns of numbers with these titles."""
    return [Column(title, number=True) for title in titles]
