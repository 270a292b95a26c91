"""What happens between ticks, from slow control to fast, with and without a margin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from vcbf_drake.safety import BETWEEN_TICKS
from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.simulation.run import simulate
from vcbf_drake.studies.moving_wall import press_against_wall
from vcbf_drake.viz.terminal import rounded_down

RATES = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
MOVING_WALL = "moving wall"
SCENARIOS = ("car-avoidance", "blimp-single-obstacle")

# How densely h is looked at in the scenarios [s].
_STEP = 1e-3
_COLUMNS = {
    "min_barrier": ("least h seen", ".3g"),
    "certified_min_barrier": ("certified", "down"),
    "median_barrier": ("median h", ".3g"),
    "reached_at": ("reached [s]", ".2f"),
    "min_volume": ("least V_v", ".4g"),
    "max_abs_slack": ("greatest slack", ".3g"),
    "infeasible_ticks": ("infeasible ticks", "d"),
}

_PAGE = """\
# From 20 Hz to 1 kHz

Made by `{command}`.

The rows of the filter hold at the ticks; the input is held in between. Each case runs
at every rate twice: with `between_ticks: none`, and with `between_ticks: certified`,
which asks for inputs under which the rows hold until the next tick (E77). All runs have
the method dob-vcbf-qp, and the input of least violation where no input is safe.

*Least h seen* is over steps of 1 ms at most. *Certified* is what h was nowhere below,
no instant left out, whatever the disturbance did within what was known of it at the
ticks (E76). The labels are those of [theory.md](theory.md).
"""

_ABOUT = {
    MOVING_WALL: """\
A car is pressed, with all it has, against a wall that moves to and fro, 0.5 m to
either side at 2 rad/s; h is its distance [m]. The row is active at every tick, and its
right-hand side moves on as soon as the tick is over. The observer has to find a
constant push of 0.2 m/s^2; as it does not change, the hold's margin (E39) is 0 and
hides nothing. *Median h* is what the margin costs: the distance that the car keeps.""",
    "car-avoidance": """\
The shipped scenario; h in m^2. Its obstacle is round and stands still, and a car that
goes straight on moves away from it: little is lost between ticks, little is asked.""",
    "blimp-single-obstacle": """\
The shipped scenario; h in m. The wind, which reverses, presses the blimp onto a sphere.
At 20 Hz its yaw and speed change much within a period, and h is kept larger; from 50 Hz
on the margin costs a millimetre, from 100 Hz on nothing that could be seen.""",
}

Record = dict[str, Any]


def sweep_rates(
    rates: Sequence[float], progress: Callable[[float], None] | None = None
) -> list[Record]:
    """Returns a record of every case, rate and setting of `between_ticks`.

    Args:
        rates: Control rates [Hz].
        progress: Called after each run with the fraction that is done.
    """
    kinds = [
        (case, rate, between_ticks)
        for case in (MOVING_WALL, *SCENARIOS)
        for rate in rates
        for between_ticks in BETWEEN_TICKS
    ]
    records = []
    for case, rate, between_ticks in kinds:
        if case == MOVING_WALL:
            found = press_against_wall(rate, between_ticks)
        else:
            found = _run(case, rate, between_ticks)
        kind = {"case": case, "rate": rate, "between_ticks": between_ticks}
        records.append(kind | {name: found.get(name) for name in _COLUMNS})
        if progress is not None:
            progress(len(records) / len(kinds))
    return records


def _run(name: str, rate: float, between_ticks: str) -> Record:
    """Runs a scenario at another rate; what is done about its rows stays the same."""
    scenario = load_scenario(
        name,
        {
            "period": 1.0 / rate,
            "between_ticks": between_ticks,
            "infeasible": "least_violation",
            "integrator": {"max_step": min(_STEP, 1.0 / rate)},
        },
    )
    return simulate(scenario, step_time=False).summary


def sweep_markdown(records: Sequence[Record], command: str) -> str:
    """Returns the page about a sweep, as Markdown.

    Args:
        records: What `sweep_rates` returned.
        command: What made them.
    """
    lines = [_PAGE.format(command=command)]
    for case in dict.fromkeys(record["case"] for record in records):
        chosen = [record for record in records if record["case"] == case]
        columns = [
            name for name in _COLUMNS if any(each[name] is not None for each in chosen)
        ]
        titles = [
            "rate [Hz]",
            "`between_ticks`",
            *(_COLUMNS[name][0] for name in columns),
        ]
        lines += [f"## {case}", "", _ABOUT[case], "", _row(titles)]
        lines.append(_row(["---:", "---", *["---:"] * len(columns)]))
        for record in chosen:
            cells = [_cell(record[name], _COLUMNS[name][1]) for name in columns]
            lines.append(_row([f"{record['rate']:g}", record["between_ticks"], *cells]))
        lines.append("")
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(value: float | None, form: str) -> str:
    if value is None:
        return "-"
    return rounded_down(value) if form == "down" else format(value, form)
