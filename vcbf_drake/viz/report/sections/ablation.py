"""What each correction of the published method buys."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vcbf_drake.viz.report.document import Block, Column, Figure, Paragraph
from vcbf_drake.viz.report.figures.outcome_figure import Row, outcome_figure
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.tables import tally_table
from vcbf_drake.viz.report.tally import Tally


def ablation(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Every set of corrections, from random starts and over random courses."""
    method, variants = numbers["method"], numbers["variants"]
    starts = [(each["label"], Tally.from_numbers(method, each)) for each in variants]
    courses = [
        (each["label"], Tally.from_numbers(method, each["courses"]))
        for each in variants
    ]
    return [
        Paragraph(numbers["description"]),
        *_compared("starts", "from random starts on Test 2's course", starts, numbers),
        *_compared("courses", "over random courses", courses, numbers),
    ]


def _compared(
    name: str, words: str, rows: Sequence[Row], numbers: Mapping[str, Any]
) -> list[Block]:
    return [
        Figure(
            f"ablation_{name}",
            f"The method with the published equations, with single corrections and with"
            f" all, {words}: how the trials ended, and how long they ran on average.",
            _draw(rows),
            numbers["command"],
        ),
        tally_table(
            f"The same in numbers, {words}. A slack of 0 is exactly 0.",
            [Column("corrections")],
            [([label], tally) for label, tally in rows],
            numbers["command"],
        ),
    ]


def _draw(rows: Sequence[Row]) -> Callable[[], Any]:
    return lambda: outcome_figure(rows)
