"""The report as one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import html
from importlib.resources import files
from itertools import count
from string import Template

from vcbf_drake.viz.report.document import (
    Block,
    Column,
    Commands,
    Figure,
    Missing,
    Paragraph,
    Replay,
    Section,
    Table,
)
from vcbf_drake.viz.report.markup import to_html


def page_html(
    title: str, sections: Sequence[Section], pictures: Mapping[str, str], remark: str
) -> str:
    """Returns the page: contents at the side, sections, everything inside.

    Args:
        title: The page's title.
        sections: The sections, in order.
        pictures: The SVG of every figure, by its name; one that is not there is told.
        remark: The last words, under the sections.
    """
    page = _Page(pictures)
    return Template(_text("page.html")).substitute(
        title=html.escape(title),
        style=_text("page.css"),
        contents="\n".join(
            f'<li><a href="#{section.key}">{html.escape(section.title)}</a></li>'
            for section in sections
        ),
        sections="\n".join(page.section(section) for section in sections),
        remark=to_html(remark),
    )


# The words that decide are told by their colour as well.
_TONES = {
    "reproduced": "good",
    "reproduced under stated conditions": "fair",
    "undecided": "fair",
    "not reproduced": "bad",
}
_SHORT = 16  # A table with so many rows is not broken across pages of paper.


class _Page:
    """What numbers figures and tables on the way down the page."""

    def __init__(self, pictures: Mapping[str, str]) -> None:
        self._pictures = pictures
        self._figures, self._tables = count(1), count(1)

    def section(self, section: Section) -> str:
        body = "\n".join(self._block(block) for block in section.blocks)
        title = html.escape(section.title)
        return f'<section id="{section.key}">\n<h2>{title}</h2>\n{body}\n</section>'

    def _block(self, block: Block) -> str:
        match block:
            case Paragraph(text):
                return f"<p>{to_html(text)}</p>"
            case Missing(text):
                return f'<p class="missing">{to_html(text)}</p>'
            case Commands(title, lines):
                listed = "\n".join(f"<li>{_command(line)}</li>" for line in lines)
                return f'<p>{to_html(title)}</p>\n<ul class="commands">{listed}</ul>'
            case Replay(name, words):
                link = f'<a href="replays/{name}.html">Replay in 3-D</a>'
                return f'<p class="replay">{link}: {to_html(words)}</p>'
            case Table():
                return self._table(block)
            case Figure():
                return self._figure(block)

    def _figure(self, figure: Figure) -> str:
        picture = self._pictures[figure.name]
        caption = _caption(f"Figure {next(self._figures)}", figure)
        return (
            f'<figure id="figure-{figure.name}">\n'
            f'<div class="picture">{picture}</div>\n'
            f"<figcaption>{caption}</figcaption>\n</figure>"
        )

    def _table(self, table: Table) -> str:
        kinds = [_kind(column) for column in table.columns]
        heads = "".join(
            f"<th{kind}>{to_html(column.title)}</th>"
            for kind, column in zip(kinds, table.columns, strict=True)
        )
        notes = table.notes or [""] * len(table.rows)
        rows = []
        for cells, note in zip(table.rows, notes, strict=True):
            inside = "".join(
                f"<td{kind}>{_cell(cell)}</td>"
                for kind, cell in zip(kinds, cells, strict=True)
            )
            rows.append(f'<tr class="noted">{inside}</tr>' if note else _row(inside))
            if note:
                wide = f'<td colspan="{len(kinds)}">{to_html(note)}</td>'
                rows.append(f'<tr class="note">{wide}</tr>')
        caption = _caption(f"Table {next(self._tables)}", table)
        short = ' class="short"' if len(table.rows) <= _SHORT else ""
        return (
            f"<table{short}>\n<caption>{caption}</caption>\n<thead>{_row(heads)}</thead>\n"
            f"<tbody>\n{chr(10).join(rows)}\n</tbody>\n</table>"
        )


def _kind(column: Column) -> str:
    if column.number:
        return ' class="number"'
    return ' class="whole"' if column.whole else ""


def _cell(text: str) -> str:
    tone = _TONES.get(text)
    return f'<span class="{tone}">{text}</span>' if tone else to_html(text)


def _row(inside: str) -> str:
    return f"<tr>{inside}</tr>"


def _caption(label: str, block: Figure | Table) -> str:
    words = f"<b>{label}.</b> {to_html(block.caption)}"
    return f"{words} {_command(block.command)}" if block.command else words


def _command(line: str) -> str:
    return f'<code class="command">{html.escape(line)}</code>'


def _text(name: str) -> str:
    page = files("vcbf_drake.viz.report") / "page" / name
    return page.read_text(encoding="utf-8")
