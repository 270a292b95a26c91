"""write_report: from a reproduction's directory to one page with its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import os
from pathlib import Path
from typing import Any

from vcbf_drake.viz.replay import write_replay
from vcbf_drake.viz.report.document import Block, Figure, Missing, Replay
from vcbf_drake.viz.report.inline_svg import inline_svg
from vcbf_drake.viz.report.markdown import markdown
from vcbf_drake.viz.report.page import page_html
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.sections import build_sections
from vcbf_drake.viz.style import figure_style, save_figure

TITLE = "The volume barrier paper, reproduced"
REMARK = (
    "Made by `vcbf-drake reproduce`. Every number comes from `reproduction.json` beside"
    " this page, every figure is in `figures/` as SVG and PNG."
)


def write_report(directory: str | Path) -> Path:
    """Writes report.html, figures/ and replays/, and the tables as reproduction.md.

    What the directory lacks, the report leaves out and says so.

    Args:
        directory: Where reproduction.json, runs/ and studies/ are.

    Returns:
        The path of report.html.

    Raises:
        FileNotFoundError: There is no reproduction.json.
    """
    directory = Path(directory)
    saved = Reproduction.read(directory)
    pictures: dict[str, str] = {}
    sections = [
        replace(section, blocks=[_made(b, directory, pictures) for b in section.blocks])
        for section in build_sections(saved)
    ]
    page = page_html(TITLE, sections, pictures, REMARK)
    _write(directory / "reproduction.md", reproduction_markdown(saved.data))
    return _write(directory / "report.html", page)


def reproduction_markdown(data: Mapping[str, Any]) -> str:
    """Returns a reproduction's verdicts and tables as Markdown.

    Args:
        data: The contents of reproduction.json.
    """
    remark = (
        "Made by `vcbf-drake reproduce`, which also writes a page with the figures;"
        " no number here is typed."
    )
    return markdown(TITLE, build_sections(Reproduction(data, Path())), remark)


def _made(block: Block, directory: Path, pictures: dict[str, str]) -> Block:
    """The block once its files are written, or a line that says what it lacks."""
    if not isinstance(block, Figure | Replay):
        return block
    try:
        if isinstance(block, Figure):
            pictures[block.name] = _draw(block, directory / "figures")
        else:
            path = directory / "replays" / f"{block.name}.html"
            write_replay(block.results(), path)
    except FileNotFoundError as error:
        lacking = Path(str(error.filename)).relative_to(directory).as_posix()
        kind = type(block).__name__.lower()
        return Missing(f"Left out: the {kind} `{block.name}`, for want of `{lacking}`.")
    return block


def _draw(figure: Figure, directory: Path) -> str:
    """Draws a figure, writes it as PNG and SVG, and returns the SVG for the page."""
    directory.mkdir(parents=True, exist_ok=True)
    with figure_style():
        _, path = save_figure(figure.draw(), directory, figure.name)
    return inline_svg(path.read_text(encoding="utf-8"), figure.name)


def _write(path: Path, text: str) -> Path:
    """Writes the whole file, or leaves it as it was."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_bytes(text.encode("utf-8"))
    os.replace(temporary, path)
    return path
