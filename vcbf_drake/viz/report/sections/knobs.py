"""The method against its own knobs, one at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from vcbf_drake.viz.report.document import Block, Column, Figure, Paragraph, Table
from vcbf_drake.viz.report.figures.knob_figure import Knob, knob_figure
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.tables import METHOD, tally_table
from vcbf_drake.viz.report.tally import Tally
from vcbf_drake.viz.report.wording import method_label
from vcbf_drake.viz.style import METHOD_STYLES


def knobs(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Running times and arrivals against every knob."""
    chosen = [_knob(each) for each in numbers.values() if _is_knob(each)]
    command = numbers["command"]
    return [
        Paragraph(numbers["description"]),
        Figure(
            "knobs",
            "One setting varied at a time, a column each, the others as in Test 2:"
            " above, the mean running time with its 95 % interval; below, the share of"
            f" trials that arrive.{_usual(chosen)}",
            lambda: knob_figure([_typeset(knob) for knob in chosen]),
            command,
        ),
        *(_table(knob, command) for knob in chosen),
    ]


def _usual(knobs: Sequence[Knob]) -> str:
    known = any(knob.usual is not None for knob in knobs)
    return " The grey band is at Test 2's own value." if known else ""


def _is_knob(entry: Any) -> bool:
    return isinstance(entry, Mapping) and "points" in entry


def _knob(numbers: Mapping[str, Any]) -> Knob:
    points, unit = numbers["points"], numbers["unit"]
    values = [point["value"] for point in points]
    usual = numbers.get("usual")
    return Knob(
        label=f"{numbers['label']}\u00a0[{unit or '-'}]",
        values=[f"{value:g}" for value in values],
        tallies={
            method: [_tally(method, point) for point in points]
            for method in METHOD_STYLES
            if any(method in point for point in points)
        },
        usual=values.index(usual) if usual in values else None,
    )


def _typeset(knob: Knob) -> Knob:
    """The knob with a label as matplotlib sets it."""
    return replace(knob, label=knob.label.replace("λ_Vv", r"$\lambda_{Vv}$"))


def _tally(method: str, point: Mapping[str, Any]) -> Tally | None:
    return Tally.from_numbers(method, point[method]) if method in point else None


def _table(knob: Knob, command: str) -> Table:
    rows = [
        ([value, method_label(method)], tally)
        for place, value in enumerate(knob.values)
        for method, tallies in knob.tallies.items()
        for tally in [tallies[place]]
        if tally is not None
    ]
    heads = [Column("value", whole=True), METHOD]
    return tally_table(f"In numbers: {knob.label}.", heads, rows, command)
