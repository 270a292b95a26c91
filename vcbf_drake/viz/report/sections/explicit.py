"""The counter-example to Test 2: an observer whose chatter empties the set alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vcbf_drake.viz.report.document import Block, Column, Figure, Paragraph
from vcbf_drake.viz.report.figures.cases_figure import cases_figure
from vcbf_drake.viz.report.figures.error_figure import error_figure
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.tables import METHOD, runs_table, tally_table
from vcbf_drake.viz.report.tally import Tally
from vcbf_drake.viz.report.wording import (
    endings,
    method_label,
    percent,
    significant,
)
from vcbf_drake.viz.series_figures import draw_volume
from vcbf_drake.viz.style import METHOD_STYLES

STEPS = ("explicit", "implicit")


def test_2_explicit(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """The same course with the observer stepped explicitly and implicitly."""
    rate, command = numbers["observer_rate"], numbers["command"]
    twins = {f"{step} observer, {rate:g} Hz": numbers[step] for step in STEPS}
    return [
        Paragraph(numbers["description"]),
        Paragraph(numbers["differences"]),
        Figure(
            "test_2_explicit",
            "One course, twice: paths from above and the volume barrier *Vᵥ*, with the"
            " observer stepped explicitly (above) and implicitly (below). Only the"
            f" observer's step differs. {_told(twins)}",
            lambda: cases_figure(
                [(words, saved.runs(twin["runs"])) for words, twin in twins.items()],
                (0, 1),
                draw_volume,
                share=0.55,
            ),
            command,
        ),
        Figure(
            "test_2_explicit_errors",
            "The norm of the estimate's error (line) and the bound that the filter used"
            f" (grey area) in the same runs, in decades. {_errors(twins)}",
            lambda: error_figure(
                [(words, saved.runs(twin["runs"])[-1]) for words, twin in twins.items()]
            ),
            command,
        ),
        runs_table(
            "Explicit and implicit observer on one course.",
            [(words, twin["runs"]) for words, twin in twins.items()],
            "m",
            command,
        ),
        tally_table(
            "The same course from random starts, the observer stepped in different"
            " ways: the faster it steps explicitly, the less it chatters.",
            [Column("observer"), Column("rate [Hz]", whole=True), METHOD],
            [
                (
                    [each["step"], f"{each['rate']:g}", method_label(method)],
                    Tally.from_numbers(method, each[method]),
                )
                for each in numbers["observers"]
                for method in METHOD_STYLES
                if method in each
            ],
            command,
        ),
    ]


def _told(twins: Mapping[str, Any]) -> str:
    return " ".join(
        f"{step.capitalize()}: {endings(twin['runs'])}"
        for step, twin in zip(STEPS, twins.values(), strict=True)
    )


def _errors(twins: Mapping[str, Any]) -> str:
    parts = [
        f"{step}, at most {significant(twin['estimation']['greatest_error'], 2)} m/s²"
        " after the first second and above that bound in"
        f" {percent(twin['estimation']['above_certified_bound'])} of the ticks"
        for step, twin in zip(STEPS, twins.values(), strict=True)
    ]
    strongest = max(
        twin["estimation"]["greatest_disturbance"] for twin in twins.values()
    )
    return (
        f"The disturbance is at most {significant(strongest, 2)} m/s²; the error is:"
        f" {'; '.join(parts)}."
    )
