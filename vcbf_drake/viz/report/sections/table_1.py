"""Table I of the paper: mean running times over random starts and random gains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from vcbf_drake.viz.report.document import (
    Block,
    Column,
    Commands,
    Figure,
    Missing,
    Paragraph,
    Table,
    number_columns,
)
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.tables import METHOD, OUTCOME_TITLES, without_repeats
from vcbf_drake.viz.report.tally import OUTCOMES, Tally
from vcbf_drake.viz.report.wording import between, fixed, method_label
from vcbf_drake.viz.running_time_figure import running_time_figure

CASES = {"case_1": "random starts", "case_2": "random observer gains"}
# T1 is the proposed method's mean running time, T2 the one without volume barrier.
METHODS = {"T1": "dob-vcbf-qp", "T2": "dob-cbf-qp"}


def table_1(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """The means beside the paper's, the outcomes, and every pair of trials."""
    cases = {key: numbers[key] for key in CASES if numbers.get(key)}
    blocks: list[Block] = [
        Paragraph(numbers["description"]),
        _means(cases),
    ]
    for key, case in cases.items():
        blocks += _pairs(key, case, saved)
    absent = [f"`{key}`" for key in CASES if key not in cases]
    if absent:
        blocks.append(Missing(f"Left out: {', '.join(absent)}, not run."))
    return blocks


def _means(cases: Mapping[str, Any]) -> Table:
    rows = [
        (_title(key), name, method, case)
        for key, case in cases.items()
        for name, method in METHODS.items()
    ]
    tallies = [
        Tally.from_numbers(method, case["methods"][method])
        for _, _, method, case in rows
    ]
    shown = [each for each in OUTCOMES if any(t.count(each) for t in tallies)]
    cells = [
        [
            title,
            name,
            method_label(method),
            fixed(case["paper"][name]),
            fixed(tally.mean),
            between(tally.interval),
            str(tally.trials),
            *(str(tally.count(outcome)) for outcome in shown),
        ]
        for (title, name, method, case), tally in zip(rows, tallies, strict=True)
    ]
    return Table(
        "Table I of the paper beside ours: mean running times, the lesser of 20 s and"
        " the first infeasible tick, with 95 % intervals, and how the trials ended. The"
        " paper gives neither the number of its trials nor an interval nor its layout.",
        [
            Column("case"),
            Column("", whole=True),
            METHOD,
            *number_columns("paper [s]", "here [s]", "95 % interval", "trials"),
            *number_columns(*(OUTCOME_TITLES[outcome] for outcome in shown)),
        ],
        without_repeats(cells, 1),
    )


def _title(key: str) -> str:
    return f"{key.replace('_', ' ').capitalize()}, {CASES[key]}"


def _pairs(key: str, case: Mapping[str, Any], saved: Reproduction) -> Iterator[Block]:
    title = _title(key)
    comparison = case["comparisons"][0]
    yield Figure(
        f"table_1_{key}",
        f"{title}: every pair of trials as one column, both methods from the same draw,"
        " in the order of the running time without the volume barrier. At the right the"
        f" means with their 95 % intervals. The volume barrier did better in"
        f" {comparison['better']} of {comparison['pairs']} pairs, the same in"
        f" {comparison['same']} and worse in {comparison['worse']}.",
        lambda: running_time_figure(saved.records(case["file"]), case),
        case["command"],
    )
    worse = comparison["worse_trials"]
    if worse:
        yield Commands(
            f"{title}: the {len(worse)} trials in which the volume barrier did worse;"
            " each command runs one again.",
            [trial["replay"] for trial in worse],
        )
    else:
        yield Paragraph(f"{title}: in no trial did the volume barrier do worse.")
    if case["errors"]:
        yield Commands(
            f"{title}: the {len(case['errors'])} trials that crashed, and are in no"
            " mean; each command runs one again.",
            [trial["replay"] for trial in case["errors"]],
        )
