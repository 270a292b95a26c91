"""The report's words and tables as Markdown; its figures stay in the page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from vcbf_drake.viz.report.document import (
    Block,
    Commands,
    Figure,
    Missing,
    Paragraph,
    Replay,
    Section,
    Table,
)


def markdown(title: str, sections: Sequence[Section], remark: str) -> str:
    """Returns the report as Markdown, without its figures.

    Args:
        title: The report's title.
        sections: The sections, in order.
        remark: The words under the title.
    """
    parts = [f"# {title}", remark]
    for section in sections:
        parts.append(f"## {section.title}")
        parts.extend(text for block in section.blocks for text in _block(block))
    return "\n\n".join(parts) + "\n"


def _block(block: Block) -> Iterator[str]:
    match block:
        case Paragraph(text) | Missing(text):
            yield text
        case Commands(title, lines):
            yield title
            yield "\n".join(["```", *lines, "```"])
        case Table():
            yield from _table(block)
        case Figure() | Replay():
            pass


def _table(table: Table) -> Iterator[str]:
    yield f"{table.caption} `{table.command}`" if table.command else table.caption
    titles = [column.title for column in table.columns]
    rules = ["---:" if column.number else "---" for column in table.columns]
    rows = [list(cells) for cells in table.rows]
    if table.notes:
        titles, rules = [*titles, "command"], [*rules, "---"]
        rows = [[*cells, note] for cells, note in zip(rows, table.notes, strict=True)]
    yield "\n".join(_line(cells) for cells in [titles, rules, *rows])


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
