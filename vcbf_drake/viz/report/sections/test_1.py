"""Test 1 of the paper: four methods pass one sphere in a wind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vcbf_drake.viz.path_figure import path_figure
from vcbf_drake.viz.report.document import Block, Figure, Paragraph, Replay
from vcbf_drake.viz.report.figures.cases_figure import cases_figure
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.sections.clearances import clearances
from vcbf_drake.viz.report.tables import runs_table
from vcbf_drake.viz.report.wording import (
    endings,
    least_barriers,
    listed,
    method_label,
    percent,
    readable,
    section_command,
    significant,
)
from vcbf_drake.viz.series_figures import (
    barrier_figure,
    disturbance_figure,
    draw_barriers,
)


def test_1(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Paths, barriers and estimate in the reversing wind; steady winds beside it."""
    runs, command = numbers["runs"], numbers["command"]
    blocks: list[Block] = [
        Paragraph(numbers["description"]),
        Replay("test_1", "all methods in the same wind.", lambda: saved.results(runs)),
        Figure(
            "test_1_paths",
            "Paths past the sphere (grey) from the start (dot) to the target (star) in"
            " a reversing wind: in space, from above and from the side. A cross marks"
            f" where a run failed. {endings(runs)}",
            lambda: path_figure(saved.runs(runs)),
            command,
        ),
        Figure(
            "test_1_barriers",
            "The barrier *h*, the distance to the sphere's surface, over time; below 0"
            f" is a collision. The least values: {least_barriers(runs, 'm')}.",
            lambda: barrier_figure(saved.runs(runs)),
            command,
        ),
        Figure(
            "test_1_estimate",
            "The disturbance and its estimate by the RISE observer, channel by"
            " channel, and below the error's norm against the certified bound *ε*"
            f" (grey area). {_estimation(numbers['estimation'])}",
            lambda: disturbance_figure(saved.runs(runs)),
            command,
        ),
        runs_table(
            "Test 1 in the reversing wind. The least *h* is checked between the"
            " control ticks too.",
            [("", runs)],
            "m",
            command,
        ),
    ]
    if numbers.get("steady_winds"):
        blocks += _steady_winds(numbers["steady_winds"], saved)
    if numbers.get("clearances"):
        blocks += clearances(numbers["clearances"])
    return blocks


def _steady_winds(
    winds: Sequence[Mapping[str, Any]], saved: Reproduction
) -> list[Block]:
    conditions = [(wind["label"], wind["runs"]) for wind in winds]
    return [
        Figure(
            "test_1_steady_winds",
            "The same test in steady winds, a row each: paths from the side, and *h*"
            " over time. "
            f"{_collisions(winds)}",
            lambda: cases_figure(
                [(readable(words), saved.runs(runs)) for words, runs in conditions],
                (0, 2),
                draw_barriers,
                share=0.4,
            ),
            section_command("test_1"),
        ),
        runs_table(
            "Test 1 in steady winds.", conditions, "m", section_command("test_1")
        ),
    ]


def _estimation(numbers: Mapping[str, float]) -> str:
    greatest, rms = numbers["greatest_error"], numbers["rms_error"]
    return (
        f"After the first second the error is at most {significant(greatest, 2)} m/s²"
        f" (root mean square {significant(rms, 2)}) of a disturbance of up to"
        f" {significant(numbers['greatest_disturbance'], 2)} m/s². It is above the"
        f" certified bound in {percent(numbers['above_certified_bound'])} of all ticks"
        " and above the printed bound, which tends to 0, in"
        f" {percent(numbers['above_printed_bound'])}."
    )


def _collisions(winds: Sequence[Mapping[str, Any]]) -> str:
    """Who collides in which wind."""
    parts = [
        f"{method_label(method)} in {readable(wind['label'])}"
        for wind in winds
        for method, run in wind["runs"].items()
        if run["summary"]["outcome"] == "collision"
    ]
    return f"Collisions: {listed(parts)}." if parts else "No method collides in them."
