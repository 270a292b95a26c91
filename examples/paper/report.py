"""The report of a reproduction: one HTML page, and its tables as Markdown."""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import json
from pathlib import Path
from typing import Any, TypeAlias

from jinja2 import Environment
from markdown_it import MarkdownIt

from vcbf_drake.files import atomic_write
from vcbf_drake.simulation.result import Result
from vcbf_drake.viz.replay import write_replay
from vcbf_drake.viz.style import figure_style, save_figure

from .archive import RESULTS, Archive
from .experiment import Experiment, Numbers
from .words import listed, table

TITLE = "The volume barrier paper, reproduced"

_TEMPLATE = Path(__file__).parent / "report.html.jinja"
_MARKDOWN = MarkdownIt().enable("table")
# The words that decide are told by their colour as well.
_TONES = {
    "reproduced": "good",
    "reproduced under stated conditions": "fair",
    "undecided": "fair",
    "not reproduced": "bad",
}


@dataclass(frozen=True)
class Figure:
    """A picture, drawn when the report is written.

    Attributes:
        name: The name of its files, and of its place in the page.
        caption: What is drawn and what to notice, as Markdown.
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


# Markdown, or something that is drawn.
Block: TypeAlias = str | Figure | Replay


def write_report(directory: Path, experiments: Sequence[Experiment]) -> Path:
    """Writes report.html, figures/ and replays/, and the tables as reproduction.md.

    What the directory lacks, the report leaves out and says so.

    Args:
        directory: What `reproduce` filled.
        experiments: In the order of the report.

    Returns:
        The path of report.html.
    """
    data = json.loads((directory / RESULTS).read_text(encoding="utf-8"))
    archive = Archive(directory)
    sections = list(_sections(data, archive, experiments))
    page = (
        Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
        .from_string(_TEMPLATE.read_text(encoding="utf-8"))
        .render(
            title=TITLE,
            sections=[
                (key, title, [_html(block, directory) for block in blocks])
                for key, title, blocks in sections
            ],
        )
    )
    atomic_write(directory / "reproduction.md", _markdown(sections))
    path = directory / "report.html"
    atomic_write(path, page)
    return path


def _sections(
    data: Numbers, archive: Archive, experiments: Sequence[Experiment]
) -> Iterator[tuple[str, str, list[Block]]]:
    yield "verdicts", "What was found", list(_verdicts(data))
    for each in experiments:
        if each.key in data:
            yield each.key, each.title, list(each.show(data[each.key], archive))
    absent = [f"*{each.title}*" for each in experiments if each.key not in data]
    if absent:
        yield "left-out", "Left out", [f"Not run: {listed(absent)}."]


def _verdicts(data: Numbers) -> Iterator[Block]:
    claims = data["verdicts"]
    found = Counter(claim["found"] for claim in claims)
    counts = [f"{found[verdict]} {verdict}" for verdict in _TONES if found[verdict]]
    yield (
        "This report repeats the experiments of *Robust Safety Critical Control Under"
        " Multiple State and Input Constraints: Volume Control Barrier Function"
        " Method* ([arXiv 2503.13996](https://arxiv.org/abs/2503.13996)) in"
        " simulation. The paper gives few of its numbers: the missing layouts, limits"
        " and disturbances are ours and are stated where they matter. Of"
        f" {len(claims)} claims: {', '.join(counts)}."
    )
    yield _settings(data["settings"])
    yield table(
        "The paper's claims in its order, with the finding, the number behind it, and"
        " the command that shows it. *Reproduced* means in the main setting and in"
        " the additional ones; *under stated conditions* means in the main setting"
        " only; *undecided* means that the 95 % intervals of few trials overlap.",
        ["claim", "in the paper", "found", "number", "command"],
        [
            [
                *(claim[name] for name in ("claim", "where", "found", "number")),
                f"`{claim['command']}`",
            ]
            for claim in claims
        ],
    )


def _settings(settings: Mapping[str, Any]) -> str:
    """How much was run, with which code."""
    counts = [
        f"{key.replace('_', ' ')}: {value}"
        for key, value in settings.items()
        if isinstance(value, int) and not isinstance(value, bool)
    ]
    code = [f"{name} {each}" for name, each in settings["versions"].items()]
    code.append(f"code `{settings['code']}`")
    text = f"{', '.join(counts)}; {', '.join(code)}."
    quick = "*A quick run:* few trials, wide intervals. "
    return quick + text if settings["quick"] else text


def _markdown(sections: Sequence[tuple[str, str, list[Block]]]) -> str:
    parts = [
        f"# {TITLE}",
        "Produced by `python -m examples.paper`, which also writes a page with the"
        " figures; no number here is typed by hand.",
    ]
    for _, title, blocks in sections:
        parts += [f"## {title}", *(each for each in blocks if isinstance(each, str))]
    return "\n\n".join(parts) + "\n"


def _html(block: Block, directory: Path) -> str:
    if isinstance(block, str):
        html: str = _MARKDOWN.render(block)
        for words, tone in _TONES.items():
            html = html.replace(f"<td>{words}</td>", f'<td class="{tone}">{words}</td>')
        return html
    try:
        if isinstance(block, Replay):
            path = f"replays/{block.name}.html"
            write_replay(block.results(), directory / path)
            words = f"[Replay in 3-D]({path}): {block.words}"
            return str(_MARKDOWN.render(words))
        return _figure(block, directory / "figures")
    except FileNotFoundError as error:
        lacking = Path(str(error.filename)).relative_to(directory).as_posix()
        kind = type(block).__name__.lower()
        words = f"Left out: the {kind} `{block.name}`, for want of `{lacking}`."
        return str(_MARKDOWN.render(words))


def _figure(figure: Figure, directory: Path) -> str:
    """Draws a figure, writes it as PNG and SVG, and returns it for the page."""
    directory.mkdir(parents=True, exist_ok=True)
    with figure_style():
        _, path = save_figure(figure.draw(), directory, figure.name)
    image = "data:image/svg+xml;base64," + b64encode(path.read_bytes()).decode()
    words = f"{figure.caption} `{figure.command}`" if figure.command else figure.caption
    caption = _MARKDOWN.renderInline(words)
    return (
        f'<figure id="figure-{figure.name}"><img src="{image}" alt="{figure.name}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )
