"""How often unselected layouts leave no feasible input, and what then helps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from vcbf_drake.viz.report.document import (
    Block,
    Column,
    Figure,
    Paragraph,
    Table,
    number_columns,
)
from vcbf_drake.viz.report.figures.outcome_figure import Row, outcome_figure
from vcbf_drake.viz.report.reproduction import Reproduction, in_drawing_order
from vcbf_drake.viz.report.tables import METHOD, tally_table
from vcbf_drake.viz.report.tally import Tally
from vcbf_drake.viz.report.wording import NOTHING, method_label, percent, readable

WITHOUT, WITH = "dob-cbf-qp", "dob-vcbf-qp"
FAILURES = ("infeasible", "collision")


def population_blimp(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Outcomes and rates over random courses, and how these are drawn."""
    return [
        Paragraph(numbers["description"]),
        Figure(
            "population_blimp",
            f"How {numbers['layouts']} random courses end with and without the volume"
            " barrier, and, in the last bar, how those end with it that fail without.",
            lambda: outcome_figure(list(_bars("", numbers, saved))),
            numbers["command"],
        ),
        tally_table(
            "The same in numbers.",
            [METHOD],
            [([method_label(each.method)], each) for each in _tallies(numbers)],
            numbers["command"],
        ),
        _rates_table("The same as rates with Wilson's 95 % intervals.", numbers),
        _generator_table(numbers["generator"]),
    ]


def population_car(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Outcomes for every gain of the reference, rates, and how courses are drawn."""

    def bars() -> list[Row]:
        return [
            row
            for gain, study in numbers["by_gain"].items()
            for row in _bars(f"$k_p$ = {gain}: ", study, saved)
        ]

    return [
        Paragraph(numbers["description"]),
        Figure(
            "population_car",
            f"How {numbers['layouts']} random courses end at each gain of the"
            " reference, with and without the volume barrier, and how those end with"
            " it that fail without.",
            lambda: outcome_figure(bars()),
            numbers["command"],
        ),
        tally_table(
            "The same in numbers, running times to the first failure.",
            [Column("*k_p*", whole=True), METHOD],
            [
                ([gain, method_label(tally.method)], tally)
                for gain, study in numbers["by_gain"].items()
                for tally in _tallies(study)
            ],
            numbers["command"],
        ),
        _rates_table(
            "The rates over all gains, with Wilson's 95 % intervals.", numbers
        ),
        _generator_table(numbers["generator"]),
    ]


def _tallies(study: Mapping[str, Any]) -> list[Tally]:
    methods = in_drawing_order(study["methods"])
    return [Tally.from_numbers(method, each) for method, each in methods.items()]


def _bars(prefix: str, study: Mapping[str, Any], saved: Reproduction) -> Iterator[Row]:
    """Both methods over all courses, and the second where the first fails."""
    records = saved.records(study["file"])
    lost = {
        record["index"]
        for record in records
        if record["method"] == WITHOUT and record["outcome"] in FAILURES
    }
    for method in (WITHOUT, WITH):
        yield prefix + method_label(method), _tally(method, records)
    if not lost:
        return
    rescued = [record for record in records if record["index"] in lost]
    yield f"{prefix}{method_label(WITH)}, where that fails", _tally(WITH, rescued)


def _tally(method: str, records: Sequence[Mapping[str, Any]]) -> Tally:
    own = (record["outcome"] for record in records if record["method"] == method)
    return Tally(method, Counter(own))


def _rates_table(caption: str, numbers: Mapping[str, Any]) -> Table:
    rates = dict(numbers["rates"])
    for method, rate in numbers.get("layouts_with_a_failure", {}).items():
        rates[f"courses in which {method} fails at some gain"] = rate
    return Table(
        caption,
        [Column("event"), *number_columns("count", "of", "rate", "95 % interval")],
        [
            [name, str(rate["count"]), str(rate["of"]), *_shares(rate)]
            for name, rate in rates.items()
        ],
        command=numbers["command"],
    )


def _shares(rate: Mapping[str, Any]) -> list[str]:
    if rate["interval"] is None:
        return [NOTHING, NOTHING]
    low, high = map(percent, rate["interval"])
    return [percent(rate["rate"]), f"{low} to {high}"]


def _generator_table(generator: Mapping[str, Any]) -> Table:
    """How a course is drawn: every entry of the generator as a row."""
    ranges = generator.get("ranges", {})
    rows = [
        [readable(name), readable(f"{low:g} to {high:g}")]
        for name, (low, high) in ranges.items()
    ]
    for name, value in generator.items():
        if name != "ranges":
            rows.append([readable(name), _entry(value)])
    return Table(
        "How the courses are drawn: uniformly where a range stands.",
        [Column("quantity"), Column("from")],
        rows,
    )


def _entry(value: Any) -> str:
    if not isinstance(value, list):
        return f"{value:g}" if isinstance(value, float) else str(value)
    return ", ".join(
        f"({_entry(each)})" if isinstance(each, list) else _entry(each)
        for each in value
    )
