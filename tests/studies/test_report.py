from __future__ import annotations

from collections import defaultdict
from html.parser import HTMLParser
import json
from pathlib import Path
import re
import shutil
import struct
from xml.etree import ElementTree

import pytest

from tests.helpers.browser import browser
from tests.helpers.synthetic_reproduction import (
    PAIR,
    Maker,
    verdicts,
    write_data,
    write_reproduction,
)
from vcbf_drake.viz.report import reproduction_markdown, write_report
from vcbf_drake.viz.report.inline_svg import inline_svg
from vcbf_drake.viz.report.markup import to_html
from vcbf_drake.viz.report.page import page_html
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.sections import build_sections
from vcbf_drake.viz.report.tables import without_repeats
from vcbf_drake.viz.report.wording import fixed, readable

FIGURES = {
    "test_1_paths",
    "test_1_barriers",
    "test_1_estimate",
    "test_1_steady_winds",
    "test_2_paths",
    "test_2_slack",
    "test_2_volume",
    "test_2_feasible_sets",
    "test_2_feasible_solids",
    "test_2_inputs",
    "test_2_explicit",
    "test_2_explicit_errors",
    "table_1_case_1",
    "table_1_case_2",
    "population_blimp",
    "car_1_paths",
    "car_1_barriers",
    "car_2",
    "population_car",
    "ablation_starts",
    "ablation_courses",
    "knobs",
}
REPLAYS = {"test_1", "test_2", "car_1", "car_2"}


class Reader(HTMLParser):
    """What a page refers to, what it names, and whether its elements close."""

    VOID = frozenset({"meta", "link", "br", "img", "input", "hr"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.references: list[tuple[str, str]] = []
        self.identifiers: list[str] = []
        self.open: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        self._note(tag, attributes)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        self._note(tag, attributes)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def _note(self, tag, attributes):
        for name, value in attributes:
            if name in ("src", "href", "xlink:href", "data", "srcset"):
                self.references.append((tag, value))
            if name == "id":
                self.identifiers.append(value)


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    path = tmp_path_factory.mktemp("reproduction")
    write_reproduction(path)
    write_report(path)
    return path


@pytest.fixture(scope="module")
def page(directory):
    return (directory / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def data(directory):
    return json.loads((directory / "reproduction.json").read_text(encoding="utf-8"))


def without_svg(page):
    return re.sub("<svg.*?</svg>", "", page, flags=re.DOTALL)


def test_the_page_is_sound_html_with_unique_names(page):
    reader = Reader(page)
    assert not reader.open
    assert len(reader.identifiers) == len(set(reader.identifiers))
    inside = {value[1:] for _, value in reader.references if value.startswith("#")}
    assert inside <= set(reader.identifiers)
    clipped = set(re.findall(r"url\(#([^)]+)\)", page))
    assert clipped and clipped <= set(reader.identifiers)


def test_the_page_needs_nothing_from_elsewhere(page, directory):
    reader = Reader(page)
    assert not {"script", "iframe", "object", "embed"} & set(reader.tags)
    assert "@import" not in page and not re.search(r"url\((?!#)", page)
    for tag, value in reader.references:
        if value.startswith(("#", "data:")):
            continue
        if tag == "a" and value.startswith("https://arxiv.org/"):
            continue
        assert (directory / value).is_file()  # A replay beside the page.
    assert len(page.encode()) < 5e6


def test_every_figure_is_in_the_page_and_on_disk(page, directory, data):
    assert set(re.findall(r'<figure id="figure-([^"]+)"', page)) == FIGURES
    for name in FIGURES:
        root = ElementTree.parse(directory / "figures" / f"{name}.svg").getroot()
        assert root.tag.endswith("svg")
        png = (directory / "figures" / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", png[16:24])
        assert 900 < width < 1600 and 250 < height < 2000
    assert {path.stem for path in (directory / "replays").iterdir()} == REPLAYS
    assert "left-out" not in page
    tables = (directory / "reproduction.md").read_text(encoding="utf-8")
    assert tables == reproduction_markdown(data)


def test_figures_and_tables_are_numbered_and_captioned(page):
    for kind, tag in (("Figure", "figcaption"), ("Table", "caption")):
        captions = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        for number, caption in enumerate(captions, start=1):
            assert caption.startswith(f"<b>{kind} {number}.</b>")
            assert len(re.sub("<[^>]+>", "", caption)) > 30
    figures = re.findall("<figcaption>(.*?)</figcaption>", page, re.DOTALL)
    assert all('<code class="command">' in caption for caption in figures)


def rendered(data):
    """The page without its pictures, which need no runs then."""
    sections = build_sections(Reproduction(data, Path("nowhere")))
    return page_html("title", sections, defaultdict(str), "remark")


def number_paths(value, path=()):
    if isinstance(value, dict):
        for key, each in value.items():
            yield from number_paths(each, (*path, key))
    elif isinstance(value, list):
        for place, each in enumerate(value):
            yield from number_paths(each, (*path, place))
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield path


def replaced(data, path, value):
    """A copy of nested data with one entry replaced."""
    if not path:
        return value
    copy = data.copy()
    copy[path[0]] = replaced(data[path[0]], path[1:], value)
    return copy


def entry(data, path):
    for key in path:
        data = data[key]
    return data


# The outcome says which of the times is told; trials are counted by their outcomes; an
# index is in its command, and what is usual is drawn.
UNTOLD = re.compile(
    "/(running_time|reached_at|infeasible_at|trials|index|usual)$"
    "|car_2/gains"
    "|volumes/(mean_difference|not_lower/(count|of|interval))"
    "|interior/.*/(rate|interval)"
    "|with_slack/(of|rate|interval)"
    "|^test_2/estimation"
    "|^test_2_explicit/.*(rms_error|above_printed_bound)"
)


def test_every_number_of_the_data_is_shown(data):
    for key, part in data.items():
        before, paths = rendered({key: part}), list(number_paths(part))
        assert paths or key == "verdicts"
        for path in paths:
            changed = replaced(part, path, 1.37 * entry(part, path) + 2.0)
            if rendered({key: changed}) == before:
                assert UNTOLD.search("/".join(map(str, (key, *path))))


def test_the_tables_numbers_are_those_of_the_data(data):
    text = reproduction_markdown(data)
    for method, run in data["test_1"]["runs"].items():
        least = f"{run['summary']['min_barrier']:.4f}"
        row = next(line for line in text.splitlines() if least in line)
        assert method.replace("-", "") in row.lower().replace("-", "").replace(" ", "")
    case = data["table_1"]["case_1"]["methods"]["dob-cbf-qp"]
    low, high = case["interval"]
    expected = f"| 10.67 | {case['mean_running_time']:.2f} | {low:.2f} to {high:.2f} |"
    assert expected in text
    assert f"{case['outcomes']['infeasible']}" in text


def test_the_markdown_is_tables_without_pictures(data):
    text = reproduction_markdown(data)
    assert "replays/" not in text and "<" not in text.replace("<higher>", "")
    tables = re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)
    assert len(tables) > 12
    for table in tables:
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}
        assert len(widths) == 1
    for claim in verdicts():
        row = next(line for line in text.splitlines() if claim["number"] in line)
        assert claim["claim"] in row and claim["command"] in row
        assert f"| {claim['found']} |" in row


def test_words_cannot_become_markup(page):
    assert "V_v stays &lt;higher&gt; &amp; above" in page
    assert to_html("a < b, `x < *y*` and *z*") == (
        "a &lt; b, <code>x &lt; *y*</code> and <em>z</em>"
    )
    assert to_html("k_p * 2 * 3") == "k_p * 2 * 3"
    link = to_html("[the paper](https://arxiv.org/abs/2503.13996)")
    assert link == '<a href="https://arxiv.org/abs/2503.13996">the paper</a>'


@pytest.mark.parametrize(
    ("value", "digits", "words"),
    [
        (None, 2, "–"),
        (-1e-9, 3, "0.000"),
        (-0.0204, 3, "−0.020"),
        (12.345, 1, "12.3"),
    ],
)
def test_numbers_in_words(value, digits, words):
    assert fixed(value, digits) == words


def test_labels_as_they_are_set():
    assert readable("k_p=0.2") == "k_p = 0.2"
    assert readable("from -0.6 to 3 m/s^2") == "from −0.6 to 3 m/s²"
    assert readable("dob-cbf-qp, 3-4") == "dob-cbf-qp, 3-4"


def test_repeated_leading_cells_are_left_empty():
    rows = [["a", "b", "1"], ["a", "b", "1"], ["a", "c", "1"], ["d", "c", "1"]]
    assert without_repeats(rows, 2) == [
        ["a", "b", "1"],
        ["", "", "1"],
        ["", "c", "1"],
        ["d", "c", "1"],
    ]
    assert without_repeats(rows, 0) == rows


def test_inline_svg_keeps_what_it_needs_alone():
    text = (
        '<?xml version="1.0"?>\n<svg viewBox="0 0 72 36" xmlns="http://w3.org">\n'
        "<metadata>x</metadata><style>*{}</style>\n"
        '<g id="unused"><path id="a" d="M 1.23456 -0.98765 L 7 8.5 z"/></g>\n'
        '<use xlink:href="#a" style="fill: url(#b)" x="1.23456"/><g id="b"/></svg>'
    )
    svg = inline_svg(text, "name")
    assert svg.startswith('<svg viewBox="0 0 72 36" width="114"')
    assert 'd="M 1.23 -0.99 L 7 8.5 z"' in svg and 'x="1.23456"' in svg
    assert 'id="name-a"' in svg and 'id="name-b"' in svg and "unused" not in svg
    assert 'href="#name-a"' in svg and "url(#name-b)" in svg
    assert "metadata" not in svg and "<style" not in svg and "http" not in svg


def test_the_settings_are_told(data):
    told = "few trials, wide intervals. trials: 8; drake 1.51.1, code `99128a01`."
    assert told in reproduction_markdown(data)
    full = data | {"settings": {"quick": False, "trials": 200}}
    text = reproduction_markdown(full)
    assert "trials: 200." in text and "quick" not in text


def test_what_is_missing_is_left_out_and_told(tmp_path):
    maker = Maker(tmp_path)
    write_data(tmp_path, {"test_2": maker.test_2(), "table_1": maker.table_1()})
    shutil.rmtree(tmp_path / "runs" / "test_2" / PAIR[0])
    (tmp_path / "studies" / "table_1_case_2.jsonl").unlink()
    page = write_report(tmp_path).read_text(encoding="utf-8")
    assert re.findall('<section id="([^"]+)"', page) == [
        "test-2",
        "table-1",
        "left-out",
    ]
    for title in (
        "What was found",
        "Test 1: one obstacle in a wind",
        "Car experiment 2",
    ):
        assert title in page[page.index('id="left-out"') :]
    lacking = "for want of <code>runs/test_2/dob-cbf-qp"
    assert page.count(lacking) == 7  # Six figures and the replay.
    assert "for want of <code>studies/table_1_case_2.jsonl" in page
    assert re.findall('<figure id="figure-([^"]+)"', page) == ["table_1_case_1"]
    assert "replays/" not in page
    assert page.count("<caption>") == 3  # Tables need the numbers alone.


def test_one_case_of_the_table_is_enough(tmp_path):
    data = {"table_1": Maker(tmp_path).table_1()}
    del data["table_1"]["case_2"]
    text = reproduction_markdown(data)
    assert "18.22" in text and "16.21" not in text
    assert "Left out: `case_2`, not run." in text


def test_crashed_trials_are_told(tmp_path):
    data = {"table_1": Maker(tmp_path).table_1()}
    crashed = {"index": 5, "replay": "vcbf-drake run the-one-that-crashed"}
    data["table_1"]["case_1"]["errors"] = [crashed]
    assert crashed["replay"] in reproduction_markdown(data)


def test_no_reproduction_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"reproduction\.json"):
        write_report(tmp_path)


def test_the_same_numbers_give_the_same_bytes(tmp_path):
    contents = []
    for name in ("first", "second"):
        directory = tmp_path / name
        directory.mkdir()
        maker = Maker(directory)
        write_data(directory, {"table_1": maker.table_1(), "car_1": maker.car_1()})
        write_report(directory)
        contents.append(
            {
                str(path.relative_to(directory)): path.read_bytes()
                for path in sorted(directory.rglob("*"))
                if path.suffix in (".html", ".svg", ".png")
            }
        )
    assert len(contents[0]) == 10
    assert contents[0] == contents[1]


@pytest.mark.slow
def test_a_real_browser_opens_it_without_a_word(directory):
    count = "document.querySelectorAll('figcaption').length || null"
    with browser() as tab:
        tab.open((directory / "report.html").as_uri())
        assert tab.settle(count) == len(FIGURES)
        assert not tab.errors
