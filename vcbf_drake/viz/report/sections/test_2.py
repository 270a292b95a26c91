"""Test 2 of the paper: several spheres, with and without the volume barrier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vcbf_drake.viz.feasible_set_figure import feasible_set_figure
from vcbf_drake.viz.feasible_solid_figure import feasible_solid_figure
from vcbf_drake.viz.path_figure import path_figure
from vcbf_drake.viz.report.document import (
    Block,
    Column,
    Figure,
    Paragraph,
    Replay,
    Table,
    number_columns,
)
from vcbf_drake.viz.report.reproduction import Reproduction, in_drawing_order
from vcbf_drake.viz.report.tables import runs_table
from vcbf_drake.viz.report.wording import (
    endings,
    fixed,
    listed,
    method_label,
    percent,
    significant,
    slack,
)
from vcbf_drake.viz.series_figures import input_figure, slack_figure, volume_figure


def test_2(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    """Paths, slack, volume, feasible sets at two times, and the inputs."""
    runs, command = numbers["runs"], numbers["command"]
    return [
        Paragraph(numbers["description"]),
        Replay("test_2", "both methods at once.", lambda: saved.results(runs)),
        Figure(
            "test_2_paths",
            "Paths among the spheres in space, from above and from the side. The filter"
            f" guards the blimp's centre. {endings(runs)}",
            lambda: path_figure(saved.runs(runs)),
            command,
        ),
        Figure(
            "test_2_slack",
            "The slack *δ* of the volume row over time. The theorems ask for *δ* = 0"
            f" all along; {_greatest_slack(runs)}",
            lambda: slack_figure(saved.runs(runs)),
            command,
        ),
        Figure(
            "test_2_volume",
            "The volume barrier *Vᵥ* over time, for inputs normalised by their limits:"
            " near 1 when no obstacle takes any input away, below 0 (red) when less"
            f" than *ξ* is left. {_volumes(numbers)}",
            lambda: volume_figure(saved.runs(runs)),
            command,
        ),
        *_feasible_sets(numbers, saved),
        Figure(
            "test_2_inputs",
            "The inputs that both filters chose, the reference of the method drawn in"
            " full (grey), and the limits (red).",
            lambda: input_figure(saved.runs(runs)),
            command,
        ),
        runs_table(
            "Test 2 with and without the volume barrier, corrected and with the"
            " equations as the paper prints them.",
            [("corrected", runs), ("as printed", numbers["as_printed"])],
            "m",
            command,
        ),
    ]


def _feasible_sets(numbers: Mapping[str, Any], saved: Reproduction) -> list[Block]:
    runs, command = numbers["runs"], numbers["command"]
    snapshots = [float(time) for time in numbers["snapshots"]]
    times = listed([f"{fixed(time)} s" for time in snapshots])
    return [
        Figure(
            "test_2_feasible_sets",
            f"The feasible sets of both methods at {times}, in the plane of surge and"
            " heave force; the yaw moment is in no barrier's row. Inside the limits"
            " (dashed) each barrier forbids a half-plane (hatched); what is left is"
            " coloured, with the largest ellipsoid in it. The open circle is the"
            f" reference, the filled one what the filter chose. {_interior(numbers)}",
            lambda: feasible_set_figure(saved.runs(runs), snapshots),
            command,
        ),
        Figure(
            "test_2_feasible_solids",
            f"The same sets at {times} with all three inputs, as the paper draws them,"
            " each input in shares of its range.",
            lambda: feasible_solid_figure(saved.runs(runs), snapshots),
            command,
        ),
        _snapshots_table(numbers),
    ]


def _snapshots_table(numbers: Mapping[str, Any]) -> Table:
    by_method: dict[str, Any] = in_drawing_order(numbers["at_snapshots"])
    rows = [
        [
            fixed(entry["time"]),
            method_label(method),
            fixed(entry["volume"], 3),
            _vector(entry["reference"]),
            "yes" if entry["reference_is_feasible"] else "no",
            _vector(entry["input"]),
            fixed(entry["input_to_nearest_face"], 3),
        ]
        for place in range(len(numbers["snapshots"]))
        for method, entries in by_method.items()
        for entry in [entries[place]]
    ]
    return Table(
        "Reference and chosen input at those times, as (surge force [N], heave force"
        " [N], yaw moment [N m]). The last column is the choice's distance to the"
        " nearest face of the feasible set, for inputs that range from −1 to 1.",
        [
            *number_columns("time [s]"),
            Column("method", whole=True),
            *number_columns("*Vᵥ* [-]", "reference"),
            Column("feasible"),
            *number_columns("chosen", "to face [-]"),
        ],
        rows,
        command=numbers["command"],
    )


def _vector(values: Sequence[float]) -> str:
    return f"({', '.join(fixed(value, 3) for value in values)})"


def _volumes(numbers: Mapping[str, Any]) -> str:
    least = ", ".join(
        f"{method_label(method)} {fixed(run['summary']['min_volume'], 3)}"
        for method, run in in_drawing_order(numbers["runs"]).items()
    )
    compared = numbers["volumes"]
    return (
        f"The least values: {least}. With the volume barrier *Vᵥ* is not lower in"
        f" {percent(compared['not_lower']['rate'])} of the ticks that both runs have,"
        f" and lower by at most {significant(compared['greatest_deficit'], 2)}."
    )


def _interior(numbers: Mapping[str, Any]) -> str:
    parts = [
        f"{method_label(method)} in {share['count']} of {share['of']} ticks"
        for method, share in in_drawing_order(numbers["interior"]).items()
    ]
    return (
        "Where the reference was outside the set, the choice was in its interior with"
        f" {listed(parts)} of the whole run."
    )


def _greatest_slack(runs: Mapping[str, Any]) -> str:
    greatest = max(float(run["summary"]["max_abs_slack"]) for run in runs.values())
    if greatest == 0.0:
        return "it is exactly that."
    return f"its greatest size is {slack(greatest)}."
