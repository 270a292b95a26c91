"""The report, from short runs and made-up trials of every experiment."""

from __future__ import annotations

import dataclasses
from html.parser import HTMLParser
import json
import re
import shutil
import struct
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

from examples.paper import archive as archive_module
from examples.paper.__main__ import EXPERIMENTS
from examples.paper.archive import Archive, reproduce
from examples.paper.experiment import Settings
from examples.paper.report import Figure, Replay, write_report
from examples.paper.words import fixed, readable, table
from tests.helpers.browser import browser
from tests.helpers.stand_ins import of_each_vehicle
from vcbf_drake.simulation import simulate
import vcbf_drake.studies.trial as trial_module

FIGURES = {
    "test_1_paths", "test_1_barriers", "test_1_estimate", "test_1_steady_winds",
    "test_2_paths", "test_2_slack", "test_2_volume", "test_2_feasible_sets",
    "test_2_feasible_solids", "test_2_inputs", "test_2_explicit",
    "test_2_explicit_errors", "table_1_case_1", "table_1_case_2", "population_blimp",
    "car_1_paths", "car_1_barriers", "car_2", "population_car", "ablation_starts",
    "ablation_courses", "knobs",
}  # fmt: skip
REPLAYS = {"test_1", "test_2", "car_1", "car_2"}
ALL = list(EXPERIMENTS.values())


def short(scenario):
    return simulate(dataclasses.replace(scenario, duration=1.1))


def made_up(scenario, step_time):
    """Without the volume barrier two draws of three fail."""
    lucky = scenario.name.endswith("0") or scenario.method == "dob-vcbf-qp"
    numbers = {
        "outcome": "reached" if lucky else "infeasible",
        "running_time": 20.0 if lucky else 4.25,
        "reached_at": 9.0 if lucky else None,
        "infeasible_at": None if lucky else 4.25,
        "collided_at": None,
        "min_barrier": 0.0431,
        "min_volume": 0.0172,
        "max_abs_slack": 0.0,
        "ticks": 1000,
        "relaxed_ticks": 0,
        "infeasible_ticks": 0,
        "decayed_ticks": 0,
        "failed_ticks": 0,
        "final_status": 1,
        "reasons_against": [],
    }
    return SimpleNamespace(summary=numbers)


def reproduced(directory, experiments):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archive_module, "simulate", short)
        patch.setattr(trial_module, "simulate_fleet", of_each_vehicle(made_up))
        data = reproduce(directory, experiments, Settings(True, 2, 3, 2, 1, 1, 1))
    write_report(directory, ALL)
    return data


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    path = tmp_path_factory.mktemp("reproduction")
    reproduced(path, ALL)
    return path


@pytest.fixture(scope="module")
def page(directory):
    return (directory / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def tables(directory):
    return (directory / "reproduction.md").read_text(encoding="utf-8")


class Reader(HTMLParser):
    """What a page refers to, what it names, and whether its elements close."""

    VOID = frozenset({"meta", "link", "br", "img", "input", "hr"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.identifiers: list[str] = []
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.add(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href"):
                self.references.append(value)
            if name == "id":
                self.identifiers.append(value)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_sound_html_that_needs_nothing_from_elsewhere(page, directory):
    reader = Reader(page)
    assert not reader.open
    assert len(reader.identifiers) == len(set(reader.identifiers))
    assert not {"script", "iframe", "object", "embed"} & reader.tags
    for value in reader.references:
        if value.startswith("#"):
            assert value[1:] in reader.identifiers
        elif not value.startswith(("data:", "https://arxiv.org/")):
            assert (directory / value).is_file()  # A replay beside the page.


def test_every_figure_is_in_the_page_and_on_disk(page, directory):
    assert set(re.findall(r'<figure id="figure-([^"]+)"', page)) == FIGURES
    captions = re.findall("<figcaption>(.*?)</figcaption>", page, re.DOTALL)
    assert all(len(re.sub("<[^>]+>", "", caption)) > 30 for caption in captions)
    for name in FIGURES:
        root = ElementTree.parse(directory / "figures" / f"{name}.svg").getroot()
        assert root.tag.endswith("svg")
        png = (directory / "figures" / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", png[16:24])
        assert 900 < width < 1600 and 250 < height < 2000
    assert {path.stem for path in (directory / "replays").iterdir()} == REPLAYS
    assert "left-out" not in page and "for want of" not in page


def test_the_markdown_is_tables_without_pictures(tables, directory):
    assert "replays/" not in tables and "<" not in tables
    found = re.findall(r"(?:^\|.*\|\n)+", tables, re.MULTILINE)
    assert len(found) > 12
    for each in found:
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in each.splitlines()}
        assert len(widths) == 1
    data = json.loads((directory / "reproduction.json").read_text())
    assert len(data["verdicts"]) == 21
    for claim in data["verdicts"]:
        row = next(line for line in tables.splitlines() if claim["number"] in line)
        assert claim["claim"] in row and claim["command"] in row
        assert f"| {claim['found']} |" in row


def told(key, numbers, directory):
    """All that an experiment says of its numbers, without its pictures."""
    words = []
    for block in EXPERIMENTS[key].show(numbers, Archive(directory)):
        if isinstance(block, Figure):
            words += [block.caption, block.command]
        else:
            words.append(block.words if isinstance(block, Replay) else block)
    return "".join(words)


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


# Not in words of their own: the outcome says which of the times is told, trials are
# counted by their outcomes, verdicts and pictures have the rest.
UNTOLD = re.compile(
    "/summary/(?!min_barrier|min_volume|max_abs_slack|final_distance)"
    "|/(trials|index|wind|with_slack|least_barrier|paper|comparisons|T1|T2)(/|$)"
    "|/errors/|rates/.*/interval|volumes/(mean_difference|not_lower/)"
    "|interior/.*/(rate|interval)|^test_2/estimation"
    "|^test_2_explicit/.*(rms_error|above_printed_bound)"
    "|^table_1/.*/(least_volume|greatest_slack)"
    "|by_gain/.*/rates"
)


@pytest.mark.parametrize("key", EXPERIMENTS)
def test_every_number_of_the_results_is_told(key, directory):
    data = json.loads((directory / "reproduction.json").read_text())[key]
    before, untold = told(key, data, directory), []
    for path in number_paths(data):
        value: Any = data
        for step in path:
            value = value[step]
        changed = replaced(data, path, 1.37 * value + 2.0)
        name = "/".join(map(str, (key, *path)))
        if told(key, changed, directory) == before and not UNTOLD.search(name):
            untold.append(name)
    assert untold == []


def test_what_is_missing_is_left_out_and_told(tmp_path):
    reproduced(tmp_path, [EXPERIMENTS["car_1"], EXPERIMENTS["table_1"]])
    shutil.rmtree(tmp_path / "runs" / "car_1" / "cbf-qp")
    (tmp_path / "studies" / "table_1_case_2.jsonl").unlink()
    page = write_report(tmp_path, ALL).read_text(encoding="utf-8")
    sections = re.findall('<section id="([^"]+)"', page)
    assert sections == ["verdicts", "table_1", "car_1", "left-out"]
    left_out = page[page.index('id="left-out"') :]
    assert "Test 1: one obstacle in a wind" in left_out
    # Two figures and the replay.
    assert page.count("for want of <code>runs/car_1/cbf-qp") == 3
    assert "for want of <code>studies/table_1_case_2.jsonl" in page
    assert re.findall('<figure id="figure-([^"]+)"', page) == ["table_1_case_1"]


def test_the_same_numbers_give_the_same_bytes(tmp_path):
    contents = []
    for name in ("first", "second"):
        reproduced(tmp_path / name, [EXPERIMENTS["car_1"]])
        contents.append(
            {
                str(path.relative_to(tmp_path / name)): path.read_bytes()
                for path in sorted((tmp_path / name).rglob("*"))
                if path.suffix in (".html", ".svg", ".png", ".md")
            }
        )
    assert len(contents[0]) == 7
    assert contents[0] == contents[1]


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


def test_tables_align_numbers_and_leave_repeats_empty():
    rows = [["a", "b", "1"], ["a", "b", "–"], ["a", "c|d", "1 to 2"]]
    assert table("Words.", ["x", "y", "z"], rows, "run", merged=2).splitlines() == [
        "Words. `run`",
        "",
        "| x | y | z |",
        "| --- | --- | ---: |",
        "| a | b | 1 |",
        "|  |  | – |",
        r"|  | c\|d | 1 to 2 |",
    ]


@pytest.mark.slow
def test_a_real_browser_opens_it_without_a_word(directory):
    count = "document.querySelectorAll('figcaption').length || null"
    with browser() as tab:
        tab.open((directory / "report.html").as_uri())
        assert tab.settle(count) == len(FIGURES)
        assert not tab.errors
