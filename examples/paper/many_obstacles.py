"""Test 2 of the paper: many spheres, with and without the volume barrier."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.simulation.result import Result
from vcbf_drake.studies import Record
from vcbf_drake.viz.feasible_set import feasible_set_figure
from vcbf_drake.viz.figures import path_figure
from vcbf_drake.viz.series_figures import input_figure, slack_figure, volume_figure

from .archive import Archive, in_drawing_order
from .experiment import (
    WITH,
    WITHOUT,
    Claim,
    Experiment,
    Finding,
    Numbers,
    Plan,
    Records,
    Settings,
    entries,
    runs_under,
)
from .feasible_solid_figure import feasible_solid_figure
from .one_obstacle import estimation
from .report import Block, Figure, Replay
from .words import (
    ending,
    endings,
    fixed,
    label,
    listed,
    percent,
    proportion,
    runs_table,
    significant,
    slack,
    table,
)

SCENARIO = "blimp-multiple-obstacles"
COMPARED = (WITH, WITHOUT)

_FIRST_SNAPSHOT = 2.0  # The paper's first time [s]; its second is the last feasible.
# In normalised inputs, whose range is 2.
_INSIDE = 1e-6


# Run ---------------------------------------------------------------------------------


def plan(settings: Settings) -> Plan:
    """Returns the runs of both filters, and the printed equations beside them."""
    runs = runs_under(COMPARED, SCENARIO, "test_2")
    runs |= runs_under((WITH,), SCENARIO, "test_2_as_printed", {"fidelity": "paper"})

    def evaluate(archive: Archive, records: Records) -> Record:
        results = {method: archive.result(f"test_2/{method}") for method in COMPARED}
        times = _snapshot_times(results[WITHOUT])
        return {
            "command": f"vcbf-drake compare {SCENARIO} --methods {','.join(COMPARED)}",
            "runs": entries(archive, runs, "test_2"),
            "as_printed": entries(archive, runs, "test_2_as_printed"),
            "snapshots": times,
            "at_snapshots": {
                method: [_at(result, time) for time in times]
                for method, result in results.items()
            },
            "volumes": _compare_volumes(results[WITH], results[WITHOUT]),
            "interior": {m: _interior(result) for m, result in results.items()},
            "estimation": estimation(results[WITH]),
        }

    return Plan(evaluate, runs)


def _snapshot_times(result: Result) -> list[float]:
    """The paper's 2 s, and the last tick at which the run had a feasible input."""
    infeasible_at, time = result.summary["infeasible_at"], result.log["time"]
    end = time[-1] if infeasible_at is None else time[time < infeasible_at][-1]
    return [_FIRST_SNAPSHOT, float(end)]


def _at(result: Result, time: float) -> dict[str, Any]:
    tick = int(np.argmin(abs(result.log["time"] - time)))
    log, inside = result.log, _margins(result, "reference")
    return {
        "time": float(log["time"][tick]),
        "volume": float(log["volume"][tick]),
        "reference": log["reference"][tick].tolist(),
        "input": log["input"][tick].tolist(),
        "reference_is_feasible": bool(inside[tick] >= 0.0),
        "input_to_nearest_face": float(_margins(result, "input")[tick]),
    }


def _compare_volumes(own: Result, other: Result) -> dict[str, Any]:
    """Whose V_v is higher, at the ticks that both runs have."""
    ticks = min(len(own.log["volume"]), len(other.log["volume"]))
    difference = own.log["volume"][:ticks] - other.log["volume"][:ticks]
    return {
        "not_lower": _among(difference >= 0.0),
        "greatest_deficit": float(max(0.0, -difference.min())),
        "mean_difference": float(difference.mean()),
    }


def _interior(result: Result) -> dict[str, Any]:
    """How often a reference outside the feasible set became an input inside it."""
    outside = _margins(result, "reference") < -_INSIDE
    has_interior = np.isfinite(result.log["ellipsoid_center"]).all(axis=1)
    changed = outside & has_interior
    inside = _margins(result, "input") > _INSIDE
    return _among(inside[changed])


def _among(ticks: NDArray[np.bool_]) -> Record:
    """A share of ticks; they follow from each other, so it has no interval."""
    count, total = int(np.sum(ticks)), len(ticks)
    return {"count": count, "of": total, "rate": count / total if total else None}


def _margins(result: Result, name: str) -> Array:
    """Distance of an input to the nearest face at each tick, in normalised inputs."""
    inputs = result.scenario.input_set.input_set()
    A, b, u = (result.log[key] for key in ("polytope_A", "polytope_b", name))
    norms = np.linalg.norm(A * inputs.scale, axis=2)
    gap = b - np.einsum("tri,ti->tr", A, u)
    # A row that no input moves has no face.
    distance = np.divide(gap, norms, out=np.full_like(gap, np.inf), where=norms > 0)
    nearest: Array = distance.min(axis=1)
    return nearest


# Judge -------------------------------------------------------------------------------


def only_proposed_arrives(data: Numbers) -> Finding:
    """Figure 2(a): the proposed filter arrives, the one without volume row stops."""
    own, other = _summaries(data)
    number = (
        f"{WITHOUT} {ending(other)}, {other['final_distance']:.1f} m from the target;"
        f" {WITH} {ending(own)}"
    )
    holds = own["outcome"] == "reached" and other["outcome"] == "infeasible"
    if "population_blimp" not in data:
        return Finding(holds, True, number)
    rates = data["population_blimp"]["rates"]
    stops = rates["dob-cbf-qp fails"]
    arrives = rates["of its failures, dob-vcbf-qp reaches"]
    return Finding(
        holds,
        stops["rate"] == arrives["rate"] == 1.0,
        f"{number}. Over random courses {WITHOUT} fails in {proportion(stops)};"
        f" of these {WITH} arrives in {proportion(arrives)}",
    )


def slack_is_zero(data: Numbers) -> Finding:
    """Figure 2(b): the slack is zero all along."""
    own = _summaries(data)[0]["max_abs_slack"]
    printed = data["test_2"]["as_printed"][WITH]["summary"]["max_abs_slack"]
    return Finding(
        own == 0.0,
        printed == 0.0,
        f"at most {own:.2g} with the exact slack,"
        f" {printed:.2g} with the printed penalty",
    )


def volume_is_higher(data: Numbers) -> Finding:
    """Figure 2(c): V_v of the proposed filter is always the higher."""
    volumes = data["test_2"]["volumes"]
    return Finding(
        volumes["greatest_deficit"] == 0.0,
        True,
        f"not lower at {proportion(volumes['not_lower'])} of the common ticks, higher"
        f" by {volumes['mean_difference']:.3f} on average, lower by up to"
        f" {volumes['greatest_deficit']:.3f}",
    )


def volume_stays_positive(data: Numbers) -> Finding:
    """Theorem 2: V_v >= 0 along the run."""
    main = _summaries(data)[0]["min_volume"]
    number = f"least V_v {main:.3f} in Test 2"
    studies = []
    if "table_1" in data:
        studies.append(("Table I's starts", data["table_1"]["case_1"]))
        studies.append(("its gains", data["table_1"]["case_2"]))
    if "population_blimp" in data:
        studies.append(("random courses", data["population_blimp"]))
    beside = []
    for name, study in studies:
        least = study["methods"][WITH]["least_volume"]
        beside.append(least is None or least >= 0.0)
        number += f", {least:.3f} over {name}"
    return Finding(main >= 0.0, all(beside), number)


def proposed_maps_to_the_interior(data: Numbers) -> Finding:
    """Figure 2(d)-(g): the proposed filter maps to the interior, the other does not."""
    own, other = (data["test_2"]["at_snapshots"][m][0] for m in COMPARED)
    inside, boundary = (data["test_2"]["interior"][m] for m in COMPARED)
    distances = own["input_to_nearest_face"], abs(other["input_to_nearest_face"])
    return Finding(
        distances[0] > _INSIDE >= distances[1],
        inside["rate"] == 1.0 and boundary["rate"] == 0.0,
        f"at {own['time']:.0f} s {distances[0]:.2f} and {distances[1]:.2f} from the"
        f" nearest face; inside at {proportion(inside)} of all ticks with a reference"
        f" outside, against {proportion(boundary)}",
    )


def only_the_other_set_vanishes(data: Numbers) -> Finding:
    """Figure 2(f), (g): without the volume row the feasible set vanishes."""
    own, other = (data["test_2"]["at_snapshots"][m][-1] for m in COMPARED)
    stopped = _summaries(data)[1]["outcome"] == "infeasible"
    return Finding(
        stopped and own["volume"] > 0.0,
        True,
        f"one tick before {WITHOUT} ends, at {other['time']:.2f} s, V_v is"
        f" {own['volume']:.3f} with and {other['volume']:.3f} without the volume row",
    )


def _summaries(data: Numbers) -> tuple[Numbers, Numbers]:
    runs = data["test_2"]["runs"]
    return runs[WITH]["summary"], runs[WITHOUT]["summary"]


# Show --------------------------------------------------------------------------------


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields paths, slack, volume, feasible sets at two times, and the inputs."""
    runs, command = numbers["runs"], numbers["command"]
    yield (
        "Start, target and all gains are the paper's; spheres, thrust limits and wind"
        " are ours. This is course 5 of the random ones, selected because the outcome"
        " is the same from all random starts; the section on unselected layouts says"
        " how often such courses occur."
    )
    yield Replay("test_2", "both methods at once.", lambda: archive.results(runs))
    yield Figure(
        "test_2_paths",
        "Paths among the spheres in space, from above and from the side. The filter"
        f" guards the blimp's centre. {endings(runs)}",
        lambda: path_figure(archive.labelled(runs)),
        command,
    )
    yield Figure(
        "test_2_slack",
        "The slack *δ* of the volume row over time. The theorems ask for *δ* = 0 all"
        f" along; {_greatest_slack(runs)}",
        lambda: slack_figure(archive.labelled(runs)),
        command,
    )
    yield Figure(
        "test_2_volume",
        "The volume barrier *Vᵥ* over time, for inputs normalised by their limits: near"
        " 1 when no obstacle takes any input away, below 0 (red) when less than *ξ* is"
        f" left. {_volumes(numbers)}",
        lambda: volume_figure(archive.labelled(runs)),
        command,
    )
    yield from _feasible_sets(numbers, archive)
    yield Figure(
        "test_2_inputs",
        "The inputs that both filters chose, the reference of the method drawn in full"
        " (grey), and the limits (red).",
        lambda: input_figure(archive.labelled(runs)),
        command,
    )
    yield runs_table(
        "Test 2 with and without the volume barrier, corrected and with the equations"
        " as the paper prints them.",
        [("corrected", runs), ("as printed", numbers["as_printed"])],
        "m",
        command,
    )


def _feasible_sets(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    runs, command = numbers["runs"], numbers["command"]
    snapshots = [float(time) for time in numbers["snapshots"]]
    times = (
        f"{fixed(snapshots[0])} s and {fixed(snapshots[1])} s, the last feasible tick"
        f" of {WITHOUT} (the paper's second time is 3.2 s)"
    )
    yield Figure(
        "test_2_feasible_sets",
        f"The feasible sets of both methods at {times}, in the plane of surge and heave"
        " force; the yaw moment is in no barrier's row. Inside the limits (dashed) each"
        " barrier forbids a half-plane (hatched); what is left is coloured, with the"
        " largest ellipsoid in it. The open circle is the reference, the filled one"
        f" what the filter chose. {_interior_in_words(numbers)}",
        lambda: feasible_set_figure(archive.labelled(runs), snapshots),
        command,
    )
    yield Figure(
        "test_2_feasible_solids",
        f"The same sets at {times} with all three inputs, as the paper draws them, each"
        " input in shares of its range.",
        lambda: feasible_solid_figure(archive.labelled(runs), snapshots),
        command,
    )
    by_method = in_drawing_order(numbers["at_snapshots"])
    yield table(
        "Reference and chosen input at those times, as (surge force [N], heave force"
        " [N], yaw moment [N m]). The last column is the choice's distance to the"
        " nearest face of the feasible set, for inputs that range from −1 to 1.",
        [
            "time [s]",
            "method",
            "*Vᵥ* [-]",
            "reference",
            "feasible",
            "chosen",
            "to face [-]",
        ],
        [
            [
                fixed(entry["time"]),
                label(method),
                fixed(entry["volume"], 3),
                _vector(entry["reference"]),
                "yes" if entry["reference_is_feasible"] else "no",
                _vector(entry["input"]),
                fixed(entry["input_to_nearest_face"], 3),
            ]
            for place in range(len(snapshots))
            for method, found in by_method.items()
            for entry in [found[place]]
        ],
        command,
    )


def _vector(values: Sequence[float]) -> str:
    return f"({', '.join(fixed(value, 3) for value in values)})"


def _volumes(numbers: Numbers) -> str:
    least = ", ".join(
        f"{label(method)} {fixed(run['summary']['min_volume'], 3)}"
        for method, run in in_drawing_order(numbers["runs"]).items()
    )
    compared = numbers["volumes"]
    return (
        f"The least values: {least}. With the volume barrier *Vᵥ* is not lower in"
        f" {percent(compared['not_lower']['rate'])} of the ticks that both runs have,"
        f" and lower by at most {significant(compared['greatest_deficit'], 2)}."
    )


def _interior_in_words(numbers: Numbers) -> str:
    parts = [
        f"{label(method)} in {share['count']} of {share['of']} ticks"
        for method, share in in_drawing_order(numbers["interior"]).items()
    ]
    return (
        "Where the reference was outside the set, the choice was in its interior with"
        f" {listed(parts)} of the whole run."
    )


def _greatest_slack(runs: Numbers) -> str:
    greatest = max(float(run["summary"]["max_abs_slack"]) for run in runs.values())
    if greatest == 0.0:
        return "it is exactly that."
    return f"its greatest size is {slack(greatest)}."


EXPERIMENT = Experiment(
    "test_2",
    "Test 2: several obstacles",
    plan,
    show,
    claims=(
        Claim(
            "The proposed method arrives; DOB-CBF stops part of the way",
            "Fig. 2(a)",
            only_proposed_arrives,
        ),
        Claim("The slack is zero", "Fig. 2(b)", slack_is_zero),
        Claim(
            "V_v of the proposed method is always the higher",
            "Fig. 2(c)",
            volume_is_higher,
        ),
        Claim("V_v >= 0 all along", "Theorem 2", volume_stays_positive),
        Claim(
            "A reference outside the set: the proposed method chooses an interior"
            " point, DOB-CBF one of the boundary",
            "Fig. 2(d)-(g)",
            proposed_maps_to_the_interior,
        ),
        Claim(
            "The feasible set of DOB-CBF vanishes, that of the proposed method does"
            " not",
            "Fig. 2(f), (g)",
            only_the_other_set_vanishes,
        ),
    ),
)
