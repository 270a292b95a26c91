"""The paper's two experiments with a car, in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vcbf_drake.viz.path_figure import path_figure
from vcbf_drake.viz.report.document import Block, Figure, Paragraph, Replay
from vcbf_drake.viz.report.figures.cases_figure import cases_figure
from vcbf_drake.viz.report.reproduction import Reproduction, in_drawing_order
from vcbf_drake.viz.report.tables import runs_table
from vcbf_drake.viz.report.wording import (
    ending,
    endings,
    least_barriers,
    method_label,
    readable,
)
from vcbf_drake.viz.series_figures import barrier_figure, draw_volume


def car_1(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Paths and barriers of three methods."""
    runs, command = numbers["runs"], numbers["command"]
    return [
        Paragraph(numbers["description"]),
        Replay("car_1", "all methods at once.", lambda: saved.results(runs)),
        Figure(
            "car_1_paths",
            "Paths of the car's centre from the start (dot) to the target (star), seen"
            f" from above. A cross marks where a run failed. {endings(runs)}",
            lambda: path_figure(saved.runs(runs)),
            command,
        ),
        Figure(
            "car_1_barriers",
            "The barrier *h*, the squared distance to the disc's centre less its"
            " squared radius, over time; below 0 is a collision. The least values:"
            f" {least_barriers(runs, 'm²')}.",
            lambda: barrier_figure(saved.runs(runs)),
            command,
        ),
        runs_table(
            "Car experiment 1 under the paper's three methods.",
            [("", runs)],
            "m²",
            command,
        ),
    ]


def car_2(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Paths and volume for every approach gain, with and without the volume barrier."""
    cases = numbers["runs"]
    slowest = next(iter(cases.values()))
    command = numbers["command"]
    return [
        Paragraph(numbers["description"]),
        Replay("car_2", "the slowest reference.", lambda: saved.results(slowest)),
        Figure(
            "car_2",
            "A row for each gain of the reference: paths from above at the left, the"
            " volume barrier *Vᵥ* over time at the right, with and without the volume"
            " barrier. A cross marks the tick that has no feasible input."
            f" {_not_arrived(cases)}",
            lambda: cases_figure(
                [
                    (words.replace("k_p=", "$k_p$ = "), saved.runs(runs))
                    for words, runs in cases.items()
                ],
                (0, 1),
                draw_volume,
                share=0.56,
            ),
            command,
        ),
        runs_table(
            "Car experiment 2: every gain of the reference, with and without the volume"
            " barrier.",
            list(cases.items()),
            "m²",
            command,
        ),
    ]


def _not_arrived(cases: Mapping[str, Any]) -> str:
    """Who does not reach the target, at which gain, and why."""
    parts = [
        f"{readable(words)}, {method_label(method)} {ending(run['summary'])}"
        for words, runs in cases.items()
        for method, run in in_drawing_order(runs).items()
        if run["summary"]["outcome"] != "reached"
    ]
    if not parts:
        return "All runs reach the target."
    return f"All runs reach the target but these: at {'; at '.join(parts)}."
