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
from vcbf_drake.viz.report.tables import tally_table
from vcbf_drake.viz.report.tally import Tally
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
        _outcomes(cases),
    ]
    for key, case in cases.items():
        blocks += _pairs(key, case, saved)
    absent = [f"`{key}`" for key in CASES if key not in cases]
    if absent:
        blocks.append(Missing(f"Left out: {', '.join(absent)}, not run."))
    return blocks


def _means(cases: Mapping[str, Any]) -> Table:
    rows = []
    for key, case in cases.items():
        for name, method in METHODS.items():
            own = case["methods"][method]
            rows.append(
                [
                    f"{key.replace('_', ' ')}, {CASES[key]}",
                    f"{name}, {method_label(method)}",
                    fixed(case["paper"][name]),
                    fixed(own["mean_running_time"]),
                    between(own["interval"]),
                    str(own["trials"]),
                ]
            )
    return Table(
        "Table I of the paper: the mean of the running time, the lesser of 20 s and the"
        " first infeasible tick. The paper gives neither the number of its trials nor"
        " an interval; its layout is not known.",
        [
            Column("case"),
            Column("running time"),
            *number_columns("paper [s]", "here [s]", "95 % interval", "trials"),
        ],
        rows,
    )


def _outcomes(cases: Mapping[str, Any]) -> Table:
    rows = [
        ([key.replace("_", " "), method_label(method)], Tally.from_numbers(method, own))
        for key, case in cases.items()
        for method, own in case["methods"].items()
    ]
    return tally_table("How the trials of Table I ended.", ["case", "method"], rows)


def _pairs(key: str, case: Mapping[str, Any], saved: Reproduction) -> Iterator[Block]:
    title = f"{key.replace('_', ' ').capitalize()}, {CASES[key]}"
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
